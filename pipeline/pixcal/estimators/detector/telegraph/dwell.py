"""Dwell times of pixels in a level, from many frames.

A few dozen bias or dark frames show which pixels jump, and how far; hundreds of fringe frames show
how long they stay. The residuals of such a pixel are correlated in time. Their autocovariance falls
exponentially with the time between two frames (Machlup 1954, J. Appl. Phys. 25, 341), slowly for
long dwell times.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from pixcal.estimators.detector.telegraph.classes import PLACES, Stays, states
from pixcal.estimators.detector.telegraph.moments import NOISY, Moments
from pixcal.kernels.frame_order import follows
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F64, Indices

LAGS = np.array([1, 2, 4, 8, 16, 32])  # frames apart
DECADES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)  # ranges of dwell times that are tried
TRUSTED = 0.1  # share by which the variance in fringes may differ from that in darker frames
DIFFER = 4.0  # by which the chi-square of unequal times must be lower
CLEAR = 5.0  # significance (errors) of the variance from which a time is fitted
FEWEST_PIXELS = 20
_FEWEST_PAIRS = 16
_LEAST, _MOST = 0.2, 5.0  # limits of times: in periods, and in lengths of the series


@dataclass(frozen=True)
class LitSeries:
    """Residual charge of pixels in consecutive frames."""

    charge: F64  # (t, n) e-; 0 where there is none
    weight: F64  # (t, n) inverse of its variance without jumps, e-⁻²; 0 where there is none
    frame: Indices  # (t,) numbers of the frames
    period_s: float
    pixel: Indices  # (n,) which pixels
    fitted: F64  # (t, k) functions of time that were fitted to each pixel, with its weights


def find_stays(
    lit: Sequence[LitSeries], seen: Moments, upper: float = 0.5
) -> tuple[Stays, float] | None:
    """Dwell times of the pixels, and the error (s) of their mean; None if not constrained.

    ``upper``: share of the time in the upper level. ``seen``: the frames in which the pixels were
    selected, without those that stayed in one level.
    """
    lit = [s for s in lit if s.charge.shape[1] >= FEWEST_PIXELS and s.period_s > 0]
    products = [_products(s) for s in lit]
    if not products:
        return None
    period, count = lit[0].period_s, max(len(s.frame) for s in lit)
    used = np.all([np.isfinite(p).all(axis=1) for p, _ in products], axis=0)
    sums = np.concatenate([p[used] for p, _ in products], axis=1)
    weights = np.concatenate([w[used] for _, w in products], axis=1)
    total = weights.sum(axis=1)
    mean = sums.sum(axis=1) / total
    scatter = (sums - mean[:, None] * weights) / total[:, None]
    covariance = scatter @ scatter.T
    if used.sum() < 3 or np.linalg.matrix_rank(covariance) < used.sum():
        return None
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))

    def expected(log_time: float, decades: float) -> F64:
        stays = Stays(float(np.exp(log_time)), decades, upper)
        kept = np.broadcast_to(stays.kept(period, PLACES), PLACES.shape)
        chosen, shown = _chosen(stays, seen)
        variance = _excess(seen) * seen.sigma**2 * chosen.sum() / max(float(chosen @ shown), 1e-9)
        variance *= 4 * upper * (1 - upper)
        # Variance of the subtracted mean of ``count`` frames, over that of one.
        k = np.minimum(kept, 1 - 1e-9)
        both = (1 + k) / (1 - k) / count - 2 * k * (1 - k**count) / (count * (1 - k)) ** 2
        powers = kept ** LAGS[used, None] - np.asarray(both)
        return np.asarray(variance * (powers @ chosen) / max(chosen.sum(), 1e-9))

    def fitted(decades: float) -> tuple[float, F64, F64]:
        def rest(p: F64) -> F64:
            off = whiten @ (p[0] * expected(p[1], decades) - mean)
            return np.append(off, (p[0] - 1) / TRUSTED)

        low, high = np.log(_LEAST * period), np.log(_MOST * period * count)
        start = [1.0, np.clip(np.log(4 * period), low, high)]
        bounds = [0.0, low], [np.inf, high]
        found = least_squares(rest, start, bounds=bounds, diff_step=1e-2)
        information = found.jac.T @ found.jac
        if np.linalg.cond(information) > 1e12:
            return np.inf, found.x, np.full(2, np.inf)
        return 2 * found.cost, found.x, np.sqrt(np.diag(np.linalg.inv(information)))

    if mean[0] < CLEAR * covariance[0, 0] ** 0.5:
        return None
    chosen = _best_range([fitted(decades) for decades in DECADES])
    if chosen is None:
        return None
    decades, log_time, error = chosen
    time = float(np.exp(log_time))
    return Stays(time, decades, upper), min(error, 1.0) * time


def _best_range(tried: Sequence[tuple[float, F64, F64]]) -> tuple[float, float, float] | None:
    """Best of `DECADES`, the logarithm of its time, and its error; None if no fit is determined."""
    # ``tried``: chi-square, (variance factor, logarithm of the time), and errors, of each range.
    best = 1 + min(range(len(tried) - 1), key=lambda n: tried[1 + n][0])
    if tried[0][0] - tried[best][0] < DIFFER:
        best = 0
    chi2, (_, log_time), (_, error) = tried[best]
    if not np.isfinite(chi2):
        return None
    # Another range of the times, with another mean, may be the true one.
    chi2s, times = (np.array([one[n] for one in tried]) for n in (0, 1))
    chance = np.exp((chi2 - chi2s) / 2) * np.where(np.array(DECADES) > 0, 1 / len(DECADES), 1)
    other = float(chance @ (times[:, 1] - log_time) ** 2 / chance.sum())
    return DECADES[best], float(log_time), float(np.hypot(error, other**0.5))


def _products(series: LitSeries) -> tuple[F64, F64]:
    """Weighted mean products (lag, n) of each pixel, and the weights; NaN without frames."""
    root = np.sqrt(series.weight)
    noise = series.charge * root
    shape = len(LAGS), noise.shape[1]
    sums, weights = np.full(shape, np.nan), np.full(shape, np.nan)
    # The fit makes residuals of white noise anticorrelated between frames: their weighted
    # covariance is too low by this.
    fitted = (root[:, None] * series.fitted[:, :, None]).astype(float)
    normal = np.einsum("tkn,tln->nkl", fitted, fitted)
    taken = np.einsum("nkl,tln->tkn", inverse_normal(normal), fitted)
    for n, lag in enumerate(LAGS):
        later = np.flatnonzero(follows(series.frame, int(lag)))
        if len(later) >= _FEWEST_PAIRS:
            missing = np.einsum("tkn,tkn->n", fitted[later], taken[later - lag]) / len(later)
            sums[n] = (noise[later] * noise[later - lag]).mean(axis=0) + missing
            weights[n] = (root[later] * root[later - lag]).mean(axis=0)
    return sums, weights


def _excess(seen: Moments) -> float:
    """Relative excess of the selected pixels' variance over the common one."""
    return float(np.mean(seen.variance[seen.excess > 0])) - 1


def _chosen(stays: Stays, seen: Moments) -> tuple[F64, F64]:
    """Share (place,) of pixels noisy enough to be selected; their mean variance (place,)."""
    limit = NOISY * np.sqrt(2 / seen.dof) / max(_excess(seen), 1e-9)
    kept = np.broadcast_to(stays.kept(seen.period_s, PLACES), PLACES.shape)
    shown = states(tuple(kept.tolist()), seen.frames, stays.upper)
    variance = ((shown**2).sum(axis=0) / (seen.frames - 1)).reshape(-1, len(PLACES))
    chosen = variance > limit
    return chosen.mean(axis=0), np.where(chosen, variance, 0).sum(axis=0) / np.maximum(
        chosen.sum(axis=0), 1
    )
