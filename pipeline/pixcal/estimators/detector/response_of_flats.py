"""Nonlinear response from flats: a polynomial from their noise, or the response at each level.

The noise of flats (photon transfer) follows the slope of the response; their levels follow the
response itself if the lamp and its exposure times are steady. Where no polynomial of low order
describes them, both together give the charge of each level: signal plus a departure, which a
natural spline interpolates between levels.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import least_squares

from pixcal.estimators.detector.flat_ladder import Ladder, straight_line, unproven_ladder
from pixcal.estimators.detector.straightness import LAMP
from pixcal.estimators.detector.transfer_curve import TransferCurve, transfer_curve
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_chi2
from pixcal.model.arrays import F32, F64

MIN_LEVELS = 6  # fewest levels for more than a polynomial
LOOSE = 0.05  # prior 1-sigma of the departure over the signal
_GAIN = 0.01  # prior relative error of the gain used
_PARTS = 9  # quantiles of the pixels' response
_OTHER_ORDER = 4
_NOT_TOLD = 1e-3
_INVERSIONS = 12  # of the response
_WITH_CUBIC = 6  # fewest levels of flats whose noise shows a cubic term
_LOWEST, _HIGHEST = (-0.3, -0.3), (0.3, 0.3)


@dataclass(frozen=True)
class LadderCurve:
    """Response from level to level."""

    charge: F64  # (n,) e-
    change: F64  # (n,) signal less charge, e-
    steps: F64  # (n, m) shifts of the changes by one sigma of each independent error, e-

    @property
    def error(self) -> F64:
        """Of each change (n,), e-."""
        return np.asarray(np.hypot.reduce(self.steps, axis=1))


def ladder_curve(
    evidence: Evidence, linearised: Callable[[F32], F32] | None = None
) -> LadderCurve | None:
    """The response; None without a ladder, or where a polynomial describes noise and levels.

    ``linearised``: charge (e-) of levels by a significant polynomial of the response.
    """
    curve, unproven = transfer_curve(evidence), unproven_ladder(evidence)
    if curve is None or unproven is None or len(unproven.times) != len(curve.levels):
        return None
    if len(curve.levels) < MIN_LEVELS:
        return None
    off_levels = linearised is not None and _bends_by_levels(unproven, linearised)
    if not off_levels and not _bends_by_noise(curve):
        return None
    return fit_levels(curve, unproven.times, evidence.flat[evidence.good])


def _bends_by_noise(curve: TransferCurve) -> bool:
    """Whether noise over level departs from a second-order polynomial of the level."""
    design = np.stack([(curve.levels / curve.top) ** n for n in range(3)]) / curve.errors
    value = curve.shares / curve.errors
    rest = value - np.linalg.lstsq(design.T, value)[0] @ design
    return sigmas_of_chi2(float(rest @ rest), len(value) - 3) > SIGNIFICANT


def _bends_by_levels(flats: Ladder, linearised: Callable[[F32], F32]) -> bool:
    """Whether levels depart from a polynomial by more than a lamp may cause."""
    charge = linearised(flats.levels.astype(np.float32)).astype(float)
    rest = (charge / straight_line(flats.times, charge, flats.times) - 1) / LAMP
    return sigmas_of_chi2(float(rest @ rest), len(rest) - 2) > SIGNIFICANT


def fit_levels(curve: TransferCurve, times: F64, flat: F64) -> LadderCurve | None:
    """Changes at the levels that fit the noise, and the levels over time (s).

    None where noise and levels disagree: the lamp drifts, or bright pixels have another gain.
    ``flat``: (n,) relative response of the pixels.
    """
    parts = np.quantile(flat / flat.mean(), (np.arange(_PARTS) + 0.5) / _PARTS)
    signal, n = curve.levels[:, None] * parts, len(curve.levels)
    # One knot beyond the highest level: a natural spline has no curvature at its end, knees do.
    above = max(2 * curve.levels[-1] - curve.levels[-2], float(signal.max()))
    knots = np.concatenate([[0.0], curve.levels, [above]])
    # Signals up to the second level are straight: a line through two levels is known by the gain
    # and the offset of exposure times, and no curve that is a line beyond them differs from it.
    unit = LOOSE * knots[3:]

    def rest(sizes: F64) -> F64:
        gain, rate, offset = sizes[:3] * _GAIN
        change = CubicSpline(knots, [0.0, 0.0, 0.0, *sizes[3:] * unit], bc_type="natural")
        charge, slope = signal - change(signal), 1 / (1 - change(signal, 1))
        share = (1 + gain) * (slope**2 * charge).mean(axis=1) / curve.levels
        line = (1 + rate) * curve.top * times / times[-1] + offset * curve.levels[0]
        of_lamp = (charge.mean(axis=1) / line - 1) / LAMP
        return np.concatenate(
            [(curve.shares - share) / curve.errors, of_lamp, sizes[:1], sizes[3:]]
        )

    fit = least_squares(rest, np.zeros(n + 2))
    if sigmas_of_chi2(float(fit.fun[: 2 * n] @ fit.fun[: 2 * n]), n) > SIGNIFICANT:
        return None
    change = np.concatenate([[0.0, 0.0], unit * fit.x[3:]])
    errors = np.linalg.cholesky(np.linalg.inv(fit.jac.T @ fit.jac)[3:, 3:])
    return LadderCurve(knots[1:] - change, change, np.pad(unit[:, None] * errors, ((2, 0), (0, 0))))


def full_scale(evidence: Evidence, usual: float) -> float:
    """Reference level of the deviations: the usual one, unless fringes are of another order."""
    brightest = [float(np.nanquantile(f.electrons[::7], 0.99)) for f in evidence.fringes.values()]
    for stack in evidence.of_kind("flat"):
        brightest.append(float(np.median(stack.adu[0] - evidence.bias)) * evidence.gain)
    top = max(brightest, default=usual)
    alike = evidence.fringes and usual / _OTHER_ORDER < top < usual * _OTHER_ORDER
    return usual if alike else float(f"{top:.1g}")


def response_of_noise(evidence: Evidence, level_e: float) -> tuple[F64, F64] | None:
    """(quadratic, cubic) and covariance from photon transfer; None with too few levels."""
    # A signal ``S (1 + q u)`` has variance ``S (1 + 2 q u)²``; their ratio rises as 1 + 3 q u. The
    # cubic term is zero unless the ratio bends significantly.
    curve = transfer_curve(evidence)
    if curve is None:
        return None
    if (bent := _bent_by_noise(curve)) is not None:
        scales = (level_e / curve.top) ** np.arange(1, 3)
        return bent[0] * scales, bent[1] * np.outer(scales, scales)
    scale = level_e / (3 * curve.top * curve.share)
    error = scale * curve.slope_error
    return np.array([scale * curve.slope, 0.0]), np.diag([error**2, _NOT_TOLD**2])


def _bent_by_noise(curve: TransferCurve) -> tuple[F64, F64] | None:
    """Quadratic and cubic term at the highest level, and covariance; None without a bend."""
    signal = curve.levels / curve.top

    def rest(sizes: F64) -> F64:
        share, quadratic, cubic, read = sizes
        u = signal
        for _ in range(_INVERSIONS):
            u = signal / (1 + quadratic * u + cubic * u**2)
        rise = 1 + 2 * quadratic * u + 3 * cubic * u**2
        ratio = share * rise**2 * u / signal + read * curve.common / curve.levels
        return np.append((ratio - curve.shares) / curve.errors, read)

    if len(signal) < _WITH_CUBIC:
        return None
    bounds = [0.0, *_LOWEST, -np.inf], [np.inf, *_HIGHEST, np.inf]
    fit = least_squares(rest, [curve.share, 0.0, 0.0, 0.0], bounds=bounds)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)[1:3, 1:3]
    if abs(fit.x[2]) < SIGNIFICANT * np.sqrt(covariance[1, 1]):
        return None
    return fit.x[1:3], covariance
