"""Residuals of a table of frames by pixels after a fit of every frame and every pixel.

For each frame, functions of place are free; for each pixel, functions of time. The weighted table
is projected alternately onto the residuals of the frames and of the pixels.
"""

import numpy as np

from pixcal.model.arrays import F32

_FRAMES = 16  # processed together, to stay in the cache


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
    share = np.zeros((len(of_time), rest.shape[1]), np.float32)
    for _ in range(turns):
        sums = np.zeros_like(share)
        for first in range(0, len(rest), _FRAMES):
            frames = slice(first, first + _FRAMES)
            rows, own, times = rest[frames], weight[frames], of_time[:, frames]
            rows -= times.T @ share
            dots = (own * rows) @ of_place.T
            rows -= np.einsum("tij,tj->ti", covariance[frames], dots) @ of_place
            sums += times @ (own * rows)
        share = np.einsum("ikn,kn->in", inverse, sums)
    rest -= of_time.T @ share
    rest[weight == 0] = 0
    return rest
