"""Compiled transfer of charge out of the pixels, which leaves some of it behind."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def left_behind(charge: F32, share: F32, normal: F32, out: F32) -> None:
    """Electrons that stay in each pixel, each by its own chance: binomial, as a normal variate.

    Parameters
    ----------
    charge : (y, x) float32
        e-.
    share : (y, x) float32
        Chance of an electron.
    normal : (y, x) float32
        Standard normals; zero for the mean.
    out : (y, x) float32
        e-, from zero to the charge.
    """
    zero, one = np.float32(0), np.float32(1)
    for y in range(charge.shape[0]):
        for x in range(charge.shape[1]):
            mean = share[y, x] * charge[y, x]
            scatter = np.sqrt(max(mean * (one - share[y, x]), zero))
            out[y, x] = min(max(mean + scatter * normal[y, x], zero), max(charge[y, x], zero))
