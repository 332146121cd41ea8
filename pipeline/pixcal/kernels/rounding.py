"""Effect of a converter's rounding on noise and on mean levels, and its correction.

A sample is a normal variate rounded to whole steps. If the noise is a step or more, rounding adds
1/12 of a square step to the variance and preserves the mean (Sheppard's correction). For smaller
noise, both depend on the place of the level between two codes (Widrow and Kollar 2008, Quantization
Noise, Cambridge University Press, chapter 4) and are computed exactly from the probability of each
code. Units are steps.
"""

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from pixcal.model.arrays import F64

SHEPPARD = 1 / 12  # variance that rounding adds to noise of a step or more
UNDETERMINED_BELOW = 0.35  # noise below which equal levels do not determine it
SMOOTH = 1.0  # noise above which mean and variance do not depend on the level, to 1e-7
_FRACTIONS = 256
_REACH = 9.0
_HARMONICS = 8
_MIN_SIGMA = 1e-3
_EVERYWHERE = 0.5  # scatter of the levels above which they are uniform between codes
_MIN_KNOWN = 0.05
_SLOPE_STEP = 1e-3


def rounded_moments(level: F64, sigma: float) -> tuple[F64, F64]:
    """Mean and variance (n,) of rounded normals of given levels (n,) and noise."""
    whole = np.rint(level)
    if sigma >= SMOOTH:
        return level, np.full(level.shape, sigma**2 + SHEPPARD)
    reach = int(np.ceil(_REACH * sigma)) + 1
    codes = np.arange(-reach, reach + 1.0)
    edges = np.arange(-reach - 0.5, reach + 1)
    below = ndtr((edges - (level - whole)[..., None]) / max(sigma, _MIN_SIGMA))
    chance = np.diff(below, axis=-1)
    mean = chance @ codes
    return whole + mean, np.asarray(chance @ codes**2 - mean**2)


def level_before_rounding(mean: F64, sigma: float) -> F64:
    """Levels whose rounded samples have given means, for a given noise before rounding."""
    if sigma >= SMOOTH:
        return mean
    level = np.linspace(-0.5, 0.5, _FRACTIONS + 1)
    of_level, _ = rounded_moments(level, sigma)
    whole = np.rint(mean)
    return np.asarray(whole + np.interp(mean - whole, of_level, level))


def noise_before_rounding(
    variance: float, error: float, means: F64, frames: float
) -> tuple[float, float] | None:
    """Noise before rounding, from the mean variance of pixels after it; and its error.

    None where it is undetermined: noise far below a step, in pixels whose levels all have about the
    same distance from the next change of code. ``variance, error``: variance of a sample, averaged
    over pixels, and its standard error. ``means``: (n,) mean samples of such pixels over a number
    of ``frames``.
    """
    if variance > SMOOTH**2 + SHEPPARD:
        sigma = float(np.sqrt(variance - SHEPPARD))
        return sigma, error / (2 * sigma)
    off = means - np.median(means)
    usual = off[np.abs(off) <= 3 * np.std(off)]
    spread = float(np.var(usual)) - variance / frames - SHEPPARD
    everywhere = spread > _EVERYWHERE**2
    least = _MIN_SIGMA if everywhere else UNDETERMINED_BELOW
    places = np.zeros(_HARMONICS) if everywhere else _harmonics(means, variance / frames)
    level = np.arange(_FRACTIONS) / _FRACTIONS

    def expected(sigma: float) -> float:
        at = level if everywhere else level_before_rounding(level, sigma)
        own = np.fft.rfft(rounded_moments(at, sigma)[1]).real / _FRACTIONS
        return float(own[0] + 2 * own[1 : _HARMONICS + 1] @ places)

    low, high = least, 2 * SMOOTH
    if not expected(low) < variance < expected(high):
        return None
    sigma = float(brentq(lambda s: expected(s) - variance, low, high, xtol=1e-6))
    slope = (expected(sigma + _SLOPE_STEP) - expected(sigma)) / _SLOPE_STEP
    # The number of pixels near a change of code varies by chance.
    chance = np.var(rounded_moments(level, sigma)[1]) / len(means) if everywhere else 0.0
    return (sigma, float(np.hypot(error, np.sqrt(chance))) / slope) if slope > 0 else None


def _harmonics(means: F64, noise: float) -> F64:
    """Mean cosines of the levels at harmonics of a step, corrected for the noise of the means."""
    order = np.arange(1, _HARMONICS + 1)
    turns = np.cos(2 * np.pi * order[:, None] * means).mean(axis=1)
    kept = np.exp(-2 * np.pi**2 * order**2 * noise)
    return np.where(kept > _MIN_KNOWN, np.clip(turns / kept, -1, 1), 0.0)
