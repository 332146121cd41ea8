"""Brighter-fatter from the noise: collected charge moves boundaries, which neighbours share.

The covariance of neighbours has a constant part (rows, columns, electronics), a part proportional
to the level (crosstalk: a share of the shot noise), and one to its square (brighter-fatter).
Weighted least squares on products of neighbouring residuals of all frames separates them; the first
two are free in each direction.
"""

from dataclasses import dataclass

import numpy as np

from pixcal.estimators.crosstalk.residuals import UNIT, Residuals, all_residuals
from pixcal.estimators.diagnosis.evidence import Evidence, cached_on_evidence
from pixcal.kernels.boundaries import REACH, mean_boundary_shifts, shared_noise
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F32, F64

DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows and columns from a pixel to its neighbours
_COUNT = len(DIRECTIONS)
# chi-square above which terms proportional to the level (one per direction) are significant:
# 1 % by chance
_CROSSTALK = 13.3


@dataclass(frozen=True)
class SharedCharge:
    """Size of the brighter-fatter effect from the covariance of neighbours."""

    size: float  # size, variance: shift per electron, px
    variance: float
    axes: F64  # (2,), (2, 2) the same for boundaries between columns and between rows
    covariance: F64


@cached_on_evidence
def shared_charge(evidence: Evidence, shifts: F64) -> SharedCharge | None:
    """Size of the brighter-fatter effect from the covariance of neighbours.

    ``shifts``: `pixcal.kernels.boundaries.boundary_shifts`, of size one. None without light.
    """
    # Constants of all directions, then terms proportional to the level, then squares of both axes.
    normal, right = np.zeros((2 * _COUNT + 2,) * 2), np.zeros(2 * _COUNT + 2)
    for part in all_residuals(evidence):
        charge = part.charge * np.float32(UNIT)
        pushes = mean_boundary_shifts(charge, shifts)
        for d, step in enumerate(DIRECTIONS):
            at = [d, _COUNT + d, -2, -1]
            shared = [
                shared_noise(charge, pushes, shifts, step, axes) / np.float32(UNIT)
                for axes in ((1, 0), (0, 1))
            ]
            more, more_right = pair_sums(part, (shared[0], shared[1]), step, REACH)
            normal[np.ix_(at, at)] += more
            right[at] += more_right
    if not normal[-1, -1]:
        return None
    if not evidence.fringes:
        normal, right = _without_crosstalk(normal, right)
    alike = np.eye(len(right))[:, :-1]
    alike[-1, -1] = 1
    one, covariance = inverse_normal(alike.T @ normal @ alike), inverse_normal(normal)
    return SharedCharge(
        float(one[-1] @ (right @ alike)),
        float(one[-1, -1]),
        covariance[-2:] @ right,
        covariance[-2:, -2:],
    )


def _without_crosstalk(normal: F64, right: F64) -> tuple[F64, F64]:
    """Sums without the terms proportional to the level, unless the products need these."""

    # Flats hardly separate the level from its square: with both free, neither would be significant.
    def fall(without: slice) -> float:
        block, own = np.delete(np.delete(normal, without, 0), without, 1), np.delete(right, without)
        return float(own @ inverse_normal(block) @ own)

    level, squares = slice(_COUNT, 2 * _COUNT), slice(2 * _COUNT, None)
    by_squares, by_level = fall(level), fall(squares)
    fewer = 2 * (_COUNT - 2)
    if by_level - fewer > by_squares or fall(slice(0)) - by_squares > _CROSSTALK:
        return normal, right
    return np.delete(np.delete(normal, level, 0), level, 1), np.delete(right, level)


def pair_sums(
    part: Residuals, shared: tuple[F32, F32], step: tuple[int, int], margin: int
) -> tuple[F64, F64]:
    """Normal matrix (4, 4) and right-hand side (4,) for products of pixels at a step.

    The terms are a constant, the sum of the two charges, and the two ``shared`` noises, each at the
    first pixel of a pair and of the shape of the charge. ``step``: rows (not negative) and columns
    to the second pixel. ``margin``: pixels along the edges that are not used.
    """
    (dy, dx), (ny, nx) = step, part.e.shape[1:]
    left, right = margin + max(0, -dx), nx - margin - max(0, dx)
    here = np.s_[..., margin : ny - margin - dy, left:right]
    there = np.s_[..., margin + dy : ny - margin, left + dx : right + dx]
    own = part.charge[here] + part.charge[there], shared[0][here], shared[1][here]
    terms = np.stack([np.ones_like(own[0]), *own], axis=1).reshape(len(part.charge), 4, -1)
    products, weights = np.zeros((2, len(terms), terms[0, 0].size))
    for sums, values in ((products, part.e), (weights, part.weight)):
        for row, frame in zip(values[here] * values[there], part.frame, strict=False):
            sums[frame] += row.ravel()
    matrix = sum((one * weight) @ one.T for one, weight in zip(terms, weights, strict=True))
    return np.asarray(matrix), np.einsum("tix,tx->i", terms, products)
