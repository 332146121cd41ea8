"""Bias, dark current, response and linearity of a detector from its combined frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtr, chdtri

from pixcal.kernels.medians import finite_median, median, median_and_sigma
from pixcal.kernels.robust import lit
from pixcal.model.arrays import F64, Mask

MIN_STEPS = 3  # fewest exposure times that separate a line from a curve
# Variance over the signal, in units of the least at lower levels, below which pixels are full. A
# slope lower by a fifth reduces it to 0.64.
COLLAPSED = 0.25
# Least shot noise, relative to the variance without light, of a level that gives a slope; and by
# how many errors it has to exceed that variance.
SHOT, CERTAIN = 0.1, 5.0
_OUTLYING, _CLIPPINGS = 0.01, 3  # probability of a clipped variance; iterations
_TRIMMED = 0.1  # quantile of the pixels below and above which none gives the level of a tile
NEARLY = 0.02  # relative distance from a pixel's own full well within which its signal is not used


@dataclass(frozen=True)
class DarkLine:
    """Signal without light against exposure time, for each pixel; all (y, x) float64."""

    bias: F64  # at exposure zero (ADU); with a single exposure time, the signal at that time
    rate: F64  # dark signal (ADU/s); zero with a single exposure time
    mean_time: F64  # weighted mean of the exposure times (s)
    # per_mean, per_rate: variance of the signal at `mean_time`, and of the rate (s⁻²), for frames
    # of unit variance
    per_mean: F64
    per_rate: F64

    def signal(self, exptime: float) -> F64:
        """Signal without light (ADU) after an exposure time (s)."""
        return self.bias + self.rate * exptime

    def variance(self, exptime: float) -> F64:
        """Variance of `signal`, for frames of unit variance."""
        return self.per_mean + self.per_rate * (exptime - self.mean_time) ** 2


def dark_line(means: Sequence[F64], counts: Sequence[F64], exptimes: Sequence[float]) -> DarkLine:
    """Straight line through combined dark frames (bias frames are the shortest ones).

    ``means``: (y, x) each, ADU, NaN where there is no sample; ``counts``: samples in each;
    ``exptimes``: s. The bias is NaN where a pixel has no sample, the rate where one exposure time
    of two is missing.
    """
    times = np.asarray(exptimes, float)[:, None, None]
    signal = np.stack(means)
    weight = np.where(np.isfinite(signal), np.stack(counts), 0.0)
    signal = np.where(weight > 0, signal, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = weight.sum(axis=0)
        mean_time = (weight * times).sum(axis=0) / total
        mean = (weight * signal).sum(axis=0) / total
        lever = (weight * (times - mean_time) ** 2).sum(axis=0)
        if len(set(exptimes)) > 1:
            rate = (weight * (times - mean_time) * (signal - mean)).sum(axis=0) / lever
            per_rate = 1 / lever
        else:
            rate = per_rate = np.zeros_like(mean)
            mean_time = np.zeros_like(mean)
        return DarkLine(mean - rate * mean_time, rate, mean_time, 1 / total, per_rate)


def usual_rate(rate: NDArray[Any], hot_sigma: float) -> float:
    """Mean dark signal of pixels (any shape) that are not hot; zero if negative or unknown."""
    known = rate[np.isfinite(rate)]
    if not known.size:
        return 0.0
    centre, sigma = median_and_sigma(known)
    usual = np.abs(known - centre) <= hot_sigma * sigma
    return max(float(known[usual].mean()), 0.0) if usual.any() else 0.0


@dataclass(frozen=True)
class ExposureLevel:
    """Combined flats of one exposure time, bias and dark subtracted; maps are (y, x) float64."""

    exptime: float  # seconds; any number above zero with a single exposure time
    frames: int  # how many were combined
    signal: F64  # mean (ADU); NaN where any of the frames is saturated or not finite
    variance: F64  # of `signal` (ADU²)
    noise: float  # variance of one sample of a usual lit pixel (ADU²)


def usual_variance(variance: NDArray[Any], dof: int) -> float:
    """Typical variance of the pixels of a tile, from few samples each; NaN with no ``dof``."""
    if dof < 1:
        return np.nan
    # The median of a variance of few samples is below its mean.
    usual = finite_median(variance) * dof / float(chdtri(dof, 0.5))
    # Variances of few integers are quantised; a mean without outliers is not.
    limit = float(chdtri(dof, _OUTLYING))
    kept = float(chdtr(dof + 2, limit) / chdtr(dof, limit))
    for _ in range(_CLIPPINGS):
        inside = variance[variance * dof <= limit * usual]
        usual = float(inside.mean(dtype=float)) / kept if inside.size else usual
    return usual


def step_levels(steps: Sequence[ExposureLevel]) -> F64:
    """Signal (step,) of the median pixel of the lit ones of a tile; NaN if most are saturated."""
    # All levels use the same pixels, those never saturated but where most are, without the
    # brightest and the dimmest tenth: medians of a colour filter's pixels would jump from colour to
    # colour.
    levels = np.full(len(steps), np.nan)
    seen = lit(np.fmax.reduce([step.signal for step in steps]))
    signal = np.stack([step.signal[seen] for step in steps])
    usable = (
        np.isfinite(signal).mean(axis=1) > 0.5 if seen.any() else np.zeros(len(steps), np.bool_)
    )
    signal = signal[usable]
    common = np.isfinite(signal).all(axis=0)
    if not usable.any() or not common.any():
        return levels
    total = np.array([step.frames for step in steps])[usable] @ signal
    low, high = np.quantile(total[common], (_TRIMMED, 1 - _TRIMMED))
    inner = common & (total >= low) & (total <= high)
    used = inner if inner.any() else common
    # Saturated pixels rank brightest: without them the median would be that of dim pixels.
    usual = median(np.where(common, total, np.inf))
    scale = usual / total[used].mean() if np.isfinite(usual) else 1.0
    levels[usable] = scale * signal[:, used].mean(axis=1)
    return levels


def relative_response(steps: Sequence[ExposureLevel], levels: F64) -> tuple[F64, F64]:
    """Signal (y, x) of flats over that of the tile, and its error; NaN where no step can be used.

    Total charge over total ``levels`` (step,) of `step_levels`: weighted for photon noise.
    """
    charge = variance = light = np.zeros(steps[0].signal.shape)
    for step, level in zip(steps, levels, strict=True):
        used = np.isfinite(step.signal) & np.isfinite(level)
        light = light + np.where(used, step.frames * level, 0.0)
        charge = charge + np.where(used, step.frames * step.signal, 0.0)
        variance = variance + np.where(used, step.frames**2 * step.variance, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return charge / light, np.sqrt(variance) / np.abs(light)


def shot_over_light(
    steps: Sequence[ExposureLevel], levels: F64, read: F64, rate: F64, gain: float
) -> F64:
    """Shot variance of each pixel over its light and dark signal, 1 / gain (ADU/e-); else NaN.

    steps : of flats, with the variance of a sample (ADU²) instead of that of the signal
    levels : (step,) of `step_levels`
    read, rate : (y, x) variance without light (ADU²), and dark signal (ADU/s)
    gain : rough value (e-/ADU), for the weights of the steps
    """
    variance, light = np.zeros((2, *read.shape))
    usual = max(finite_median(read), 0.0)
    for step, level in zip(steps, levels, strict=True):
        if step.frames < 2 or not level > 0:
            continue
        weight = (step.frames - 1) / level / (1 + usual * gain / level) ** 2
        signal = step.signal + np.maximum(rate, 0) * step.exptime
        used = np.isfinite(signal) & np.isfinite(step.variance)
        variance += np.where(used, weight * (step.variance - read), 0.0)
        light += np.where(used, weight * signal, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(variance / light)


def unsaturated(
    steps: Sequence[ExposureLevel], levels: F64, dark_variance: float = 0.0
) -> tuple[Sequence[ExposureLevel], F64]:
    """Flats with the signal of full pixels replaced by NaN, and their levels.

    A full well, maybe far below the highest code, has no photon noise and would outweigh the rest.
    ``levels``: (step,) of `step_levels`. ``dark_variance``: of a usual sample without light (ADU²).
    """
    full, least, most = np.zeros(len(steps), np.bool_), np.inf, 0.0
    for n in np.argsort(levels):
        if not levels[n] > 0:
            continue
        noise = steps[n].noise
        slope = (noise - dark_variance) / levels[n]
        full[n] = slope < COLLAPSED * least < np.inf and noise < most
        most = max(most, noise)
        samples = max(np.isfinite(steps[n].signal).sum() * (steps[n].frames - 1), 1)
        if not full[n] and noise > (1 + max(SHOT, CERTAIN * np.sqrt(2 / samples))) * dark_variance:
            least = min(least, slope)
    if not full.any():
        return steps, levels
    well = np.mean([step.signal for step, ended in zip(steps, full, strict=True) if ended], axis=0)
    # Pixels without light, of a border or an overscan, are never full.
    limit = np.where(np.isfinite(well) & lit(well), (1 - NEARLY) * well, np.inf)
    left = [
        replace(step, signal=np.where(ended | (step.signal > limit), np.nan, step.signal))
        for step, ended in zip(steps, full, strict=True)
    ]
    return left, step_levels(left)


@dataclass(frozen=True)
class Linearity:
    """Linearity of the signal of flats with exposure time."""

    max_deviation: float  # largest relative distance from the straight line
    # (step,) relative distance of each level from the line; NaN for one that is not used
    deviation: F64
    # slope, intercept: of the line (ADU/s; ADU). The intercept absorbs an error common to all
    # exposure times
    slope: float
    intercept: float
    # seconds by which exposures are longer than stated, if that gives the intercept, and its error
    # from the scatter about the line; infinite with `MIN_STEPS` levels
    late: tuple[float, float]


def linearity(exptimes: F64, levels: F64, used: Mask) -> Linearity | None:
    """Line of least squared relative distances through the levels of flats.

    ``exptimes, levels``: (step,) s, and ADU above bias and dark; ``used``: (step,) those without
    saturation. None with fewer than `MIN_STEPS` levels, or one exposure time.
    """
    used = used & (levels > 0)
    if used.sum() < MIN_STEPS or np.ptp(exptimes[used]) == 0:
        return None
    weight = 1 / levels[used]
    design = np.stack([exptimes[used], np.ones(used.sum())], axis=1)
    weighted = design * weight[:, None]
    slope, intercept = np.linalg.lstsq(weighted, np.ones(len(weight)))[0]
    deviation = np.full(len(levels), np.nan)
    line = slope * exptimes[used] + intercept
    deviation[used] = levels[used] / line - 1
    freedom = len(weight) - MIN_STEPS + 1
    scatter = (deviation[used] ** 2).sum() / freedom if len(weight) > MIN_STEPS else np.inf
    # Of the ratio of both: the slope's error hardly counts, as the line begins near zero.
    error = float(np.sqrt(scatter * np.linalg.inv(weighted.T @ weighted)[1, 1]) / slope)
    largest = float(np.abs(deviation[used]).max())
    late = float(intercept / slope), abs(error)
    return Linearity(largest, deviation, float(slope), float(intercept), late)
