"""Response of the pixel and its amplifier that is not a straight line."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.effects.gain_error import transfer_curve
from pixcal.estimators.detector.flat_ladder import ladder_response
from pixcal.estimators.detector.neighbours import shared_charge
from pixcal.estimators.detector.response import fit_response
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.diagnosis.middle import middle
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

_TURNS = 30
_NOT_TOLD = 1e-3
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
    acts_at = Stage.SIGNAL
    domains = ("intensity",)
    strengths = ("quadratic", "cubic")
    frames_needed = ("ladder",)
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
        ladder, curve = ladder_response(evidence, level), _of_noise(evidence, level)
        if evidence.fringes:
            shifts = boundary_shifts(FALLOFF_PX)
            part = middle(evidence)
            noise = shared_charge(part, shifts)
            known = None if noise is None else (noise.size, noise.variance)
            sizes, covariance = fit_response(part, level, 2, shifts, known)
            why = "second and third harmonic of the fringes in the residuals"
        elif ladder is not None:
            sizes, covariance = ladder
            why = "flat levels that are not proportional to the exposure time"
        elif curve is not None:
            sizes, covariance = curve
            why = "flat noise that is not proportional to the level"
        else:
            return None
        details: dict[str, object] = {}
        if curve is not None:
            details["of_noise"], details["of_noise_error"] = curve[0][0], curve[1][0, 0] ** 0.5
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


def _of_noise(evidence: Evidence, level_e: float) -> tuple[F64, F64] | None:
    """(quadratic, 0) and covariance from photon transfer; None with too few levels.

    A signal ``S (1 + q u)`` has the variance ``S (1 + 2 q u)²``: over the signal it rises by 3 q u.
    """
    curve = transfer_curve(evidence)
    if curve is None:
        return None
    scale = level_e / (3 * curve.top * curve.share)
    error = scale * curve.slope_error
    return np.array([scale * curve.slope, 0.0]), np.diag([error**2, _NOT_TOLD**2])
