"""Nonlinear response of the pixel and its amplifier."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.crosstalk.boundaries import shared_charge
from pixcal.estimators.detector.flat_ladder import ladder, ladder_response
from pixcal.estimators.detector.response import departure, fit_curve, fit_response
from pixcal.estimators.detector.response_of_flats import full_scale, ladder_curve, response_of_noise
from pixcal.estimators.detector.transfer_curve import transfer_curve
from pixcal.estimators.diagnosis.central_crop import central_crop
from pixcal.estimators.diagnosis.distortions import Agreement
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.boundaries import boundary_shifts
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_chi2
from pixcal.model.arrays import F32, F64
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import SETS_DISAGREE, Effect, Estimate, Stage
from pixcal.simulation.forward import Scalable
from pixcal.simulation.shot import Shot

FALLOFF_PX = 0.5  # falloff of boundary shifts (brighter-fatter effect) fitted with the response
# levels at which a response is measured, from the darkest samples (0) to the brightest (1)
KNOTS = np.array([0, 1 / 64, 1 / 32, *np.arange(1, 17) / 16])
BEYOND = 4  # points beyond the brightest fringe, up to the brightest flat
LOW = 0.3  # share of the range of levels whose signals set the line of a measured curve
TAIL = 1e-3  # share of samples below, and above, the range of levels
BESIDE = 0.05  # least chi-square of a curve added to a polynomial, over that of the latter
_INVERSE = 1 << 14


@dataclass(frozen=True)
class CurvePoint(Scalable):
    """A point of a measured response."""

    strengths = ("change_e",)

    level_e: float = quantity(unit="e-", low=0, high=1e8, doc="charge")
    change_e: float = quantity(unit="e-", low=-1e7, high=1e7, doc="deviation from the polynomial")


@dataclass(frozen=True)
class Nonlinearity(Effect):
    """Signal ``S (1 + quadratic u + cubic u²)`` of a charge S, with ``u = S / level_e``."""

    name = "nonlinearity"
    title = "nonlinear response"
    acts_at = Stage.SIGNAL
    order = 2
    domains = ("intensity",)
    strengths = ("quadratic", "cubic", "bends")
    frames_needed = ("ladder",)
    remedy = "'pixcal electrons' straightens the response of other frames with this curve"
    quick = False
    sources = (
        "Rousset et al., table 1: 2 % linearity error of the GIGAPYX-4600",
        "Janesick, Photon Transfer (SPIE 2007), chapter 7: below 1 % of the source follower (V/V), "
        "more of the sense node, whose capacitance grows with the charge (V/e-)",
    )

    quadratic: float = quantity(-0.015, low=-0.3, high=0.3)
    """relative deviation at level_e, of the term proportional to the signal"""
    cubic: float = quantity(-0.005, low=-0.3, high=0.3)
    """relative deviation at level_e, of the term proportional to its square"""
    level_e: float = quantity(50_000.0, unit="e-", above=0, high=1e7)
    """signal at which the deviations are given: the full well"""
    bends: tuple[CurvePoint, ...] = quantity(())
    """measured points of the response curve, in rising order"""

    @property
    def turns_at(self) -> float:
        """Level (u) at the maximum of the response; infinite if it always rises."""
        roots = np.roots([3 * self.cubic, 2 * self.quadratic, 1.0])
        rising = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and r.real > 0]
        return min(rising, default=np.inf)

    def check(self, bench: Bench) -> None:
        well = bench.detector.full_well_e
        if well is not None and well > self.turns_at * self.level_e:
            raise InputError(
                f"effects.nonlinearity: the response stops rising at "
                f"{self.turns_at * self.level_e:.0f} e-, below full_well_e ({well:g} e-); give "
                "smaller deviations"
            )

    def response(self, charge: F32) -> F32:
        """Signal of a charge, e-; constant beyond the maximum of the polynomial."""
        u = np.minimum(charge / np.float32(self.level_e), np.float32(self.turns_at))
        bent = u * (1 + u * (np.float32(self.quadratic) + np.float32(self.cubic) * u))
        signal = np.asarray(bent * np.float32(self.level_e), np.float32)
        if self.bends:
            levels = np.array([point.level_e for point in self.bends])
            changes = np.array([point.change_e for point in self.bends])
            signal += departure(charge, levels, changes)
        return signal

    def linearised(self, signal: F32) -> F32:
        """Charge (e-) of a signal: the inverse of `response` up to its maximum; NaN stays."""
        wanted = np.asarray(signal, float)
        brightest = float(np.nanmax(wanted, initial=self.level_e, where=np.isfinite(wanted)))
        top = min(self.turns_at * self.level_e, 2 * brightest)
        charge = np.linspace(2 * float(np.nanmin(wanted, initial=0.0)), top, _INVERSE)
        given = np.maximum.accumulate(self.response(charge.astype(np.float32)).astype(float))
        return np.asarray(np.interp(wanted, given, charge), np.float32)

    def undo_samples(self, charge: F32) -> F32:
        return self.linearised(charge)

    def signal(self, signal: F32, shot: Shot) -> F32:
        return self.response(signal)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Second and third harmonic of the phase in the residuals; without fringes, flats."""
        fit = _polynomial(evidence)
        if fit is None:
            return None
        quadratic, cubic = (float(np.clip(v, -0.3, 0.3)) for v in fit.sizes)
        effect = cls(quadratic, cubic, fit.level_e)
        more, refused = None, ""
        evidence_for = fit.significance, fit.why
        sure = effect.linearised if fit.significance > SIGNIFICANT else None
        bent = None if evidence.fringes else ladder_curve(evidence, sure)
        if bent is not None:
            points = np.pad(bent.charge, (1, 0)).tolist(), np.pad(bent.change, (1, 0)).tolist()
            named = {f"bends[{n}].change_e": float(e) for n, e in enumerate(bent.error, 1)}
            steps = tuple(dict(zip(named, step, strict=True)) for step in bent.steps.T.tolist())
            # The last point lies beyond the flats.
            size = _size(bent.charge[-2], bent.change[-2], bent.error[-2])
            return Estimate(
                cls(0.0, 0.0, fit.level_e, tuple(map(CurvePoint, *points))),
                named,
                *evidence_for,
                steps,
                law="response curve of second and third order",
                by_law=effect,
                size=size,
            )
        if evidence.fringes and fit.significance > SIGNIFICANT:
            part = central_crop(evidence)
            more, agreement = _bends(part, effect.response, fit.chi2)
            refused = SETS_DISAGREE if agreement.rejected else ""
        errors = np.sqrt(np.diag(fit.covariance))
        named = {"quadratic": float(errors[0]), "cubic": float(errors[1])}
        if more is None:
            return Estimate(effect, named, *evidence_for, refused=refused, size=fit.size)
        named |= {f"bends[{n}].change_e": error for n, error in enumerate(more[1])}
        curve = replace(effect, bends=more[0])
        return Estimate(
            replace(curve, bends=(*more[0], *_straight_on(curve, evidence))),
            named,
            *evidence_for,
            law="response curve of second and third order",
            by_law=effect,
            refused=refused,
            size=_size_of_curve(curve, more[1], fit.error),
        )

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        return fit.significance if (fit := _polynomial(evidence)) else None


@dataclass(frozen=True)
class _Polynomial:
    """Quadratic and cubic term of the response."""

    level_e: float  # reference level of the deviations
    sizes: F64  # (2,)
    covariance: F64  # (2, 2)
    why: str
    top_e: float  # highest level measured

    @property
    def _terms(self) -> F64:
        # A power that flats do not constrain has size zero and a large error; it is left out.
        return np.asarray((self.top_e / self.level_e) ** np.array([1, 2]) * (self.sizes != 0))

    @property
    def error(self) -> float:
        """Of the deviation at the highest level, relative to that level."""
        return float(np.sqrt(self._terms @ self.covariance @ self._terms))

    @property
    def size(self) -> dict[str, object]:
        change = float(self._terms @ self.sizes)
        return _size(self.top_e, self.top_e * change, self.top_e * self.error)

    @property
    def chi2(self) -> float:
        return float(self.sizes @ np.linalg.solve(self.covariance, self.sizes))

    @property
    def significance(self) -> float:
        return sigmas_of_chi2(self.chi2, 2)


def _polynomial(evidence: Evidence) -> _Polynomial | None:
    """Polynomial from fringes or, without them, from the best constraint of the flats."""
    level = full_scale(evidence, Nonlinearity().level_e)
    levels, curve = ladder_response(evidence, level), response_of_noise(evidence, level)
    # Information on the quadratic term only, as the exposure-time steps also give a cubic term.
    variances = [0.0 if one is None else np.linalg.inv(one[1])[0, 0] for one in (levels, curve)]
    by_levels = variances[0] > variances[1]
    if evidence.fringes:
        shifts = boundary_shifts(FALLOFF_PX)
        part = central_crop(evidence)
        noise = shared_charge(part, shifts)
        known = None if noise is None else (noise.size, noise.variance)
        sizes, covariance = fit_response(part, level, shifts, known)
        why = "second and third harmonic of the fringes in the residuals"
    elif levels is not None and by_levels:
        sizes, covariance = levels
        why = "flat levels that are not proportional to the exposure time"
    elif curve is not None:
        sizes, covariance = curve
        why = "flat noise that is not proportional to the level"
    else:
        return None
    measured = ladder(evidence) if by_levels else transfer_curve(evidence)
    top = level if evidence.fringes or measured is None else measured.top
    return _Polynomial(level, sizes[:2], covariance[:2, :2], why, top)


def _size(charge: float, change: float, error: float) -> dict[str, object]:
    """`Estimate.size` of a response from its deviation at a charge, all in e-."""
    at = f"{float(f'{charge:.2g}'):.0f} e-"
    return {
        "value": float(change / charge),
        "error": float(error / charge),
        "unit": "",
        "of": f"off a straight line through low signals, at {at}",
    }


def _size_of_curve(
    curve: Nonlinearity, errors: Sequence[float], by_law_error: float
) -> dict[str, object]:
    """Size of a measured curve at its highest level; ``errors``: of its points, e-."""
    levels = np.array([point.level_e for point in curve.bends[1:]])
    low = levels[levels < levels[0] + LOW * np.ptp(levels)]
    # Fringes determine neither factor nor offset of the charge: low signals define them.
    factor, offset = np.polyfit(low, curve.response(low.astype(np.float32)), 1)
    top = factor * levels[-1] + offset
    unit = 10.0 ** (np.floor(np.log10(top)) - 1)
    top = np.floor(top / unit) * unit  # as reported
    signal = float(curve.response(np.array([(top - offset) / factor], np.float32))[0])
    error = np.hypot(by_law_error * top, errors[len(levels)])
    return _size(top, signal - top, error)


def _bends(
    evidence: Evidence, response: Callable[[F32], F32], chi2_of_polynomial: float
) -> tuple[tuple[tuple[CurvePoint, ...], list[float]] | None, Agreement]:
    """Points of the response on top of a polynomial, errors (or None); the sets' agreement."""
    ends = [np.nanquantile(f.electrons[::7], [TAIL, 1 - TAIL]) for f in evidence.fringes.values()]
    low, top = max(min(float(a) for a, _ in ends), 0.0), max(float(b) for _, b in ends)
    seen = low + KNOTS * (top - low)
    knots = np.array([0.0, *seen[seen >= KNOTS[1] * top]])
    change, covariance, agreement = fit_curve(evidence, response, knots)
    chi2 = float(change @ np.linalg.pinv(covariance, rcond=1e-9, hermitian=True) @ change)
    significant = sigmas_of_chi2(chi2, len(change) - 2) > SIGNIFICANT
    if not significant or chi2 < BESIDE * chi2_of_polynomial:
        return None, agreement
    points = zip(knots, [0.0, *change], strict=True)
    bends = tuple(CurvePoint(float(k), float(c)) for k, c in points)
    return (bends, [0.0, *map(float, np.sqrt(np.diag(covariance)))]), agreement


def _straight_on(curve: Nonlinearity, evidence: Evidence) -> list[CurvePoint]:
    """Points up to the brightest flats; beyond the fringes the response is extended linearly."""
    flats = [(s.adu[0] - evidence.bias) * evidence.gain for s in evidence.of_kind("flat")]
    top = curve.bends[-1].level_e
    brightest = max((float(np.quantile(f, 1 - TAIL)) for f in flats), default=0.0)
    if brightest <= top:
        return []
    levels = np.array([top / 2, top, *np.linspace(top, brightest, BEYOND + 1)[1:]], np.float32)
    middle, end = curve.response(levels[:2]).astype(float)
    straight = end + (end - middle) * (levels[2:] / top - 1) * 2
    change = straight - replace(curve, bends=()).response(levels[2:])
    return [CurvePoint(float(at), float(c)) for at, c in zip(levels[2:], change, strict=True)]
