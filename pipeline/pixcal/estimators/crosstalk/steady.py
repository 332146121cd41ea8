"""Products of neighbours in frames whose charge is the same from frame to frame.

Bias, dark and flat frames of one level. Each pixel then has one charge and one variance, so a
single sum over the frames gives the products with all terms of
`pixcal.estimators.crosstalk.covariance`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit

from pixcal.estimators.crosstalk.residuals import Residuals
from pixcal.model.arrays import F32, Indices

_COLUMNS = 256  # columns whose sums are kept at once
_FAST = {"reassoc", "contract", "nsz", "arcp"}


@dataclass(frozen=True)
class _Level:
    """One sequence of frames and the modes that were taken off it."""

    e: F32  # (t, y, x) residuals over their variance
    charge: F32  # (y, x) 10⁴ e-
    weight: F32  # (y, x) such that a product of two is the sum of the frames' weights

    @classmethod
    def of(cls, part: Residuals) -> "_Level":
        one = part.one.max(axis=0)
        at_one = np.divide(part.charge.max(axis=0), one, out=np.zeros_like(one), where=one > 0)
        # Both pixels of a pair count in a share of the frames; where neither is ever clipped, in
        # all of them.
        weight = (part.one**2).sum(axis=0) / np.float32(np.sqrt(len(part.one)))
        modes, _, of_modes = part.taken
        return cls(np.concatenate([part.e * part.one, modes * of_modes]), at_one, weight)


def add_products(parts: Sequence[Residuals], links: Indices, right: F32, normal: F32) -> None:
    """Add to the sums ``right`` and ``normal`` of `covariance.Products` for links (n, 2)."""
    levels = [_Level.of(part) for part in parts]
    _add(
        np.concatenate([level.e for level in levels]),
        np.cumsum([0, *(len(level.e) for level in levels)]),
        np.stack([level.charge for level in levels]),
        np.stack([level.weight for level in levels]),
        links, right, normal,
    )  # fmt: skip


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _add(
    e: F32, ends: Indices, charge: F32, weight: F32, links: Any, right: F32, normal: F32
) -> None:
    """Frames (t, y, x) of level n are those from ``ends[n]`` to ``ends[n + 1]``."""
    _, ny, nx = e.shape
    terms, sums = right.shape[1], np.empty((right.shape[1] + normal.shape[1], _COLUMNS), np.float32)
    products = np.empty(_COLUMNS, np.float32)
    for n in range(len(links)):
        dy, dx = links[n, 0], links[n, 1]
        for y in range(ny - dy):
            for first in range(max(-dx, 0), nx - max(dx, 0), _COLUMNS):
                last = min(first + _COLUMNS, nx - max(dx, 0))
                v, left, end = y + dy, first + dx, last + dx
                sums[:] = 0
                for level in range(len(charge)):
                    products[:] = 0
                    for t in range(ends[level], ends[level + 1]):
                        here, there = e[t, y, first:last], e[t, v, left:end]
                        for x in range(len(here)):
                            products[x] += here[x] * there[x]
                    own, partner = charge[level, y, first:last], charge[level, v, left:end]
                    of_own, of_partner = weight[level, y, first:last], weight[level, v, left:end]
                    _add_terms(products, own, partner, of_own, of_partner, sums)
                for i in range(len(sums)):
                    out = right[n, i, y] if i < terms else normal[n, i - terms, y]
                    for x in range(last - first):
                        out[first + x] += sums[i, x]


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def _add_terms(
    products: F32, own: F32, partner: F32, of_own: F32, of_partner: F32, sums: F32
) -> None:
    """Add a row's products of one level with each term, and the terms' with each other."""
    for x in range(len(own)):
        d, other, s, w = own[x], partner[x], products[x], of_own[x] * of_partner[x]
        both, squares = d * other, d * d + other * other
        sums[0, x] += s * d
        sums[1, x] += s * other
        sums[2, x] += s
        sums[3, x] += s * both
        sums[4, x] += s * squares
        # In the order of `covariance.NORMAL`.
        sums[5, x] += w * d * d
        sums[6, x] += w * both
        sums[7, x] += w * other * other
        sums[8, x] += w * d
        sums[9, x] += w * other
        sums[10, x] += w
        sums[11, x] += w * d * both
        sums[12, x] += w * other * both
        sums[13, x] += w * both * both
        sums[14, x] += w * d * squares
        sums[15, x] += w * other * squares
        sums[16, x] += w * squares
        sums[17, x] += w * both * squares
        sums[18, x] += w * squares * squares
