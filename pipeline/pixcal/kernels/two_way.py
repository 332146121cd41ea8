"""Compiled projections of a two-way table, frames by pixels, onto functions of each.

One turn takes off every frame what it has in common with functions of place, by weighted least
squares, and sums up what every pixel then has in common with functions of time; the next turn
begins by taking that off.
"""

from typing import Any

import numpy as np
from numba import njit

from pixcal.model.arrays import F32, F64

_FAST = {"reassoc", "contract", "nsz"}


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _add_times(a: float, x: Any, y: Any) -> None:
    for i in range(y.size):
        y[i] += a * x[i]


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _product(x: Any, y: Any, out: Any) -> None:
    for i in range(out.size):
        out[i] = x[i] * y[i]


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _dot(x: Any, y: Any) -> float:
    total = np.float32(0)
    for i in range(x.size):
        total += x[i] * y[i]
    return total  # type: ignore[return-value]


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def turn(
    rest: F32, weight: F32, place: F32, covariance: F64, time: F32, share: F32, right: F32
) -> None:
    """One turn of the alternating projections.

    Parameters
    ----------
    rest, weight : (t, n) float32, the table, changed in place, and its weights
    place, time : (j, n), (k, t) float32, functions of place and of time
    covariance : (t, j, j) float64, inverse of each frame's normal matrix for those of place
    share : (k, n) float32, what the pixels have of those of time, to be taken off first
    right : (k, n) float32, written: right-hand sides of what they have of them after the turn
    """
    weighted = np.empty_like(rest[0])
    found = np.empty(len(place))
    right[:] = 0
    for t in range(len(rest)):
        row = rest[t]
        for k in range(len(time)):
            _add_times(-time[k, t], share[k], row)
        _product(weight[t], row, weighted)
        for j in range(len(place)):
            found[j] = _dot(place[j], weighted)
        for j in range(len(place)):
            part = 0.0
            for i in range(len(place)):
                part += covariance[t, j, i] * found[i]
            _add_times(np.float32(-part), place[j], row)
        _product(weight[t], row, weighted)
        for k in range(len(time)):
            _add_times(time[k, t], weighted, right[k])
