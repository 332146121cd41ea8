"""Residuals of a table of frames by pixels after a fit of every frame and every pixel.

For each frame, functions of place are free; for each pixel, functions of time. The weighted table
is projected alternately onto the residuals of the frames and of the pixels.
"""

from typing import Any

import numpy as np

from pixcal.kernels import inner, kernel
from pixcal.model.arrays import F32

_PIXELS = 2048  # pixels of a frame processed together, to stay in the cache


def left_over(
    table: F32, weight: F32, of_place: F32, covariance: F32, of_time: F32, inverse: F32, turns: int
) -> F32:
    """Residuals of a table (t, n) after the fit; zero where a sample has no weight.

    table, weight : (t, n) the weight is one over the variance, or zero
    of_place, covariance : (j, n), (t, j, j) free functions of each frame, and the covariance of
        their coefficients in each frame
    of_time, inverse : (k, t), (k, k, n) free functions of each pixel, and each pixel's inverse
        normal matrix
    """
    rest = np.where(weight > 0, table, np.float32(0))
    # Outside compiled code, where it would take longer to compile.
    sums, share = np.zeros((2, len(of_time), rest.shape[1]), np.float32)
    dots, size = np.empty((2, len(of_place)), np.float32)
    given = rest, weight, of_place, covariance, of_time, inverse, turns
    _project(*given, sums, share, dots, size)
    rest[weight == 0] = 0
    return rest


@kernel(fastmath={"reassoc", "contract"})
def _project(
    rest: Any, weight: Any, of_place: Any, covariance: Any, of_time: Any, inverse: Any, turns: int,
    sums: Any, share: Any, dots: Any, size: Any,
) -> None:  # fmt: skip
    frames, pixels, free, functions = rest.shape[0], rest.shape[1], len(of_place), len(of_time)
    one = np.float32(1)
    for _ in range(turns):
        for i in range(functions):
            for x in range(pixels):
                sums[i, x] = 0
        for t in range(frames):
            for j in range(free):
                dots[j] = 0
            for first in range(0, pixels, _PIXELS):
                stop = first + _PIXELS
                row, own = rest[t, first:stop], weight[t, first:stop]
                for i in range(functions):
                    _subtract(row, of_time[i, t], share[i, first:stop])
                for j in range(free):
                    dots[j] += _dot(of_place[j, first:stop], own, row)
            for i in range(free):
                size[i] = 0
                for j in range(free):
                    size[i] += covariance[t, i, j] * dots[j]
            for first in range(0, pixels, _PIXELS):
                stop = first + _PIXELS
                row, own = rest[t, first:stop], weight[t, first:stop]
                for j in range(free):
                    _subtract(row, size[j], of_place[j, first:stop])
                for i in range(functions):
                    _add_weighted(sums[i, first:stop], of_time[i, t], own, row)
        for i in range(functions):
            for x in range(pixels):
                share[i, x] = 0
            for k in range(functions):
                _add_weighted(share[i], one, inverse[i, k], sums[k])
    for t in range(frames):
        for i in range(functions):
            _subtract(rest[t], of_time[i, t], share[i])


@inner(fastmath={"reassoc", "contract"})
def _dot(a: Any, weight: Any, b: Any) -> Any:
    total = np.float32(0)
    for x in range(len(a)):
        total += a[x] * weight[x] * b[x]
    return total


@inner(fastmath={"reassoc", "contract"})
def _subtract(row: Any, times: Any, what: Any) -> None:
    for x in range(len(row)):
        row[x] -= times * what[x]


@inner(fastmath={"reassoc", "contract"})
def _add_weighted(sums: Any, times: Any, weight: Any, row: Any) -> None:
    for x in range(len(sums)):
        sums[x] += times * weight[x] * row[x]
