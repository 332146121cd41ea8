"""Smooth functions over a tile as polynomials about its centre.

Whatever shape the fringes have over the window, over a tile it is a polynomial of low degree to far
below the noise. Sums over pixels are taken once with these polynomials; every shape then is a
matter of a few numbers a tile, and no map is read again to fit another.
"""

from collections.abc import Callable
from functools import cache, lru_cache

import numpy as np

from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.model.arrays import F64

# as the polynomial that shapes are judged by, which a window of one tile must hold as well
DEGREE = 5
SCALE_PX = 64.0  # coordinates from the tile's centre are counted in these: half a tile
NODES = 6  # points along each axis at which functions are looked at


def powers() -> list[tuple[int, int]]:
    """Powers (of x, of y) of the terms."""
    return [(n - j, j) for n in range(DEGREE + 1) for j in range(n + 1)]


@lru_cache(maxsize=8)
def polynomials(shape: tuple[int, int]) -> F64:
    """The terms (term, y * x) on the pixels of a tile."""
    y, x = grid(shape)
    # Columns and rows are small: their powers cost nothing, the products all.
    xs = [(x / SCALE_PX) ** n for n in range(DEGREE + 1)]
    ys = [(y / SCALE_PX) ** n for n in range(DEGREE + 1)]
    return np.stack([(xs[i] * ys[j]).ravel() for i, j in powers()])


@cache
def _nodes() -> tuple[F64, F64, F64]:
    """Points (y, x) in units of `SCALE_PX`, and the matrix from values there to coefficients."""
    t = np.cos((2 * np.arange(NODES) + 1) * np.pi / (2 * NODES))
    y, x = (v.ravel() for v in np.meshgrid(t, t, indexing="ij"))
    terms = np.stack([x**i * y**j for i, j in powers()], axis=1)
    return y, x, np.linalg.pinv(terms)


def expand(function: Callable[[F64, F64], F64], centres: F64) -> F64:
    """Coefficients (tile, ..., term) of functions about the centres (tile, 2) of tiles, (y, x) px.

    A function takes coordinates y and x (n,), px, and gives values (..., n).
    """
    y, x, fit = _nodes()
    at_y = (centres[:, :1] + SCALE_PX * y).ravel()
    at_x = (centres[:, 1:] + SCALE_PX * x).ravel()
    values = np.asarray(function(at_y, at_x))
    values = values.reshape(*values.shape[:-1], len(centres), len(y))
    terms = values @ fit.T
    # Rounding must not pass for a term: on a single row a mode along y is exactly nothing.
    terms[np.abs(terms) < 1e-13 * np.abs(terms).max(axis=-1, keepdims=True)] = 0.0
    return np.moveaxis(terms, -2, 0)
