"""Response of the pixel and its amplifier that is not a straight line."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import Evidence
from pixcal.estimators.middle import middle
from pixcal.estimators.neighbours import shared_charge
from pixcal.estimators.response import fit_response
from pixcal.kernels.boundaries import boundary_shifts
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

FALLOFF_PX = 0.5
"""Of the shift of boundaries by the brighter-fatter effect beside the response."""

MIN_RUNGS = 3
"""Fewest levels of flats that tell a curve from a line through nothing."""

_TURNS = 30
_SATURATED = 1e-3
_OTHER_ORDER = 4


@dataclass(frozen=True)
class Nonlinearity(Effect):
    """Signal ``S (1 + quadratic u + cubic u²)`` of a charge S, with ``u = S / level_e``.

    It is not linear in the intensity, so maps alone tell neither what it does nor what would be
    without it (the offsets hardly change; harmonics of the phase are left in the residuals);
    `linearised` undoes it on samples.
    """

    name = "nonlinearity"
    title = "response that is not a straight line"
    stage = Stage.SIGNAL
    domains = ("intensity",)
    strengths = ("quadratic", "cubic")
    told_by = ("ladder",)
    quick = False
    sources = (
        "Rousset et al., table 1: 2 % linearity error of the GIGAPYX-4600 (design/paper.txt)",
        "Janesick, Photon Transfer (SPIE 2007), chapter 7: below 1 % of the source follower (V/V), "
        "more of the sense node, whose capacitance grows with the charge (V/e-)",
    )

    quadratic: float = quantity(
        -0.015, low=-0.3, high=0.3, doc="relative deviation at level_e from the first power of u"
    )
    cubic: float = quantity(
        -0.005, low=-0.3, high=0.3, doc="relative deviation at level_e from the second power of u"
    )
    level_e: float = quantity(
        50_000.0, unit="e-", above=0, high=1e7, doc="where the deviations are given: the full well"
    )

    @property
    def turns_at(self) -> float:
        """Level (u) from which the response no longer rises; infinite when it always does."""
        roots = np.roots([3 * self.cubic, 2 * self.quadratic, 1.0])
        rising = [float(r.real) for r in roots if abs(r.imag) < 1e-12 and r.real > 0]
        return min(rising, default=np.inf)

    def check(self, bench: Bench) -> None:
        """As in `Effect.check`."""
        well = bench.detector.full_well_e
        if well is not None and well > self.turns_at * self.level_e:
            raise InputError(
                f"effects.nonlinearity: the response no longer rises from "
                f"{self.turns_at * self.level_e:.0f} e- up, below full_well_e ({well:g}); give "
                "smaller deviations"
            )

    def response(self, charge: F32) -> F32:
        """Signal of a charge, e-; where the polynomial would fall again it stays at its top."""
        u = np.minimum(charge / np.float32(self.level_e), np.float32(self.turns_at))
        bent = u * (1 + u * (np.float32(self.quadratic) + np.float32(self.cubic) * u))
        return np.asarray(bent * np.float32(self.level_e), np.float32)

    def linearised(self, signal: F32) -> F32:
        """Charge that gives a signal, e-: the inverse of `response`, by Newton's method.

        Signals beyond the top of the response give the charge at the top; NaN stays NaN.
        """
        top = min(self.turns_at, 1e3)
        wanted = np.asarray(signal, float) / self.level_e
        wanted = np.minimum(wanted, top * (1 + top * (self.quadratic + top * self.cubic)))
        u = np.minimum(wanted, top)
        for _ in range(_TURNS):
            value = u * (1 + u * (self.quadratic + u * self.cubic))
            slope = 1 + u * (2 * self.quadratic + 3 * u * self.cubic)
            step = (value - wanted) / np.maximum(slope, 1e-3)
            u = np.minimum(u - step, top)
            if not np.any(np.abs(step) > 1e-9):
                break
        return np.asarray(u * self.level_e, np.float32)

    def undo_samples(self, charge: F32) -> F32:
        """As in `Effect.undo_samples`."""
        return self.linearised(charge)

    def signal(self, signal: F32, shot: Shot) -> F32:
        """As in `Effect.signal`."""
        return self.response(signal)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Second and third harmonic of the phase in the residuals; without fringes, flats.

        The levels of flats need exposure times and a lamp that can be trusted to that degree, so
        they count only where there is nothing better. Moving boundaries (brighter-fatter) make a
        second harmonic too: they are fitted beside, and the noise that they make neighbours share
        says how much of them there is, where all fringes have the same spacing.
        """
        level = _full_scale(evidence, cls().level_e)
        ladder = _of_flats(evidence, level)
        if evidence.fringes:
            shifts = boundary_shifts(FALLOFF_PX)
            part = middle(evidence)
            noise = shared_charge(part, shifts)
            known = None if noise is None else (noise.size, noise.variance)
            sizes, covariance = fit_response(part, level, 2, shifts, known)
            why = "second and third harmonic of the fringes' phase in the residuals"
        elif ladder is not None:
            sizes, covariance = ladder
            why = "levels of flats that are not in proportion to their exposure times"
        else:
            return None
        details: dict[str, object] = {}
        if ladder is not None:
            errors = np.sqrt(np.diag(ladder[1]))
            details["of_flats"] = [float(v) for v in ladder[0]]
            details["of_flats_errors"] = [float(v) for v in errors]
        found = sizes[:2] @ np.linalg.solve(covariance[:2, :2], sizes[:2])
        quadratic, cubic = (float(np.clip(v, -0.3, 0.3)) for v in sizes[:2])
        errors = np.sqrt(np.diag(covariance))
        return Estimate(
            cls(quadratic, cubic, level),
            {"quadratic": float(errors[0]), "cubic": float(errors[1])},
            sigmas_of_chi2(float(found), 2),
            why,
            details,
        )


def _full_scale(evidence: Evidence, usual: float) -> float:
    """Where to give the deviations: the usual level, unless the light is of another order."""
    brightest = [float(np.nanquantile(f.electrons[::7], 0.99)) for f in evidence.fringes.values()]
    for stack in evidence.of_kind("flat"):
        brightest.append(float(np.median(stack.adu[0] - evidence.bias)) * evidence.gain)
    top = max(brightest, default=usual)
    return usual if usual / _OTHER_ORDER < top < usual * _OTHER_ORDER else float(f"{top:.1g}")


def _of_flats(evidence: Evidence, level_e: float) -> tuple[F64, F64] | None:
    """(quadratic, cubic) and their covariance from a ladder; None with too few levels."""
    times, means, errors = [], [], []
    if not evidence.steady_lamp:
        return None
    for stack in evidence.of_kind("flat"):
        lost = (stack.adu[:, evidence.good] >= evidence.saturation_adu).mean()
        if stack.exptime_s > 0 and lost < _SATURATED and len(stack.adu) > 1:
            light = (stack.adu - evidence.bias) * evidence.gain
            light -= evidence.dark_rate * stack.exptime_s
            levels = light[:, evidence.good].mean(axis=1)
            times.append(stack.exptime_s)
            means.append(levels.mean())
            errors.append(levels.std(ddof=1) / np.sqrt(len(levels)))
    if len(times) < MIN_RUNGS or min(means) <= 0 or not evidence.dithered:
        return None
    time, mean = np.array(times), np.array(means)
    information = (mean / np.array(errors)) ** 2
    # Where the flat varies, bright pixels bend more than the mean does.
    flat = evidence.flat[evidence.good] / evidence.flat[evidence.good].mean()
    square, cube = (flat**2).mean() / level_e, (flat**3).mean() / level_e**2
    rate, sizes = float((mean / time).mean()), np.zeros(2)
    for _ in range(_TURNS):
        linear = rate * time
        terms = np.stack([linear * square, linear**2 * cube])
        bent = 1 + sizes @ terms
        design = np.stack([np.ones_like(time), *(terms / bent)])
        covariance = np.linalg.inv((design * information) @ design.T)
        step = covariance @ (design @ (information * (mean / (linear * bent) - 1)))
        rate, sizes = rate * (1 + step[0]), sizes + step[1:]
    return sizes, covariance[1:, 1:]
