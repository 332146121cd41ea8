"""Dark current without what hot pixels may have given to their neighbours."""

from typing import TypeVar

import numpy as np
from scipy.ndimage import maximum_filter

from pixcal.model.arrays import F32, F64

HOT = 40.0  # robust standard deviations of the dark current beyond which a pixel is hot
# pixels around a hot one that may have got some of its charge: at most a share of `SHARED`
HOT_REACH = 2
SHARED = 0.1

Dark = TypeVar("Dark", F32, F64)


def uncoupled(dark: Dark, rng: np.random.Generator) -> Dark:
    """Dark current (y, x) where pixels beside hot ones have that of any others.

    Not the median of all: a sum over few neighbours would then be the same in every simulation,
    and that of a real detector, whose pixels differ, would stand out.
    """
    rest = dark - np.median(dark)
    spread = 1.4826 * float(np.median(np.abs(rest)))
    brightest = maximum_filter(rest, size=2 * HOT_REACH + 1, mode="nearest")
    beside = (brightest > HOT * spread) & (rest < SHARED * brightest)
    found = dark.copy()
    if not beside.all():
        found[beside] = rng.choice(dark[~beside & (rest <= HOT * spread)], np.count_nonzero(beside))
    return found
