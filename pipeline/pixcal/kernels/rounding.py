"""What a converter's rounding does to noise and to mean levels, and how to take it out again.

A sample is a normal number rounded to whole steps. Where the noise spans a step or more, rounding
adds 1/12 of a square step to the variance and leaves the mean (Sheppard's correction). Below that
both depend on where the level lies between two codes (Widrow and Kollar 2008, Quantization Noise,
Cambridge University Press, chapter 4): from the probability of each code they are computed exactly.
All in units of the step.
"""

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr

from pixcal.model.arrays import F64

SHEPPARD = 1 / 12  # variance that rounding adds to noise of a step or more
UNTOLD = 0.35  # noise below which levels that are all alike do not tell it
SMOOTH = 1.0  # noise from which mean and variance no longer depend on the level, to 1e-7
_FRACTIONS = 256
_REACH = 9.0
_HARMONICS = 8
_MIN_SIGMA = 1e-3
_EVERYWHERE = 0.5  # scatter of the levels from which they lie evenly between codes
_MIN_KNOWN = 0.05
_SLOPE_STEP = 1e-3


def rounded_moments(level: F64, sigma: float) -> tuple[F64, F64]:
    """Mean and variance (n,) of normals of some levels (n,) and a noise, once rounded."""
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
    """Levels whose rounded samples have some means, with this noise before rounding."""
    if sigma >= SMOOTH:
        return mean
    level = np.linspace(-0.5, 0.5, _FRACTIONS + 1)
    of_level, _ = rounded_moments(level, sigma)
    whole = np.rint(mean)
    return np.asarray(whole + np.interp(mean - whole, of_level, level))


def noise_before_rounding(
    variance: float, error: float, means: F64, frames: float
) -> tuple[float, float] | None:
    """Noise that has some variance, on average over pixels, once it is rounded; and its error.

    None where the samples do not tell: noise far below a step, in pixels whose levels all lie at
    about the same distance from the next change of code. ``variance, error``: of a sample, on
    average over the pixels, and its standard error. ``means``: (n,) mean samples of pixels like
    these, over so many ``frames``.
    """
    if variance > SMOOTH**2 + SHEPPARD:
        sigma = float(np.sqrt(variance - SHEPPARD))
        return sigma, error / (2 * sigma)
    spread = _clipped_variance(means) - variance / frames - SHEPPARD
    everywhere = spread > _EVERYWHERE**2
    least = _MIN_SIGMA if everywhere else UNTOLD
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
    # Of so many pixels more or fewer lie near a change of code.
    chance = np.var(rounded_moments(level, sigma)[1]) / len(means) if everywhere else 0.0
    return (sigma, float(np.hypot(error, np.sqrt(chance))) / slope) if slope > 0 else None


def _clipped_variance(values: F64) -> float:
    """Without those beyond three standard deviations."""
    off = values - np.median(values)
    return float(np.var(off[np.abs(off) <= 3 * np.std(off)]))


def _harmonics(means: F64, noise: float) -> F64:
    """Mean cosines of one to some turns a step of the levels, freed of the noise of the means."""
    order = np.arange(1, _HARMONICS + 1)
    turns = np.cos(2 * np.pi * order[:, None] * means).mean(axis=1)
    kept = np.exp(-2 * np.pi**2 * order**2 * noise)
    return np.where(kept > _MIN_KNOWN, np.clip(turns / kept, -1, 1), 0.0)
