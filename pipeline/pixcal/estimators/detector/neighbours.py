"""Noise that neighbouring pixels share because collected charge moves their boundary.

The covariance of neighbours has a constant part (rows, columns, electronics), a part proportional
to the level (crosstalk: a share of the shot noise), and one to its square (brighter-fatter).
Weighted least squares on products of neighbouring residuals of fringe frames and flats separates
them; the first two are free in each direction. Outliers, and any function of the phase common to
all frames, are removed first, so that a nonlinear response is not mistaken for noise.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.distortions import FramesByPixels, Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack, cached_on_evidence
from pixcal.kernels.boundaries import REACH, mean_boundary_shifts, shared_noise
from pixcal.kernels.frame_order import slow_trends
from pixcal.kernels.line_means import without_line_means
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F32, F64

DIRECTIONS = ((0, 1), (1, 0), (1, 1), (1, -1))  # rows and columns from a pixel to its neighbours

HARMONICS = 5
BLOCK = 64  # frames processed at a time

_CLIP = 6.0
_MIN_FRAMES = 2
_TERMS = 4
# chi-square above which terms proportional to the level (one per direction) are significant:
# 1 % by chance
_CROSSTALK = 13.3


@dataclass(frozen=True)
class NoiseBlock:
    """Residuals of a block of frames; all (t, y, x) or (y, x), e- before the flat."""

    residual: F32  # zero where a sample is not used
    variance: F32
    charge: F32  # mean charge
    # (t, j, j), (j, y, x): covariance of each frame's coefficients, and the functions of place
    # that were fitted with them
    covariance: F32
    of_place: F32
    kept: float  # share of the covariance that remains after each pixel was fitted


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

    ``shifts``: `pixcal.kernels.boundaries.boundary_shifts`, of size one. None without fringe
    frames and flats.
    """
    n = 2 * len(DIRECTIONS) + 2
    normal, right = np.zeros((n, n)), np.zeros(n)
    for noise in _noises(evidence):
        pushes = mean_boundary_shifts(noise.charge, shifts)
        for d, step in enumerate(DIRECTIONS):
            at = [2 * d, 2 * d + 1, n - 2, n - 1]
            given = noise.charge, pushes, shifts, step
            shared = shared_noise(*given, (1, 0)), shared_noise(*given, (0, 1))
            more, more_right = pair_sums(noise, shared, step, REACH)
            # Only as many products are independent as degrees of freedom: one for two frames.
            normal[np.ix_(at, at)] += noise.kept * more
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
    count = len(right)
    squares = list(range(2 * len(DIRECTIONS), count))
    constant = list(range(0, squares[0], 2))
    linear = [n + 1 for n in constant]

    def fall(terms: list[int]) -> float:
        block = np.ix_(terms, terms)
        return float(right[terms] @ inverse_normal(normal[block]) @ right[terms])

    kept = sorted(constant + squares)
    by_squares, by_level = fall(kept), fall(sorted(constant + linear))
    fewer = 2 * (len(linear) - len(squares))
    if by_level - fewer > by_squares or fall(list(range(count))) - by_squares > _CROSSTALK:
        return normal, right
    return normal[np.ix_(kept, kept)], right[kept]


def _noises(evidence: Evidence) -> Iterator[NoiseBlock]:
    for fringes in evidence.fringes.values():
        yield from _of_fringes(fringes, evidence)
    for stack in evidence.of_kind("flat"):
        yield from _of_flats(stack, evidence)


def _of_fringes(fringes: FringeEvidence, evidence: Evidence) -> Iterator[NoiseBlock]:
    count, good = len(fringes.g), fringes.good
    kept = 1 - (2 * HARMONICS + 1) / count
    if kept <= 0:
        return
    freedom = Freedom(fringes, HARMONICS)
    left = freedom.left_over(freedom.of_good(fringes.residual))
    left[np.abs(left) * np.sqrt(freedom.weight) > _CLIP] = 0
    # Shot noise and boundary shifts depend on the charge before the flat is divided out.
    flat = evidence.flat.astype(np.float32)
    of_place = np.zeros((len(freedom.of_place), *good.shape), np.float32)
    of_place[:, good] = freedom.of_place
    covariance = freedom.frame_covariance.astype(np.float32)
    for first in range(0, count, BLOCK):
        frames = slice(first, min(first + BLOCK, count))
        residual = np.zeros(fringes.electrons[frames].shape, np.float32)
        residual[:, good] = left[frames]
        charge = np.maximum(np.nan_to_num(fringes.model[frames]), 0) * flat
        variance = fringes.variance[frames] * flat**2
        yield NoiseBlock(
            residual * flat, variance, charge, covariance[frames], of_place * flat, kept
        )


def _of_flats(stack: Stack, evidence: Evidence) -> Iterator[NoiseBlock]:
    if len(stack.adu) < _MIN_FRAMES or not np.isfinite(stack.exptime_s):
        return
    good = evidence.good & (stack.adu < evidence.saturation_adu).all(axis=0)
    frames = ((stack.adu - evidence.bias) * evidence.gain).astype(np.float32)
    charge = np.maximum(frames.mean(axis=0), 0).astype(np.float32)
    dark = (evidence.dark_rate * stack.exptime_s).astype(np.float32)
    light = np.where(good, np.maximum(charge - dark, 0), 0)
    if not light.any():
        return
    # Copies, not views: for views the kernels would be compiled a second time.
    variance = np.repeat((charge + np.float32(evidence.read_noise**2))[None], len(frames), 0)
    weight = np.where(good, 1 / variance, np.float32(0)).reshape(len(frames), -1)
    courses = np.ascontiguousarray(slow_trends(stack.frame).T)
    freedom = FramesByPixels(weight, courses, light.reshape(1, -1).astype(np.float32))
    noise = without_line_means(frames - charge, good)
    residual = freedom.left_over(noise.reshape(weight.shape))
    residual[np.abs(residual) * np.sqrt(weight) > _CLIP] = 0

    yield NoiseBlock(
        residual.reshape(frames.shape), variance.astype(np.float32),
        np.repeat(charge[None], len(frames), 0), freedom.frame_covariance.astype(np.float32),
        freedom.of_place.reshape(1, *good.shape), 1 - len(courses) / len(frames),
    )  # fmt: skip


def pair_sums(
    noise: NoiseBlock, shared: tuple[F32, F32], step: tuple[int, int], margin: int
) -> tuple[F64, F64]:
    """Normal matrix (4, 4) and right-hand side (4,) for products of pixels at a step.

    The terms are a constant, the sum of the two charges, and the two ``shared`` noises. The weight
    of a product is one over the product of the two variances.

    noise : pairs with a zero residual have no weight; what the fit of the functions of place
        removed from the product of two residuals is added back
    shared : two (t, y, x) float32, at the first pixel of each pair
    step : rows (not negative) and columns to the second pixel
    margin : pixels along the edges that are not used
    """
    (dy, dx), (ny, nx) = step, noise.residual.shape[1:]
    left, right = margin + max(0, -dx), nx - margin - max(0, dx)
    here = np.s_[..., margin : ny - margin - dy, left:right]
    there = np.s_[..., margin + dy : ny - margin, left + dx : right + dx]
    functions = len(noise.of_place)
    one, other = (noise.of_place[at].reshape(functions, -1) for at in (here, there))
    sums = np.zeros((_TERMS, _TERMS + 1))
    for residual, variance, charge, first, second, covariance in zip(
        noise.residual, noise.variance, noise.charge, *shared, noise.covariance, strict=True
    ):
        product = (residual[here] * residual[there]).ravel()
        both = (variance[here] * variance[there]).ravel()
        weight = np.divide(1, both, where=product != 0, out=np.zeros_like(both))
        product += np.einsum("ix,ix->x", one, covariance @ other)
        own = (charge[here] + charge[there], first[here], second[here])
        terms = np.stack([np.ones_like(product), *(term.ravel() for term in own)])
        sums += (terms * weight) @ np.vstack([terms, product]).T
    return sums[:, :_TERMS], sums[:, _TERMS]
