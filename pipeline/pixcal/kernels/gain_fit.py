"""Gain from a photon-transfer curve whose curvature is inferred from its points.

Variance is ``offset + level (c_0 + c_1 u + c_2 u² + c_3 u³ + c_4 u⁴)``, with u the level over the
highest one; the gain is ``1 / c_0``. A nonlinear response, or charge that neighbours share in
proportion to the level, curves it by an unknown amount: c_1 to c_4, relative to c_0, are normal
numbers of a common size, and the size is zero or any below one. The gain is the average over the
sizes, each with the weight of its evidence (MacKay 1992, *Neural Computation* 4, 415); the
remaining uncertainty of the curve is in its error.

Frames without light may differ in noise from flats: a camera clips black, or reads dark pixels with
another amplifier (dual gain), up to a level between two flats. The average includes curves without
them, and curves with a step between two levels, with a small prior probability.

If levels cross such a step smoothly, none of these terms describes it. If points deviate from the
curve by far more than their noise, lower ranges are fitted too, and the gain is that of the
best-determined range.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.special import chdtrc

from pixcal.model.arrays import F64

LADDER = 4  # groups of flats from which the curve may be curved

_TERMS = 4  # terms of curvature
_CHANCE_APART = 1e-4  # prior probability that noise without light is not on the curve
_WIDTHS = 6  # prior errors of the noise at level zero that are tried then
_NONE = 1e-6  # rise of the noise, over the error of that without light, that is effectively zero
_STRAIGHT = 1e-6  # size of terms that is effectively zero
_SIZES = np.concatenate([[_STRAIGHT], np.geomspace(1e-3, 1.0, 13)])
_CHANCES = np.concatenate([[0.5], np.full(13, 0.5 / 13)])
_CURVED = 0.05  # probability of a straight line below which the curve is curved
# points beyond the terms, which separate a curve from points off a line
_SPARE = 3
_ITERATIONS = 5
_OFF_CURVE = 1e-6  # chance of a misfit beyond which a curve may have a step
_FEWEST = 2  # points below a step: with the noise without light, they check each other
_SHORTER = 1.5  # factor between the ranges that are tried then
_GAP = 1.2  # least factor between two levels that may lie on either side of a step


@dataclass(frozen=True)
class GainFit:
    """Gain by photon transfer."""

    gain: float  # e-/ADU
    # 1 sigma, e-/ADU; widened where the points leave the curve by more than their noise
    error: float
    chi2_reduced: float  # of the points about the curve
    levels: tuple[float, float]  # lowest and highest level used, ADU
    # at level zero, from the curve and the measurement together; error
    read_variance: tuple[float, float]
    # slope at the highest level (variance over level) relative to that at zero, less one; zero
    # where a straight line fits
    curved: float = 0.0
    # lags whose covariances were added to the variance, with the significance of each: see
    # `photon_transfer.add_neighbours`
    neighbours: Mapping[tuple[int, int], float] = field(default_factory=dict)
    # whether noise is common to pixels however far apart: the lamp does not light all at once
    uneven: bool = False
    # chance of points as far off the curve
    chance: float = 1.0
    step: bool = False  # whether the curve has a step above the levels used, as of a dual gain
    # whether the curve leaves out the noise without light, which is not on it
    without_dark: bool = False
    # F², variance of the noise over that of the light, and its error: electrons may be multiplied
    excess: tuple[float, float] = (1.0, 0.0)

    @property
    def of_electrons(self) -> tuple[float, float]:
        """Gain by which collected electrons are counted, and its error, e-/ADU."""
        factor, error = self.excess
        return factor * self.gain, math.hypot(factor * self.error, error * self.gain)


def fit_gain(
    sums: F64,
    read_variance: tuple[float, float],
    highest: float,
    *,
    level_error: float = 0.0,
    uneven: float = 0.0,
    common: float = 0.0,
    straight: bool = False,
    without_dark: bool | None = None,
) -> GainFit | None:
    """Fit the curve through the points of variance against level, from the read noise on.

    The weights come from the curve itself: measured variances that are low by chance would weigh
    more. None when nothing is above the read noise.

    sums : (N_BINS, 3) of `photon_transfer.add_neighbours`
    read_variance : variance at level zero and its error, ADU²
    highest : highest level to use, ADU
    level_error : common error of all levels, ADU, as the bias drifts
    uneven : spectral density at low frequency of the converter's deviation from its mean line,
        ADU³: with noise of sigma the local slope varies by rms ``sqrt(uneven / (4 sqrt(pi)
        sigma³))``, and the variance by twice that
    common : relative error of the noise, the same at all levels
    straight : fit a line only: within few flats the level changes from place to place, as the
        amplifiers do
    without_dark : leave out the noise without light; by default where it is not on the curve
    """
    given = sums, read_variance, level_error, uneven, straight

    def up_to(highest: float) -> GainFit | None:
        fit = _fit_range(*given, highest, without_dark)
        if fit and fit.without_dark and not fit.chance > _OFF_CURVE:
            # Flats that lie on no curve cannot show which points belong to it.
            fit = _fit_range(*given, highest, bool(without_dark))
        return fit and replace(fit, error=math.hypot(fit.error, common * fit.gain))

    whole = up_to(highest)
    if straight or (whole is not None and whole.chance > _OFF_CURVE):
        return whole
    level = np.divide(sums[:, 1], sums[:, 0], where=sums[:, 0] > 0, out=np.zeros(len(sums)))
    level = level[(level > 0) & (level <= highest)]
    best, top = whole, float(level.max(initial=0.0)) / _SHORTER
    while np.count_nonzero(level <= top) >= _FEWEST:
        fit = up_to(top)
        better = fit is not None and (best is None or fit.error < best.error)
        if fit is not None and better and fit.chance > _OFF_CURVE:
            best = replace(fit, step=True)
        top /= _SHORTER
    return best


def _fit_range(
    sums: F64,
    read_variance: tuple[float, float],
    level_error: float,
    uneven: float,
    straight: bool,
    highest: float,
    without_dark: bool | None,
) -> GainFit | None:
    dof = sums[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        level, variance = sums[:, 1] / dof, sums[:, 2] / dof
    used = (dof > 0) & (level > 0) & (level <= highest)
    dof, level, shot = dof[used], level[used], variance[used] - read_variance[0]
    if not used.any() or not (dof * shot).sum() > 0:
        return None
    top = float(level.max())
    terms = 0 if straight else min(_TERMS, max(len(level) - _SPARE, 0))
    sizes = _SIZES if terms else _SIZES[:1]
    several = not straight and len(level) >= 2 * _SPARE
    apart = _CHANCE_APART * several if without_dark is None else float(without_dark)
    below = level[:-1][level[1:] > _GAP * level[:-1]] if 0 < apart < 1 else level[:0]
    curve = np.stack([level * (level / top) ** n for n in range(terms + 1)])
    design = np.stack([np.ones_like(level), *curve, *(level > below[:, None])])
    slope, chi2 = float((dof * shot).sum() / (dof * level).sum()), 1.0
    expected = slope * level
    for _ in range(_ITERATIONS):
        whole = np.maximum(expected, 0) + read_variance[0]
        weight = 1 / (2 * whole**2 / dof + uneven * np.sqrt(whole / np.pi))
        normal, right = (design * weight) @ design.T / chi2, design @ (weight * shot) / chi2
        narrow = math.hypot(read_variance[1], level_error * slope)
        jumps, before = _jumps(narrow, float((slope * level).max()), apart, len(below))
        information = _information(jumps, sizes * slope, terms)
        means, covariances, evidence = _posterior(normal, right, information)
        share = np.outer(before, _CHANCES[: len(sizes)]) * np.exp(evidence - evidence.max())
        share /= share.sum()
        mean = np.tensordot(share, means, 2)
        slope, expected = float(mean[1]), mean @ design
        if not slope > 0 or not mean[1 : terms + 2].sum() > 0:
            return None
        # About the best of the most flexible curves: neither curvature nor a step is scatter.
        freedom = len(level) - np.einsum("...ij,ij", covariances, normal)
        rest = (shot - means[:, -1] @ design) ** 2 @ weight
        chi2 = max(1.0, float((rest / np.maximum(freedom[:, -1], 1)).min()))
    spread = np.diagonal(covariances, axis1=-2, axis2=-1) + (means - mean) ** 2
    of_zero, scatter = np.sqrt(np.tensordot(share, spread, 2)[:2])
    misfit, free = float(weight @ (shot - expected) ** 2), max(float((share * freedom).sum()), 1.0)
    apart_at = share.sum(axis=1) @ (jumps > narrow)
    step = bool(apart_at[1:].sum() > 0.5)
    return GainFit(
        1 / slope,
        float(scatter) / slope**2,
        misfit / free,
        (float(level.min()), float(below[np.argmax(apart_at[1:])]) if step else top),
        (read_variance[0] + float(mean[0]), float(of_zero)),
        float(mean[2 : terms + 2].sum() / slope) if share[:, 0].sum() < _CURVED else 0.0,
        chance=float(chdtrc(free, misfit)),
        step=step,
        without_dark=bool(apart_at[0] > 0.5),
    )


def _jumps(narrow: float, highest: float, apart: float, steps: int) -> tuple[F64, F64]:
    """Errors (n, 1 + steps) of the variance at level zero and of its rise at each step; priors.

    For pixels read in another way, it is only known that noise grows with light. At most one of the
    errors is wide.
    """
    wide = np.geomspace(narrow, max(highest, 2 * narrow), _WIDTHS + 1)[1:]
    variances = np.full((1 + steps, _WIDTHS, 1 + steps), _NONE * narrow)
    variances[..., 0] = narrow
    variances[range(1 + steps), :, range(1 + steps)] = wide
    usual = np.where(np.arange(1 + steps) > 0, _NONE, 1.0) * narrow
    chances = np.append(1 - apart, np.full((1 + steps) * _WIDTHS, apart / _WIDTHS / (1 + steps)))
    return np.vstack([usual, variances.reshape(-1, 1 + steps)])[chances > 0], chances[chances > 0]


def _information(jumps: F64, sizes: F64, terms: int) -> F64:
    """Prior information (n, size, coefficient): ``jumps`` (n, 1 + steps), sizes of the terms."""
    information = np.zeros((len(jumps), len(sizes), terms + 1 + jumps.shape[1]))
    information[:, :, 0] = jumps[:, None, 0] ** -2
    information[:, :, 2 : terms + 2] = sizes[:, None] ** -2
    information[:, :, terms + 2 :] = jumps[:, None, 1:] ** -2
    return information


def _posterior(normal: F64, right: F64, information: F64) -> tuple[F64, F64, F64]:
    """Means, covariances and log evidences of coefficients about zero, of prior information."""
    total = normal + information[..., None] * np.eye(len(right))
    scale = 1 / np.sqrt(np.diagonal(total, axis1=-2, axis2=-1))
    both = scale[..., None] * scale[..., None, :]
    covariances = np.linalg.inv(total * both) * both
    means = covariances @ right
    known = np.log(information, where=information > 0, out=np.zeros_like(information)).sum(axis=-1)
    evidence = means @ right + known + np.linalg.slogdet(covariances)[1]
    return means, covariances, evidence / 2
