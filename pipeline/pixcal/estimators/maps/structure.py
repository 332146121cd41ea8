"""Structure of a map: smooth surfaces, repeating rows and columns, fringes, scales."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial.legendre import legvander

from pixcal.estimators.maps.stitching import FieldFit, fields
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.normal_matrix import inverse_normal, root_diagonal
from pixcal.kernels.robust import median_around
from pixcal.model.arrays import C128, F64, Indices, Mask

DEGREE = 3  # of a smooth surface
_BEYOND = 7  # highest degree of the polynomials that measure the redness of true offsets
PERIODS = (2, 3, 4, 5, 6, 8)  # periods of rows and columns in readout circuits
AROUND = 5  # side of a pixel's neighbourhood, px
_CLIP = 6.0
# redness above which a map is not white noise, and the same for means of its rows or columns, which
# cells average; white noise with its stitched fields removed has 1.0 to 1.3, and 0.6 to 1.1
_RED, _RED_LINES = 2.0, 1.4


def clipped(values: F64) -> F64:
    """A map minus its median; values beyond six robust standard deviations become NaN."""
    rest = values - np.nanmedian(values)
    spread = robust_sigma(rest)
    return np.asarray(np.where(np.abs(rest) <= _CLIP * max(spread, 1e-300), rest, np.nan))


def without_outliers(values: F64) -> F64:
    """A map minus its median; pixels 6 robust sigmas from their neighbourhood become NaN."""
    rest = values - np.nanmedian(values)
    around = median_around(np.where(np.isfinite(rest), rest, 0.0), AROUND)
    return np.where(np.isfinite(clipped(rest - around)), rest, np.nan)


def orders(degree: int) -> list[tuple[int, int]]:
    """Orders (y, x) of the terms up to a total degree, the constant first."""
    return [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]


@lru_cache(maxsize=4)
def legendre(shape: tuple[int, ...], degree: int) -> F64:
    """Products of Legendre polynomials (term, y, x) up to a total degree, the constant first."""
    y, x = (legvander(np.linspace(-1, 1, n), degree) for n in shape)
    terms: F64 = np.stack([np.outer(y[:, i], x[:, j]) for i, j in orders(degree)])
    terms.flags.writeable = False  # the array is cached
    return terms


def fit_terms(values: F64, terms: F64) -> F64:
    """Least-squares coefficients (term,) of maps (term, y, x) in a map; NaN are masked."""
    good = np.isfinite(values)
    # Zeros for masked pixels: copies without them would take longer than the fit.
    design = terms.reshape(len(terms), -1)
    inside = design if good.all() else np.where(good.ravel(), design, 0)
    # With few terms and many pixels, normal equations take a hundredth of the time of an SVD.
    right = inside @ np.where(good, values, 0).ravel()
    return np.asarray(inverse_normal(inside @ inside.T, 1e-12) @ right)


def smooth_surface(values: F64, good: Mask, degree: int = DEGREE) -> F64:
    """Polynomial surface (y, x) fitted to the good pixels of a map without outliers."""
    terms = legendre(values.shape, degree)
    used = np.where(good, values, np.nan)
    for _ in range(2):
        surface = np.tensordot(fit_terms(used, terms), terms, 1)
        used = np.where(np.isfinite(clipped(used - surface)), used, np.nan)
    return np.asarray(np.tensordot(fit_terms(used, terms), terms, 1))


def flattened(values: F64, degree: int = DEGREE) -> F64:
    """A map minus its smooth surface; NaN stay."""
    terms = legendre(values.shape, degree)
    return np.asarray(values - np.tensordot(fit_terms(values, terms), terms, 1))


def profile(values: F64, axis: int) -> F64:
    """Means of rows (axis 0) or columns of a map, NaN left out; zero where there is no value."""
    good = np.isfinite(values)
    count = good.sum(axis=1 - axis)
    return np.asarray(np.where(good, values, 0).sum(axis=1 - axis) / np.maximum(count, 1))


def repeats(values: F64, axis: int) -> C128:
    """Complex amplitudes of the profile along an axis at the periods `PERIODS`."""
    along = profile(values, axis)
    place = np.arange(len(along))
    return np.array(
        [2 * np.mean(along * np.exp(-2j * np.pi * place / p)) for p in PERIODS], complex
    )


# sides of the cells, px, whose means give the redness of a map, besides a quarter of the map
CELLS = (8, 16)


def redness(values: F64) -> float:
    """Variance of a map's cell means over that of white noise; highest over several cell sizes."""
    ny, nx = values.shape
    good = np.isfinite(values)
    filled = np.where(good, values, 0)
    variance = max(float(np.nanvar(values)), 1e-300)
    factor = 1.0
    for side in {*CELLS, max(1, min(ny, nx) // 4)}:
        if min(ny, nx) < 2 * side:
            continue
        rows, columns = ny // side, nx // side
        inside = filled[: rows * side, : columns * side].reshape(rows, side, columns, side)
        factor = max(factor, float(inside.mean(axis=(1, 3)).var()) * side**2 / variance)
    return factor


@dataclass(frozen=True)
class OffsetModel:
    """A model of true offsets: the part of a map that is kept, and the scatter of the rest."""

    kept: F64  # (y, x) without curvature, repeating rows and columns, and fringes; px
    # (term, y, x) removed terms: all patterns that an effect of bench or readout could cause
    terms: F64
    # (term, term) root of the covariance that the terms' coefficients have by chance in offsets
    # like the kept ones
    scatter: F64
    unknown: Mask  # (y, x) masked pixels
    rms: float  # rms of the offsets drawn for masked pixels, px

    def drawn(self, rng: np.random.Generator) -> F64:
        """A map (y, x): the kept part, and a random draw of the removed terms; px."""
        size = self.scatter @ rng.standard_normal(len(self.scatter))
        drawn = self.kept + np.tensordot(size, self.terms, 1)
        drawn[self.unknown] += self.rms * rng.standard_normal(np.count_nonzero(self.unknown))
        return np.asarray(drawn)


def _red_lines(values: F64) -> list[float]:
    """Variances of row means and of column means over those of white noise; NaN are masked."""
    good = np.isfinite(values)
    variance = max(float(np.nanvar(values)), 1e-300)
    return [
        float(np.mean(profile(values, axis) ** 2 * good.sum(axis=1 - axis))) / variance
        for axis in (0, 1)
    ]


@lru_cache(maxsize=4)
def bench_patterns(shape: tuple[int, ...]) -> F64:
    """Patterns of bench or readout in maps (term, y, x): curvature, then repeating lines."""
    lines = []
    for axis in (0, 1):
        place = np.expand_dims(np.arange(shape[axis]), 1 - axis)
        for period in PERIODS:
            turn = np.broadcast_to(2 * np.pi * place / period, shape)
            lines += [np.cos(turn)] if period == 2 else [np.cos(turn), np.sin(turn)]
    terms = np.concatenate([legendre(shape, DEGREE)[1:], np.stack(lines)])
    terms.flags.writeable = False  # the array is cached
    return terms


def stitched_fields(maps: Sequence[F64], fringes: Sequence[F64]) -> Indices:
    """Fields (y, x) of the foundry's stitching in offsets or phases (y, x), NaN where masked.

    Bench patterns and fringes (term, y, x) are fitted too; all zeros if residuals are not white.
    """
    patterns = bench_patterns(maps[0].shape)
    bends = len(legendre(maps[0].shape, DEGREE)) - 1
    rests = []
    for values, own in zip(maps, fringes, strict=True):
        terms = np.concatenate([patterns, own])
        sizes = fit_terms(values - np.nanmean(values), terms)
        rests.append(values - np.tensordot(sizes[bends:], terms[bends:], 1))
    field = fields(rests, [patterns[:bends]] * len(rests))
    if not field.any():
        return field
    left = [FieldFit.of(rest, patterns[:bends], field).rest for rest in rests]
    red = any(redness(rest) > _RED or max(_red_lines(rest)) > _RED_LINES for rest in left)
    return np.zeros_like(field) if red else field


def true_offsets(delta: F64, sigma: F64, psi: F64) -> OffsetModel:
    """Split a map of offsets and errors (y, x), px, NaN where masked; psi in rad.

    The ``kept`` part is shrunk by its share of noise; steps between stitched fields stay.
    """
    patterns = bench_patterns(delta.shape)
    fringes = np.stack([np.cos(psi), np.sin(psi), np.cos(2 * psi), np.sin(2 * psi)])
    terms = np.concatenate([patterns, fringes])
    values = clipped(delta)
    fit = FieldFit.of(values, terms, stitched_fields([values], [fringes]))
    variance = fit.variance
    noise = float(np.nanmedian(sigma[np.isfinite(delta)] ** 2)) if fit.good.any() else 0.0
    true = variance * max(0.0, 1 - noise / max(variance, 1e-300))
    squares = np.zeros(len(terms))
    if true:
        at_large = _steps_at_large(fit.rest)
        squares[: len(at_large)] = variance * at_large
    scatter = true * fit.covariance + np.diag(squares / (terms**2).sum(axis=(1, 2)))
    kept = fit.steps + np.nan_to_num(fit.rest) * np.sqrt(true / max(variance, 1e-300))
    return OffsetModel(kept - kept.mean(), terms, _root(scatter), ~fit.good, true**0.5)


def _root(covariance: F64) -> F64:
    """Lower triangular root of a covariance that may be singular."""
    size = root_diagonal(covariance)
    correlation = covariance / np.outer(size, size) + 1e-9 * np.eye(len(size))
    known = np.diag(covariance) > 0
    correlation[~known], correlation[:, ~known] = 0.0, 0.0
    correlation[~known, ~known] = 1.0
    return np.asarray((size * known)[:, None] * np.linalg.cholesky(correlation))


def _steps_at_large(rest: F64) -> F64:
    """Power (term,) that steps have in removed smooth terms, over that of a white map."""
    # A step (stitched blocks, halves of a mask) contributes to every polynomial a power that falls
    # as one over the square of the degree. Degrees that were not removed give its size.
    degree = np.array([n for n in range(_BEYOND + 1) for _ in range(n + 1)])
    terms = legendre(rest.shape, _BEYOND)
    low, high = (degree > 0) & (degree <= DEGREE), degree > DEGREE
    squares = fit_terms(rest, terms)[high] ** 2 * (terms[high] ** 2).sum(axis=(1, 2))
    beyond, law = squares / np.nanvar(rest) - 1, degree[high] ** -2.0
    size = max(float(beyond @ law / (law @ law)), 0.0)
    return np.asarray(size / degree[low] ** 2.0)
