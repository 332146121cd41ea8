"""Frames whose noise is cut off at code zero: level and noise as they would be without.

A sample is a normal number, rounded to a code; what is negative is read as zero. Mean and variance
of such samples tell level and noise of the normal (a censored one: Cohen 1959, *Technometrics* 1,
217), those of most pixels the noise and that of each pixel its level.
"""

import math
from dataclasses import replace

import numpy as np
from scipy.special import ndtr

from pixcal.kernels.robust import Combined, median_and_sigma
from pixcal.kernels.rounding import SHEPPARD
from pixcal.model.arrays import F64

_LEVELS = np.linspace(-2, 8, 401)  # over the noise
_CUT = 4.0  # mean over noise below which samples are cut off
_FINEST = 20.0  # steps of the noise in which codes are summed up at most
_ROUNDS = 12
_HOT, _NOISY = 6.0, 10.0


def without_cut_off(found: Combined, frames: int, step: float) -> tuple[Combined, float]:
    """Frames without light as they would be without the end of the converter at zero.

    Parameters
    ----------
    found : Combined
        Of some pixels, ADU.
    frames : int
        How many were combined.
    step : float
        Of the samples (ADU).

    Returns
    -------
    found : Combined
        With other means and variances, where most pixels' noise is cut off.
    factor : float
        Variance of a sample over that of the samples as they are.
    """
    known = np.isfinite(found.mean) & np.isfinite(found.variance)
    if not known.any():
        return found, 1.0
    # Means, for medians are those of no normal; without hot and noisy pixels.
    centre, spread = median_and_sigma(found.mean[known])
    most = (1 + _NOISY * math.sqrt(2 / (frames - 1))) * float(np.median(found.variance[known]))
    usual = known & (abs(found.mean - centre) <= _HOT * spread) & (found.variance <= most)
    level, variance = float(found.mean[usual].mean()), float(found.variance[usual].mean())
    if not variance > 0 or not level < _CUT * math.sqrt(variance):
        return found, 1.0
    noise = math.sqrt(variance)
    for _ in range(_ROUNDS):
        means, variances = _of_cut_off(_LEVELS * noise, noise, step)
        at = np.interp(level / math.sqrt(variance), means / np.sqrt(variances), _LEVELS)
        noise *= math.sqrt(variance / float(np.interp(at, _LEVELS, variances)))
    levels = np.interp(found.mean, means, _LEVELS * noise)
    seen = np.interp(levels, _LEVELS * noise, variances)
    whole = noise**2 + SHEPPARD * step**2
    above = found.mean > means[-1]
    corrected = replace(
        found,
        mean=np.where(above, found.mean, levels),
        variance=np.where(above, 1.0, whole / seen) * found.variance,
    )
    return corrected, whole / float(np.nanmean(np.where(above, whole, seen)))


def _of_cut_off(levels: F64, noise: float, step: float) -> tuple[F64, F64]:
    """Means and variances (n,) of samples of some levels (n,); ADU."""
    step = max(step, noise / _FINEST)
    codes = np.arange(1, math.ceil((levels[-1] + 6 * noise) / step) + 2)
    # A code is reached from half a step below on.
    reached = ndtr((levels[:, None] - step * (codes - 0.5)) / noise)
    mean = step * reached.sum(axis=1)
    square = step**2 * (reached @ (2 * codes - 1.0))
    return mean, square - mean**2
