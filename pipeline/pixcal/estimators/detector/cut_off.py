"""Frames whose noise is clipped at the lowest code: level and noise without clipping.

A sample is a normal number rounded to a code; lower values are read as the lowest code. Mean and
variance of such samples give level and noise of the normal (censored: Cohen 1959, *Technometrics*
1, 217). Each pixel has its own level; most have the same noise, which is fitted to the mean of
their variances. Maximum likelihood with a level per pixel would bias the noise low, by about the
loss of one frame (Neyman and Scott 1948, *Econometrica* 16, 1).
"""

import math
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from pixcal.kernels.medians import median_and_sigma
from pixcal.kernels.robust import Combined
from pixcal.kernels.rounding import SHEPPARD
from pixcal.model.arrays import F64

_LEVELS = np.linspace(-4, 8, 481)  # over the noise
_CUT = 4.0  # mean over noise below which samples are clipped
_FINEST = 20.0  # most steps per noise in which codes are summed
_RANGE = 0.3, 5.0  # least and largest noise over that of the samples as they are
_HOT, _NOISY = 6.0, 10.0


def without_cut_off(
    dark: Combined, frames: int, step: float, lowest: float = 0.0
) -> tuple[Combined, float]:
    """Frames without light, corrected for clipping at their ``lowest`` code (ADU).

    ``dark``: of some pixels, ADU; ``step``: of the samples, ADU. Returns them with corrected means
    and variances, if the noise of most pixels is clipped, and the ratio of the true variance of a
    sample to that of the clipped samples.
    """
    if lowest:
        above_lowest = replace(dark, mean=dark.mean - lowest)
        corrected, factor = without_cut_off(above_lowest, frames, step)
        return replace(corrected, mean=corrected.mean + lowest), factor
    known = np.isfinite(dark.mean) & np.isfinite(dark.variance)
    if not known.any():
        return dark, 1.0
    # Means, as medians do not follow the model; without hot and noisy pixels.
    centre, spread = median_and_sigma(dark.mean[known])
    spread = max(spread, math.sqrt(float(dark.variance[known].mean()) / frames))
    most = (1 + _NOISY * math.sqrt(2 / (frames - 1))) * float(np.median(dark.variance[known]))
    usual = known & (abs(dark.mean - centre) <= _HOT * spread) & (dark.variance <= most)
    mean, variance = dark.mean[usual], dark.variance[usual]
    sample = math.sqrt(float(variance.mean())) if usual.any() else 0.0
    if not 0 < float(mean.mean()) < _CUT * sample:
        return dark, 1.0

    # Means of few frames scatter more than the levels: shrunk so that their scatter is that of the
    # levels, and further, towards the mean of all, for each pixel's likely level.
    common, true = float(mean.mean()), 0.0
    if mean.var() > 0:
        true = max(1 - sample**2 / frames / float(mean.var()), 0.0)
    alike = np.where(usual, common + math.sqrt(true) * (dark.mean - common), dark.mean)
    likely = np.where(usual, common + true * (dark.mean - common), dark.mean)

    def excess(noise: float) -> float:
        table = _of_cut_off(_LEVELS * noise, noise, step)
        return float(np.interp(alike[usual], *table).mean() - sample**2)

    low, high = (end * sample for end in _RANGE)
    if not excess(low) < 0 < excess(high):
        return dark, 1.0
    noise = float(brentq(excess, low, high, rtol=1e-4))
    means, variances = _of_cut_off(_LEVELS * noise, noise, step)
    above = dark.mean > means[-1]
    whole = noise**2 + SHEPPARD * step**2
    seen = np.interp(likely, means, variances)
    corrected = replace(
        dark,
        mean=np.where(above, dark.mean, np.interp(likely, means, _LEVELS * noise)),
        variance=np.where(above, 1.0, whole / seen) * dark.variance,
    )
    expected = np.interp(alike, means, variances)
    return corrected, whole / float(np.nanmean(np.where(above, whole, expected)))


def _of_cut_off(levels: F64, noise: float, step: float) -> tuple[F64, F64]:
    """Means and variances (n,) of clipped samples at levels (n,); ADU."""
    step = max(step, noise / _FINEST)
    codes = np.arange(1, math.ceil((levels[-1] + 6 * noise) / step) + 2)
    # A code begins half a step below its value.
    reached = ndtr((levels[:, None] - step * (codes - 0.5)) / noise)
    mean = step * reached.sum(axis=1)
    square = step**2 * (reached @ (2 * codes - 1.0))
    return mean, square - mean**2
