"""Effect of a converter's rounding on noise and on mean levels, and its correction.

A sample is a normal variate rounded to whole steps. If the noise is a step or more, rounding adds
1/12 of a square step to the variance and preserves the mean (Sheppard's correction). For smaller
noise, both depend on the place of the level between two codes (Widrow and Kollar 2008, Quantization
Noise, Cambridge University Press, chapter 4) and are computed exactly from the probability of each
code. Units are steps.
"""

import numpy as np
from scipy.special import ndtr

from pixcal.model.arrays import F64

SHEPPARD = 1 / 12  # variance that rounding adds to noise of a step or more
UNDETERMINED_BELOW = 0.35  # noise below which means of few samples do not determine levels
SMOOTH = 1.0  # noise above which mean and variance do not depend on the level, to 1e-7
_FRACTIONS = 256
_REACH = 9.0
_MIN_SIGMA = 1e-3


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
