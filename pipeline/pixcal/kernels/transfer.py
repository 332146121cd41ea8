"""Compiled transfer of charge out of the pixels, which leaves some of it behind."""

import numpy as np
from numba import njit

from pixcal.model.arrays import F32


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def left_behind(charge: F32, share: F32, begins: F32, weights: F32, normal: F32, out: F32) -> None:
    """Electrons that stay in each pixel, each by its own chance: binomial, as a normal variate.

    Parameters
    ----------
    charge : (y, x) float32, e-
    share : (y, x) float32, chance of an electron, on the mean
    begins, weights : (band,) float32, where bands of the charge begin (e-), and the chance in each
        over the mean one
    normal : (y, x) float32, standard normals; zero for the mean
    out : (y, x) float32, written, e-
    """
    zero, one = np.float32(0), np.float32(1)
    for y in range(charge.shape[0]):
        for x in range(charge.shape[1]):
            told = zero
            for band in range(begins.size):
                if charge[y, x] > begins[band] or band == 0:
                    part = charge[y, x]
                    if band + 1 < begins.size:
                        part = min(part, begins[band + 1])
                    told += weights[band] * (part - begins[band])
            mean = share[y, x] * told
            scatter = np.sqrt(max(mean * (one - share[y, x]), zero))
            out[y, x] = min(max(mean + scatter * normal[y, x], zero), max(charge[y, x], zero))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def fill_traps(taken: F32, keep: float, most: float, lost: F32, released: F32) -> None:
    """What traps take from each frame and give back, as they fill and empty.

    Of what they hold they keep a part from frame to frame; they take a frame's share of the charge
    as long as there is room.

    Parameters
    ----------
    taken : (t, n) float32, charge that empty traps would take, e-; they are empty at first
    keep, most : part of what is held that stays for another frame; what they hold at most, e-
    lost, released : (t, n) float32, written: net loss, and what comes out with each frame, e-
    """
    part, full = np.float32(keep), np.float32(most)
    held = np.zeros(taken.shape[1], np.float32)
    for t in range(taken.shape[0]):
        for n in range(taken.shape[1]):
            left = part * held[n]
            after = min(left + taken[t, n], full)
            lost[t, n] = after - held[n]
            released[t, n] = held[n] - left
            held[n] = after
