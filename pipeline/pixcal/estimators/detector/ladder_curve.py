"""Response at each level of a ladder of flats, if no polynomial of low order describes it.

The noise of flats follows the slope of the response; their levels follow the response itself if the
lamp and its exposure times are steady. Together they give the charge of each level: signal plus a
departure, which a natural spline interpolates between levels.
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
