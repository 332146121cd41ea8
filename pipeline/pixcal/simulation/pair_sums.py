"""Products of the residuals of pairs of pixels: what noise that pixels share leaves in frames.

Noise of single samples leaves their mean at zero. Sums over frames of all pairs within a row,
within a column, of column sums and of row sums hold all that can be known of noise whose covariance
is that of lines; pairs a few pixels apart, and samples a few frames apart, hold what is local.
"""

import numpy as np

from pixcal.estimators.test_statistics.look import neighbour_sums
from pixcal.model.arrays import F32, F64, Mask

# rows and columns to neighbours in other rows and other columns
DIAGONAL = ((1, 1), (1, -1), (1, 2), (1, -2), (2, 1), (2, -1))
FRAMES_APART = (1, 2, 3, 4)


def pair_sums(values: F32, good: Mask) -> F64:
    """Sums (n,) over frames of products of two residuals (t, y, x) over their noise.

    Pairs of columns within rows, of rows within columns, of column sums and of row sums (of
    different rows and columns), neighbours of `DIAGONAL`, samples of `FRAMES_APART`. Values are
    zero where there is no weight.
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
    return np.concatenate(
        [
            _upper(within_rows, 1),
            _upper(within_columns, 1),
            _upper(of_columns.T @ of_columns - within_rows, 0),
            _upper(of_rows.T @ of_rows - within_columns, 0),
            near.sum(axis=1),
            apart,
        ]
    )


def pair_variance(frames: int, good: Mask) -> F64:
    """Variance (n,) of `pair_sums` of independent samples of unit variance."""
    there = good.astype(float)
    in_rows, in_columns = there.T @ there, there @ there.T
    columns, rows = there.sum(axis=0), there.sum(axis=1)
    # A pair of two rows of one column is met twice.
    of_columns = np.outer(columns, columns) - in_rows
    of_rows = np.outer(rows, rows) - in_columns
    of_columns[np.diag_indices(len(columns))] *= 2
    of_rows[np.diag_indices(len(rows))] *= 2
    _, near = neighbour_sums(np.zeros((1, *good.shape), np.float32), good, DIAGONAL)
    apart = [max(frames - n, 0) / frames * there.sum() for n in FRAMES_APART]
    return frames * np.concatenate(
        [
            _upper(in_rows, 1),
            _upper(in_columns, 1),
            _upper(of_columns, 0),
            _upper(of_rows, 0),
            near.sum(axis=1),
            apart,
        ]
    )


def taken_by_fit(place: F32, covariance: F64, of_time: F32, good: Mask) -> F64:
    """What the freedom of frames and pixels leaves of `pair_sums` of independent samples.

    Parameters
    ----------
    place : (j, n) functions of place that a frame is free to have, over the noise of the n good
        pixels
    covariance : (j, j) of their shares in a frame: mean over the frames
    of_time : (k, t) orthonormal functions of time that a pixel is free to have
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


def _upper(matrix: F64, first: int) -> F64:
    """Pairs of a symmetric matrix, each once, from a diagonal on."""
    return np.asarray(matrix[np.triu_indices(len(matrix), first)])
