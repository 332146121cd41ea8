"""Least squares of a sum of terms: each a size times a function of a shape parameter."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from scipy.optimize import least_squares

from pixcal.model.arrays import F64

_STEP = 0.01  # of a shape, for the derivative of a term
_CLOSE = 1e-6  # relative fall of the squares, and step of the shapes, that end the fit


@dataclass(frozen=True)
class SeparableFit:
    """Sizes and shapes (n,) of the terms, ascending in shape."""

    sizes: F64
    shapes: F64
    covariance: F64  # (2 n, 2 n) of sizes, then shapes, for data of unit variance
    left: float  # sum of squares that is left

    def errors(self, variance: float = 1.0) -> tuple[F64, F64]:
        """1-sigma of sizes and of shapes, for data of a variance."""
        errors = np.sqrt(variance * np.diag(self.covariance).clip(0))
        return errors[: len(self.sizes)], errors[len(self.sizes) :]


def fit_terms(term: Callable[[float], F64], data: F64, grid: F64, count: int = 1) -> SeparableFit:
    """Fit ``count`` terms to data (t,); ``grid``: shapes (k,) to begin with, ascending."""
    kept = lru_cache(maxsize=None)(term)

    def fitted(shapes: F64 | tuple[float, ...]) -> tuple[F64, F64, F64]:
        design = np.stack([kept(float(x)) for x in shapes], axis=1)
        sizes = np.asarray(np.linalg.lstsq(design, data)[0], float)
        return data - design @ sizes, sizes, design

    def left(shapes: F64 | tuple[float, ...]) -> float:
        rest = fitted(shapes)[0]
        return float(rest @ rest)

    best = np.array(min(combinations(grid, count), key=left))
    if len(grid) > count:
        # The sizes follow the shapes: the slopes of what is left include their change.
        ends, close = (grid[0], grid[-1]), {"ftol": _CLOSE, "xtol": _CLOSE}
        found = least_squares(lambda x: fitted(x)[0], best, bounds=ends, **close)
        best = np.sort(found.x)
    _, sizes, design = fitted(best)
    slopes = (fitted(best + _STEP)[2] - fitted(best - _STEP)[2]) / (2 * _STEP)
    # Of the design itself: the inverse of its square may be negative, where shapes are alike.
    inverse = np.linalg.pinv(np.concatenate([design, slopes * sizes], axis=1))
    return SeparableFit(sizes, best, inverse @ inverse.T, left(best))
