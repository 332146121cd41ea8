"""Fit terms to the maps of several fringe sets at once, with errors from the residuals.

The noise of a map is the residual of the fit, true offsets included; its scatter gives the errors.
If residuals of neighbouring pixels are correlated, blocks of pixels give larger errors. Several
block sizes are tried, because the foundry's stitching displaces whole fields of pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.fringe_fit.fringes import plane_wave, polynomial_basis
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.maps.stitching import within
from pixcal.estimators.maps.structure import CELLS
from pixcal.kernels.medians import median, robust_sigma
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64, Indices, Mask

_CLIP = 5.0
MIN_APART = 0.1  # least part of a harmonic that is not absorbed by the fit, for it to be compared
_MIN_VARIANCE = 1e-30  # least variance, for a map that its signals fit exactly


@dataclass(frozen=True)
class MapPart:
    """Good pixels of one map as input of a fit."""

    signals: F64  # (pixel, n) change of the map by one unit of each parameter
    data: F64  # (pixel,)
    blocks: Indices  # (size, pixel) number of the block that a pixel lies in
    dof: int  # number of pixels minus that of removed terms and fields

    @classmethod
    def of(
        cls, signals: F64, data: F64, free: F64, good: Mask, field: Indices | None = None
    ) -> "MapPart":
        """Data (y, x) and signals (n, y, x) minus outliers, free terms and field means."""
        at = np.flatnonzero(good)
        terms, values = _taken(free, at), data.ravel()[at]
        for _ in range(2):
            left = _left(values[:, None], terms.T, at, field)[:, 0]
            centre = median(left.copy())
            kept = np.abs(left - centre) <= _CLIP * robust_sigma(left - centre)
            if kept.all():
                break
            at, terms, values = at[kept], terms[:, kept], values[kept]
        columns = np.concatenate([_taken(signals, at), values[None]]).T
        rest = _left(columns, terms.T, at, field)
        y, x = np.divmod(at, good.shape[1])
        sides = [*CELLS, max(min(good.shape) // 4, 1)]
        blocks = np.stack([(y // n) * (good.shape[1] // n + 1) + x // n for n in sides])
        steps = 0 if field is None else len(np.unique(field.ravel()[at])) - 1
        dof = len(at) - len(free) - steps
        return cls(np.ascontiguousarray(rest[:, :-1]), rest[:, -1].copy(), blocks, dof)


def _left(columns: F64, free: F64, at: Indices, field: Indices | None) -> F64:
    """Columns (pixel, n) less free terms (pixel, m) and means of fields (y, x)."""
    if field is not None:
        columns, free = (within(own, field.ravel()[at]) for own in (columns, free))
    return without(columns, free)


def _taken(maps: F64, at: Indices) -> F64:
    """Values (n, pixel) of maps (n, y, x) at given pixels."""
    return np.take(maps.reshape(len(maps), -1), at, axis=1)


@dataclass(frozen=True)
class MapFit:
    """Parameters, their covariance, and the resulting decrease in chi-square."""

    values: F64
    covariance: F64
    gain: float


def fit_maps(parts: Sequence[MapPart]) -> MapFit:
    """Weighted least squares of the same parameters in several maps."""
    values, normal, variances = fitted_values(parts)
    covariance = np.linalg.pinv(normal, rcond=1e-12, hermitian=True)
    meat = np.zeros((len(parts[0].blocks), *normal.shape))
    for part, variance in zip(parts, variances, strict=True):
        rest = part.data - part.signals @ values
        some = np.flatnonzero(part.signals.any(axis=0))
        pulls = (part.signals[:, some] * (rest / variance)[:, None]).T
        for own, block in zip(meat, part.blocks, strict=True):
            scores = np.zeros((len(values), int(block.max()) + 1))
            scores[some] = [np.bincount(block, pull) for pull in pulls]
            own += scores @ scores.T
    inside = np.einsum("ij,sjk,ki->si", covariance, meat, covariance)
    more = max(1.0, *map(float, np.mean(inside / np.diag(covariance), axis=1)))
    return MapFit(values, np.asarray(covariance * more), float(values @ normal @ values) / more)


def fitted_values(parts: Sequence[MapPart]) -> tuple[F64, F64, F64]:
    """Parameters (n,), their normal matrix (n, n), and the variance of each map."""
    n = parts[0].signals.shape[1]
    values = np.zeros(n)
    variances = np.array([max(p.data @ p.data / max(p.dof, 1), _MIN_VARIANCE) for p in parts])
    squares = [p.signals.T @ p.signals for p in parts]
    rights = [p.signals.T @ p.data for p in parts]
    for _ in range(3):
        normal = sum((s / v for s, v in zip(squares, variances, strict=True)), np.zeros((n, n)))
        right = sum((r / v for r, v in zip(rights, variances, strict=True)), np.zeros(n))
        values = np.linalg.pinv(normal, rcond=1e-12, hermitian=True) @ right
        left = (p.data - p.signals @ values for p in parts)
        noise = [rest @ rest / max(p.dof - n, 1) for p, rest in zip(parts, left, strict=True)]
        variances = np.maximum(noise, _MIN_VARIANCE)
    return values, normal, variances


def phase_map(fringes: FringeEvidence) -> F64:
    """Phase (y, x) of a set minus its fringe vector's plane and its mean, ±pi rad; NaN: masked."""
    carrier = plane_wave(fringes.good.shape, fringes.k)
    phasor = (fringes.theta[2] + 1j * fringes.theta[1]) * carrier.conj()
    phasor = np.where(fringes.good, phasor, 0)
    total = phasor.sum()
    rest = np.angle(phasor * np.conj(total if total else 1.0))
    return np.where(fringes.good, rest, np.nan)


def gauge_terms(fringes: FringeEvidence) -> F64:
    """Fringe modes (4, y, x) that the fit of a set does not determine."""
    alpha = np.maximum(np.hypot(fringes.theta[1], fringes.theta[2]), 1e-9)
    psi = np.arctan2(fringes.theta[1], fringes.theta[2])
    return np.stack(fringe_modes(psi, fringes.theta[0] / alpha))


def polynomial(shape: tuple[int, ...], degree: int) -> F64:
    """Polynomials (term, y, x) up to a degree."""
    basis = polynomial_basis(shape, degree)
    return np.ascontiguousarray(basis.T).reshape(-1, *shape)


def without(columns: F64, free: F64) -> F64:
    """Columns (pixel, n) less their least-squares fit by free terms (pixel, m)."""
    return np.asarray(columns - free @ (inverse_normal(free.T @ free, 1e-10) @ (free.T @ columns)))


def half_theta(fringes: FringeEvidence, half: int, good: Mask) -> F64:
    """Maps (3, pixel) of a set at good pixels, from every second frame only (half 0 or 1)."""
    rest = _half_residual(fringes, half, good)
    return np.asarray(fringes.theta[:, good] + np.linalg.pinv(fringes.g[half::2]) @ rest)


def without_harmonics(
    first: F64, second: F64, fringes: FringeEvidence, kept: Mask
) -> tuple[F64, F64]:
    """Maps (y, x), one of each half of the frames, less what goes with second harmonics of pixels.

    A nonlinear response that differs between pixels changes the maps and their harmonics alike.
    """
    one, other = (_half_harmonic(fringes, half, kept) for half in (0, 1))
    square = white_products(one, other, kept)  # the noise of the halves is independent
    if square.mean() <= SIGNIFICANT * square.std() / np.sqrt(len(square)):
        return first, second
    along = white_products(first, other, kept).sum(), white_products(second, one, kept).sum()
    slopes = np.array(along) / square.sum()
    return first - slopes[0] * one, second - slopes[1] * other


def _half_harmonic(fringes: FringeEvidence, half: int, kept: Mask) -> F64:
    """Curvature (y, x) of the response at the mean light, from the second harmonic of the fringes.

    Less means of rows and columns; zero where the phases do not separate it from the fringes.
    """
    mean, of_sine, of_cosine = fringes.theta[:, kept]
    turns = np.exp(-2j * fringes.phi[half::2])
    axes = np.linalg.qr(fringes.g[half::2])[0]
    turns = turns - axes @ (axes.T @ turns)
    square = float(np.sum(np.abs(turns) ** 2))
    if square < MIN_APART * len(turns):
        return np.zeros(kept.shape)
    sizes = 2 / square * (turns @ _half_residual(fringes, half, kept))
    # The signal goes with sin(phi + psi).
    phasor = of_cosine + 1j * of_sine
    alpha = np.maximum(np.abs(phasor), 1e-9)
    # It goes with the square of the amplitude.
    return without_lines((sizes * (phasor.conj() / alpha) ** 2).real * mean / alpha**2, kept)


def without_lines(values: F64, kept: Mask) -> F64:
    """Values (pixel,) of kept pixels less means of rows and columns, as (y, x); zero elsewhere."""
    for index in np.nonzero(kept):
        count = np.maximum(np.bincount(index), 1)
        values = values - (np.bincount(index, values) / count)[index]
    out = np.zeros(kept.shape)
    out[kept] = values
    return out


def _half_residual(fringes: FringeEvidence, half: int, good: Mask) -> F64:
    """Residuals (t, pixel) of half the frames at good pixels, e-; zero without weight."""
    every = fringes.residual.reshape(len(fringes.residual), -1)[half::2]
    rest = np.take(every, np.flatnonzero(good), axis=1).astype(float)
    rest[np.isnan(rest)] = 0
    return rest


def neighbour_products(one: F64, other: F64, good: Mask) -> F64:
    """Products (3, y, x) of a map with another, and with its neighbours one and two pixels away."""
    products = [one * other]
    for step in (1, 2):
        total, count = np.zeros(good.shape), np.zeros(good.shape)
        for axis in (0, 1):
            for way in (step, -step):
                inside = np.roll(good, way, axis).astype(float)
                edge = [slice(None)] * 2
                edge[axis] = slice(0, step) if way > 0 else slice(-step, None)
                inside[tuple(edge)] = 0
                total += inside * np.roll(other, way, axis)
                count += inside
        products.append(one * total / np.maximum(count, 1))
    return np.stack(products)


def white_products(one: F64, other: F64, good: Mask) -> F64:
    """Products (pixel,) of two maps at good pixels, without what neighbours share."""
    same, near, farther = neighbour_products(one, other, good)
    return np.asarray((same - (4 * near - farther) / 3)[good])
