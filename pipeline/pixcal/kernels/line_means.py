"""Subtract the common noise of each row and each column."""

from functools import lru_cache

import numpy as np
from scipy.ndimage import uniform_filter1d

from pixcal.model.arrays import F32, Mask

REACH = 5  # distance up to which pixels stay uncorrelated, px
_NEAR = 2 * REACH + 1


def without_line_means(noise: F32, used: Mask) -> F32:
    """Noise (t, y, x) minus the means of its rows and of its columns; zero where not used.

    Subtraction of a plain mean of n pixels would correlate each pair by -1 / n. Here pixels within
    `REACH` of a pixel have half weight in its mean: white noise keeps its variance, and near pixels
    stay uncorrelated, to second order in 1 / n. ``used``: (y, x) pixels of the means.
    """
    weight = used.astype(np.float32)
    residual = noise * weight
    for axis, count in zip((-1, -2), _counts(used.tobytes(), used.shape), strict=True):
        residual = (residual - _half_near(residual, axis) / count) * weight
    return np.asarray(residual, np.float32)


@lru_cache(maxsize=8)  # stacks of frames have the same pixels
def _counts(used: bytes, shape: tuple[int, int]) -> tuple[F32, F32]:
    """Pixels of the mean of each pixel's row, and of its column, at least one."""
    weight = np.frombuffer(used, np.bool_).reshape(shape).astype(np.float32)
    rows, columns = (np.maximum(_half_near(weight, axis), 1) for axis in (-1, -2))
    return rows, columns


def _half_near(values: F32, axis: int) -> F32:
    """Sum along an axis around each place, with half weight for near values."""
    if axis == -1:
        near = uniform_filter1d(values, _NEAR, mode="constant") * np.float32(_NEAR / 2)
    else:
        near = np.empty_like(values)
        for frame, own in zip(_frames(values), _frames(near), strict=True):
            # Whole rows, of one frame in the cache: scipy takes eight times as long along columns.
            padded = np.pad(frame, ((REACH, REACH), (0, 0)))
            own[:] = padded[: len(own)]
            for row in range(1, _NEAR):
                own += padded[row : row + len(own)]
            own /= 2
    return np.asarray(values.sum(axis=axis, keepdims=True) - near)


def _frames(values: F32) -> F32:
    return values.reshape(-1, *values.shape[-2:])
