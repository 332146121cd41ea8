"""Dark current of hot pixels that appears in their neighbours."""

from typing import TypeVar

import numpy as np
from scipy.ndimage import maximum_filter

from pixcal.kernels.medians import robust_sigma
from pixcal.model.arrays import F32, F64

HOT = 40.0  # robust standard deviations of the dark current above which a pixel is hot
# pixels around a hot one that may have received some of its charge: at most a share of `SHARED`
HOT_REACH = 2
SHARED = 0.1

Dark = TypeVar("Dark", F32, F64)


def uncoupled(dark: Dark, rng: np.random.Generator) -> Dark:
    """Dark current (y, x), with neighbours of hot pixels redrawn from other pixels' values."""
    rest = dark - np.median(dark)
    spread = robust_sigma(rest)
    brightest = maximum_filter(rest, size=2 * HOT_REACH + 1, mode="nearest")
    beside = (brightest > HOT * spread) & (rest < SHARED * brightest)
    redrawn = dark.copy()
    usual = dark[~beside & (rest <= HOT * spread)]
    if usual.size:
        redrawn[beside] = rng.choice(usual, np.count_nonzero(beside))
    return redrawn
