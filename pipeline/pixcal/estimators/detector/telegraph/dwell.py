"""Dwell times of pixels in a level.

Residuals of a pixel that jumps are correlated in time. Their autocovariance falls exponentially
with the time between two frames (Machlup 1954, J. Appl. Phys. 25, 341), slowly for long dwell
times. Jumps, in frames without light or in fringes, show which pixels these are and their
amplitudes; pixels that stayed in one level are missed.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from pixcal.estimators.detector.telegraph.moments import NOISY, Moments
from pixcal.estimators.detector.telegraph.population import PLACES, Stays, own_noises
from pixcal.kernels.frame_order import follows
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F64, Indices

LAGS = np.array([1, 2, 4, 8, 16, 32])  # frames apart
DECADES = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)  # ranges of dwell times that are tried
# share by which the variance may differ from that expected, in the frames that show the pixels and
# with others
TRUSTED, TRUSTED_ELSEWHERE = 0.02, 0.1
SPREAD = 1.5  # range that few frames may not tell from the best
DIFFER = 4.0  # by which the chi-square of unequal times must be lower
FEWEST_PIXELS = 20
_CLEAR = 16.0  # chi-square by which some time must be better than none
_FEWEST_PAIRS = 4
_LEAST, _MOST = 0.1, 10.0  # limits of times: in periods, and in lengths of the longest series
_TIMES, _FINER = 24, 40  # times that are simulated, and others between each two


@dataclass(frozen=True)
class PixelSeries:
    """Residual charge of pixels in consecutive frames."""

    charge: F64  # (t, n) e-; 0 where there is none
    weight: F64  # (t, n) inverse of its variance without jumps, e-⁻²; 0 where there is none
    frame: Indices  # (t,) numbers of the frames
    period_s: float
    pixel: Indices  # (n,) which pixels
    fitted: F64  # (t, k) functions of time that were fitted to each pixel, with its weights
    chosen: bool = False  # whether these are the frames that show which pixels jump

    def of(self, pixels: Indices) -> "PixelSeries":
        """Of some pixels alone."""
        wanted = np.isin(self.pixel, pixels)
        arrays = self.charge[:, wanted], self.weight[:, wanted], self.frame, self.period_s
        return PixelSeries(*arrays, self.pixel[wanted], self.fitted, self.chosen)


class Dwell(NamedTuple):
    """Dwell times of a population."""

    stays: Stays
    error: float  # of the mean time, s
    other: Stays  # with another range of the times, which may be true


def find_stays(series: Sequence[PixelSeries], seen: Moments, upper: float = 0.5) -> Dwell | None:
    """Dwell times of the pixels; None if not constrained.

    ``seen``: the frames that show which pixels jump. ``upper``: share of the time in the upper
    level.
    """
    series = [s for s in series if s.charge.shape[1] >= FEWEST_PIXELS and s.period_s > 0]
    most = np.quantile(seen.excess[seen.excess > 0], 0.9)
    trust = np.minimum(most / np.maximum(seen.excess, most), 1)
    measured = [_products(s, trust[np.searchsorted(seen.pixel, s.pixel)]) for s in series]
    if not measured:
        return None
    trusted = TRUSTED if all(s.chosen for s in series) else TRUSTED_ELSEWHERE
    period = min(s.period_s for s in series)
    longest = max(s.period_s * len(s.frame) for s in series)
    logs = np.linspace(np.log(_LEAST * period), np.log(_MOST * longest), _TIMES)
    fine = np.linspace(logs[0], logs[-1], _TIMES * _FINER)
    chi2 = np.zeros((len(DECADES), len(fine)))
    for own, decades in zip(chi2, DECADES, strict=True):
        stays = [Stays(float(np.exp(log)), decades, upper) for log in logs]
        expected = [_expected(series, seen, most, one) for one in stays]
        # The variance is fitted, too.
        rest = design = np.full((len(fine), 1), 1 / trusted)
        for n, (lags, mean, whiten) in enumerate(measured):
            own_lags = np.stack([one[n][lags] for one in expected])
            near = np.stack([np.interp(fine, logs, column) for column in own_lags.T], axis=1)
            design = np.hstack([design, near @ whiten.T])
            rest = np.hstack([rest, np.broadcast_to(whiten @ mean, near.shape)])
        own[:] = (rest**2).sum(axis=1) - (design * rest).sum(axis=1) ** 2 / (design**2).sum(axis=1)
    unlike = 1 + int(np.argmin(chi2[1:].min(axis=1)))
    best = unlike if chi2[unlike].min() < chi2[0].min() - DIFFER else 0
    at = int(np.argmin(chi2[best]))
    if chi2[0, 0] - chi2[best, at] < _CLEAR:
        return None
    # Longer times than the series look alike.
    fine = np.minimum(fine, np.log(longest))
    square = (np.ptp(fine[chi2[best] < chi2[best, at] + 1]) / 2) ** 2
    # Another range of the times, with another mean, may be the true one.
    top = chi2.min(axis=1)
    chance = np.exp((top[best] - DIFFER - top) / 2) / len(DECADES)
    chance[best] = 1
    square += chance @ (fine[chi2.argmin(axis=1)] - fine[at]) ** 2 / chance.sum()
    other = DECADES.index(SPREAD)
    if top[other] > top.min() + DIFFER / 2:
        other = best
    ranges = [(best, at), (other, int(chi2[other].argmin()))]
    both = [Stays(float(np.exp(fine[time])), DECADES[own], upper) for own, time in ranges]
    error = min(float(square**0.5), 1.0) * both[0].mean_s
    return Dwell(both[0], error, both[1])


def _expected(series: Sequence[PixelSeries], seen: Moments, most: float, stays: Stays) -> list[F64]:
    """Expected products (lag,) of each series, e-², for some dwell times."""
    # Of the pixels seen, some are quiet: as many as chance makes noisy.
    limit, dof = NOISY * np.sqrt(2 / seen.dof), seen.samples_dof
    noise, log_share = np.array(own_noises([seen])).T
    often, least = len(seen.pixel) * np.exp(log_share), dof * (1 + limit) / noise
    quiet, more = often @ chdtrc(dof, least), (often * noise) @ chdtrc(dof + 2, least)
    excess = (seen.variance - 1)[seen.excess > 0]
    trust = np.minimum(most / excess, 1)
    total = max(float(trust @ excess - (more - quiet)), 1e-3 * limit)
    size = total / max(float(trust.sum() - quiet), 1.0)
    # The same pixels are seen in a simulation.
    states = stays.states(seen.period_s, seen.frames)
    apart = (states**2).sum(axis=0) / (seen.frames - 1)
    size /= (
        max(float(apart[apart * size > limit].mean()), 0.1) if (apart * size > limit).any() else 1
    )
    x = np.sqrt(size) * states + np.random.default_rng(1).standard_normal(states.shape)
    x -= x.mean(axis=0)
    shown = (x**2).sum(axis=0) / (seen.frames - 1) - 1
    weight = np.where(shown > limit, np.minimum(most / np.maximum(shown, limit), 1), 0)
    scale = seen.sigma**2 * total / max(trust.sum(), 1.0) / max(float(weight @ shown), 1e-9)
    products = []
    for one in series:
        count = len(one.frame)
        if one.chosen:
            pairs = [(x[lag:] * x[: max(count - lag, 0)]).sum(axis=0) / count for lag in LAGS]
            share = np.maximum(1 - LAGS / count, 1 / count)[:, None]
            # The mean of the quiet ones, with more noise than usual, was subtracted, too.
            taken = (more - quiet) / trust.sum() * seen.sigma**2 / count
            products.append(scale * (pairs / share + 1 / count) @ weight - taken)
            continue
        k = np.minimum(np.resize(stays.kept(one.period_s, PLACES), weight.shape), 1 - 1e-9)
        # Variance of the subtracted mean of ``count`` frames, over that of one.
        both = (1 + k) / (1 - k) / count - 2 * k * (1 - k**count) / (count * (1 - k)) ** 2
        powers = (k ** LAGS[:, None] - both) @ weight
        products.append(4 * stays.upper * (1 - stays.upper) * scale * size * powers)
    return products


def _products(series: PixelSeries, trust: F64) -> tuple[Indices, F64, F64]:
    """Which lags have pairs of frames, the weighted mean products, and what whitens these."""
    # A few pixels with large jumps would outweigh all others.
    root = np.sqrt(series.weight)
    noise = series.charge * root
    # The fit makes residuals of white noise anticorrelated between frames: their weighted
    # covariance is too low by this.
    fitted = (root[:, None] * series.fitted[:, :, None]).astype(float)
    normal = np.einsum("tkn,tln->nkl", fitted, fitted)
    taken = np.einsum("nkl,tln->tkn", inverse_normal(normal), fitted)
    lags, sums, weights = [], [], []
    for n, lag in enumerate(LAGS):
        later = np.flatnonzero(follows(series.frame, int(lag)))
        if len(later) >= _FEWEST_PAIRS:
            missing = np.einsum("tkn,tkn->n", fitted[later], taken[later - lag])
            lags.append(n)
            products = ((noise[later] * noise[later - lag]).sum(axis=0) + missing) / len(later)
            sums.append(trust * products)
            weights.append(trust * (root[later] * root[later - lag]).mean(axis=0))
    weight = np.reshape(weights, (len(lags), -1))
    total = np.maximum(weight.sum(axis=1), 1e-300)
    mean = np.reshape(sums, weight.shape).sum(axis=1) / total
    scatter = (np.reshape(sums, weight.shape) - mean[:, None] * weight) / total[:, None]
    covariance = scatter @ scatter.T + 1e-12 * np.diag((scatter**2).sum(axis=1) + 1e-300)
    return np.array(lags, int), mean, np.linalg.inv(np.linalg.cholesky(covariance))
