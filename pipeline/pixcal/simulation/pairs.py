"""Products of pairs of residuals: sums, their variance, and what the fit takes of them."""

from collections.abc import Sequence

import numpy as np

from pixcal.estimators.test_statistics.fringe_set_data import neighbour_sums
from pixcal.model.arrays import F32, F64, Mask

# offsets (rows, columns) to neighbours in other rows and columns
DIAGONAL = ((1, 1), (1, -1), (1, 2), (1, -2), (2, 1), (2, -1))
FRAMES_APART = (1, 2, 3, 4)


def pair_sums(values: F32, good: Mask) -> F64:
    """Sums (n,) over frames of products of two residuals (t, y, x) over their noise.

    Pairs of columns within rows, of rows within columns, of column sums and of row sums (of
    different rows and columns), neighbours of `DIAGONAL`, samples of `FRAMES_APART`. Values
    without weight are zero.
    """
    count, ny, nx = values.shape
    rows = values.reshape(-1, nx)
    columns = np.ascontiguousarray(values.transpose(0, 2, 1)).reshape(-1, ny)
    within_rows = (rows.T @ rows).astype(float)
    within_columns = (columns.T @ columns).astype(float)
    of_columns, of_rows = values.sum(axis=1, dtype=float), values.sum(axis=2, dtype=float)
    near, _ = neighbour_sums(values, good, DIAGONAL)
    flat = values.reshape(count, -1)
    apart = [
        float(np.einsum("tn,tn->t", flat[n:], flat[:-n]).sum(dtype=float)) if n < count else 0.0
        for n in FRAMES_APART
    ]
    columns_apart = of_columns.T @ of_columns - within_rows
    rows_apart = of_rows.T @ of_rows - within_columns
    return _each_once((within_rows, within_columns), (columns_apart, rows_apart), near, apart)


def pair_variance(frames: int, good: Mask) -> F64:
    """Variance (n,) of `pair_sums` of independent samples of unit variance."""
    there = good.astype(float)
    in_rows, in_columns = there.T @ there, there @ there.T
    columns, rows = there.sum(axis=0), there.sum(axis=1)
    # A pair of two rows of one column is counted twice.
    of_columns = np.outer(columns, columns) - in_rows
    of_rows = np.outer(rows, rows) - in_columns
    of_columns[np.diag_indices(len(columns))] *= 2
    of_rows[np.diag_indices(len(rows))] *= 2
    _, near = neighbour_sums(np.zeros((1, *good.shape), np.float32), good, DIAGONAL)
    apart = [max(frames - n, 0) / frames * there.sum() for n in FRAMES_APART]
    return frames * _each_once((in_rows, in_columns), (of_columns, of_rows), near, apart)


def taken_by_fit(place: F32, covariance: F64, of_time: F32, good: Mask) -> F64:
    """Expected `pair_sums` of independent samples after the fit of frames and pixels.

    place : (j, n) functions of place fitted to each frame, over the noise of good pixels
    covariance : (j, j) of their coefficients in a frame: mean over the frames
    of_time : (k, t) orthonormal functions of time fitted to each pixel
    """
    count, shape = of_time.shape[1], good.shape
    size, axes = np.linalg.eigh(covariance)
    total: F64 | float = 0.0
    for value, axis in zip(size, axes.T, strict=True):
        if value > 0:
            one = np.zeros((1, *shape), np.float32)
            one[0][good] = np.sqrt(value * count) * (axis @ place)
            total = total - pair_sums(one, good)
    taken = np.zeros_like(pair_variance(1, good)) + total
    taken[-len(FRAMES_APART) :] = [
        -float(np.einsum("kt,kt->", of_time[:, n:], of_time[:, :-n])) * np.count_nonzero(good)
        for n in FRAMES_APART
    ]
    return taken


def _each_once(
    within: tuple[F64, F64], between: tuple[F64, F64], near: F64, apart: Sequence[float]
) -> F64:
    """Pairs within a line (matrices without their diagonals), between lines, near, and in time."""
    pairs = [m[np.triu_indices(len(m), k)] for k, own in ((1, within), (0, between)) for m in own]
    return np.concatenate([*pairs, near.sum(axis=1), apart])
