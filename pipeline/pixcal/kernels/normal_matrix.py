"""Inverses of normal matrices, whose parameters may have any units and be undetermined."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.model.arrays import F64


def symmetric(packed: NDArray[Any]) -> F64:
    """Symmetric matrices (..., n, n) from their upper triangles (..., n (n + 1) / 2), by row."""
    n = math.isqrt(2 * packed.shape[-1])
    place = np.empty((n, n), np.intp)
    rows, columns = np.triu_indices(n)
    place[rows, columns] = place[columns, rows] = np.arange(packed.shape[-1])
    return np.asarray(packed[..., place], np.float64)


def root_diagonal(normal: NDArray[Any]) -> F64:
    """Square roots (..., n) of the diagonals of matrices (..., n, n); 1 where not positive."""
    size = np.sqrt(np.maximum(np.einsum("...ii->...i", normal), 0.0))
    return np.where(size > 0, size, 1.0)


def inverse_normal(normal: NDArray[Any], rcond: float = 1e-9) -> F64:
    """Inverse (..., n, n) of symmetric matrices; zero along undetermined directions.

    With the diagonal scaled to 1, eigenvalues below ``rcond`` times the largest count as zero.
    """
    scale = root_diagonal(normal)
    both = scale[..., :, None] * scale[..., None, :]
    values, vectors = np.linalg.eigh(normal / both)
    size = np.abs(values)
    known = size > rcond * size.max(axis=-1, keepdims=True, initial=0.0)
    inverse = np.divide(1.0, values, out=np.zeros_like(values), where=known)
    return np.asarray((vectors * inverse[..., None, :]) @ np.swapaxes(vectors, -1, -2) / both)
