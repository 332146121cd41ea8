"""Weighted least squares of (delta_x, delta_y) from projections on fringe axes, per pixel."""

from collections.abc import Sequence

import numpy as np

from pixcal.model.arrays import F64

SAME_AXIS = 0.98  # cosine of the angle below which two sets measure along one axis


def axes_span_plane(axes: Sequence[tuple[float, float]]) -> bool:
    """Whether unit vectors (x, y) differ enough (10 degrees) to give both components."""
    a = np.asarray(axes, float)
    if len(a) < 2:
        return False
    return bool(np.linalg.svd(a.T @ a / len(a))[1][-1] > np.sin(0.17) ** 2 / 4)


def combine_sets(
    axes: Sequence[tuple[float, float]], delta: F64, sigma: F64
) -> tuple[F64, F64, F64]:
    """Solve ``delta[s] = axes[s] . (delta_x, delta_y)`` at every pixel, weighted by 1 / sigma².

    ``axes``: unit vector (x, y) of each set's fringe axis. ``delta, sigma``: (s, ...) projections
    and errors, px; NaN is ignored. Returns delta_x and delta_y (2, ...), px, NaN where the valid
    sets do not determine both; their errors; chi-square (...) with ``sets - 2`` degrees of freedom
    (0 with two).
    """
    a = np.asarray(axes, float).reshape(len(delta), 2, *([1] * (delta.ndim - 1)))
    good = np.isfinite(delta) & np.isfinite(sigma) & (sigma > 0)
    w = np.where(good, 1 / np.where(good, sigma, 1.0) ** 2, 0.0)
    d = np.where(good, delta, 0.0)
    xx, xy = (w * a[:, 0] ** 2).sum(0), (w * a[:, 0] * a[:, 1]).sum(0)
    yy = (w * a[:, 1] ** 2).sum(0)
    rx, ry = (w * a[:, 0] * d).sum(0), (w * a[:, 1] * d).sum(0)
    det = xx * yy - xy * xy
    # Whether both are determined depends on the axes only, however unequal the errors.
    n, cc = good.sum(0), (good * a[:, 0] ** 2).sum(0)
    spread = cc * (n - cc) - (good * a[:, 0] * a[:, 1]).sum(0) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.where(spread > 0.005 * n**2, 1 / det, np.nan)
        x, y = (yy * rx - xy * ry) * inverse, (xx * ry - xy * rx) * inverse
        sigma_xy = np.sqrt(np.stack([yy, xx]) * inverse)
    rest = d - a[:, 0] * x - a[:, 1] * y
    return np.stack([x, y]), sigma_xy, (w * rest**2).sum(0)


def combine_parallel(
    axes: Sequence[tuple[float, float]], delta: F64, sigma: F64
) -> tuple[F64, F64, F64]:
    """As `combine_sets`, for sets along one axis; the first set defines the sign."""
    a = np.asarray(axes, float)
    sign = np.sign(a @ a[0]).reshape(-1, *([1] * (delta.ndim - 1)))
    return weighted_mean(sign * delta, sigma)


def weighted_mean(values: F64, sigma: F64) -> tuple[F64, F64, F64]:
    """Mean of maps (n, ...) weighted by 1 / sigma², NaN left out; its error, and chi-square."""
    good = np.isfinite(values) & np.isfinite(sigma) & (sigma > 0)
    w = np.where(good, 1 / np.where(good, sigma, 1.0) ** 2, 0.0)
    d = np.where(good, values, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        total = w.sum(0)
        mean = np.where(total > 0, (w * d).sum(0) / total, np.nan)
        error = np.where(total > 0, 1 / np.sqrt(total), np.nan)
    return mean, error, (w * (d - mean) ** 2).sum(0)
