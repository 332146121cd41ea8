"""Level, slope and knee of a window's Allan deviations, each with its error.

A simulated population of pixels with white noise and the run's own gaps goes through the same
estimator, from a fixed seed. It gives the bias of the median over pixels, its scatter, and the
correlation of the lengths, which share batches.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, least_squares

from pixcal.kernels.allan import allan_deviation
from pixcal.model.arrays import F32, F64, Mask

SEED = 20250611
MAX_DRAWS = 1 << 18
MAX_SAMPLES = 1 << 26  # simulated batches: bounds the time where runs are long
ONE_SIGMA = (0.15865525393145707, 0.8413447460685429)  # levels of the one-sigma limits
# Fall of chi-square required of a knee. White noise exceeds it in 0.1 % of runs where pixels are
# independent (5100 simulated), in up to 2 % where they share most of their noise.
KNEE_CHI2 = 10.0
WHITE_SHARE = 0.1  # the slope is fitted where the rest is below this share of the white variance


@dataclass(frozen=True)
class White:
    """Allan deviations of pixels that have white noise only."""

    # (length,) median over pixels of the estimates, over the deviation of the median pixel
    bias: F64
    spread: F64  # (length,) half of the central 68 % of the logarithm of the estimates
    # (2, length) their one-sigma limits over the true deviation, for pixels of equal noise
    limits: F64
    covariance: F64  # (length, length) of the logarithm of the median, times the number of pixels
    pixels: int  # number of simulated pixels


@lru_cache(maxsize=2)
def _draws(present: bytes, lengths: tuple[int, ...]) -> F32:
    """Estimates (length, pixel) for unit white noise, over the true deviation."""
    there = np.frombuffer(present, dtype=bool)
    pixels = min(MAX_DRAWS, MAX_SAMPLES // len(there))
    rng = np.random.default_rng(SEED)
    out = np.empty((len(lengths), pixels), np.float32)
    root = np.sqrt(np.array(lengths, dtype=float))[:, None]
    for start in range(0, pixels, 4096):
        size = min(4096, pixels - start)
        series = rng.standard_normal((len(there), size), dtype=np.float32)
        series[~there] = np.nan
        out[:, start : start + size] = allan_deviation(series, lengths) * root
    return out


def white_population(
    present: Mask, lengths: Sequence[int], noise: NDArray[np.floating] | None = None
) -> White:
    """Simulate pixels with white noise, at averaging ``lengths`` in batches.

    ``present``: (batch,) false in gaps. ``noise``: (n,) levels, equally often; without it the
    covariance is that of a single pixel instead of a median.
    """
    draws = _draws(np.asarray(present, dtype=bool).tobytes(), tuple(lengths))
    pixels = draws.shape[1]
    # Sorted first: that is done in vectors, to find some of the ranks is not.
    limits = np.quantile(np.sort(draws, axis=1), ONE_SIGMA, axis=1).astype(float)
    middle = 0.0
    if noise is None:
        logs = np.log(draws, dtype=float)
        covariance = np.atleast_2d(np.cov(logs))
    else:
        levels = np.log(noise, dtype=float)
        logs = np.log(draws[:, : pixels // len(levels) * len(levels)], dtype=float)
        logs = (logs.reshape(len(draws), -1, len(levels)) + levels).reshape(len(draws), -1)
        middle = float(np.median(levels))
        covariance = _median_covariance(logs, len(levels))
    ranks = (ONE_SIGMA[0], 0.5, ONE_SIGMA[1])
    low, median, high = np.quantile(np.sort(logs, axis=1), ranks, axis=1)
    return White(np.exp(median - middle), (high - low) / 2, limits, covariance, pixels)


def _median_covariance(logs: F64, n_levels: int) -> F64:
    """Covariance of the medians of rows, about the ``n_levels`` noise levels, times the columns."""
    # The median's influence function is sign(x - median) / (2 f), f the density at the median.
    near = (0.46, 0.5, 0.54)
    below, median, above = np.quantile(logs, near, axis=1)
    density = (near[2] - near[0]) / (above - below)
    signs = np.where(logs > median[:, None], np.float32(1), np.float32(-1))
    signs = signs.reshape(len(logs), -1, n_levels)
    repeats = signs.shape[1]
    signs = (signs - signs.mean(axis=1, keepdims=True)).reshape(len(logs), -1)
    products = (signs @ signs.T).astype(float) / (n_levels * (repeats - 1))
    return np.asarray(products / (4 * np.outer(density, density)))


def shared_noise(grams: Sequence[F64], pixels: int) -> F64:
    """One over the number of pixels that are independent of each other, for each length.

    ``grams``: (difference, difference) for each length, sums over pixels of products of
    `disjoint_differences` over each pixel's noise. Differences independent in time have a mean
    squared correlation sum_pq rho_pq² / N², the inverse of the effective number; only an excess
    over 1/N beyond three sigma counts, and stays for longer lengths, where fewer differences are
    left to show it.
    """
    excess = 1.0
    shares = []
    for gram in grams:
        power = np.diag(gram)
        kept = power > 0
        gram, power = gram[np.ix_(kept, kept)], power[kept]
        pairs = len(power) * (len(power) - 1) // 2
        if pairs:
            correlation = gram[np.triu_indices(len(power), 1)] ** 2
            correlation /= np.outer(power, power)[np.triu_indices(len(power), 1)]
            measured = pixels * float(correlation.mean())
            if measured > 1 + 3 * np.sqrt(2 / pairs):
                excess = max(excess, measured)
        shares.append(min(1.0, excess / pixels))
    return np.array(shares)


@dataclass(frozen=True)
class AllanCurve:
    """An Allan curve, all in px and batches."""

    # adev, error, low, high: (length,) deviation, its one-sigma error and one-sigma limits
    adev: F64
    error: F64
    low: F64
    high: F64
    # slope, slope_error: of log deviation against log length, over the white part; None with
    # fewer than two lengths
    slope: float | None
    slope_error: float | None
    # length where the rest (floor and random walk) equals the white part; None when white noise
    # alone explains the curve
    knee: float | None


NO_CURVE = AllanCurve(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), None, None, None)


def fit_curve(
    lengths: Sequence[int], median: F64, spread: F64, pixels: int, shared: F64, white: White
) -> AllanCurve:
    """Unbias a window's medians, and find slope and knee.

    lengths : averaging lengths, batches
    median, spread : (length,) median of the estimates (px), and half the central 68 % of their log
    pixels : number of pixels; a single one keeps its plain estimate, as `allantools` gives it
    shared, white : of `shared_noise`; simulated for the same gaps, lengths and noise levels

    The slope is the generalised least-squares line: the simulated covariance over the effective
    number of pixels, scaled up where pixels scatter more than white noise does.
    """
    m = np.array(lengths, dtype=float)
    wider = np.maximum(1.0, spread / white.spread) if pixels > 20 else np.ones(len(m))
    root = np.sqrt(shared) * wider
    covariance = white.covariance * (np.outer(root, root) + 1 / white.pixels)
    error = np.sqrt(np.diag(covariance))
    logs = np.log(median / white.bias)
    if pixels == 1:
        adev, low, high = median, median / white.limits[1], median / white.limits[0]
    else:
        adev = np.exp(logs)
        low, high = adev * np.exp(-error), adev * np.exp(error)
    still = white.covariance * (root[0] ** 2 + 1 / white.pixels)
    rest = _find_rest(m, logs, still)
    added = np.zeros(len(m)) if rest is None else _powers(m) @ rest
    part = added < WHITE_SHARE
    line = _fit_slope(m[part], (logs - np.log1p(added) / 2)[part], covariance[np.ix_(part, part)])
    knee = None if rest is None else _knee(rest)
    return AllanCurve(adev, adev * error, low, high, *line, knee)


def _fit_slope(m: F64, logs: F64, covariance: F64) -> tuple[float | None, float | None]:
    if len(m) < 2:
        return None, None
    design = np.stack([np.ones(len(m)), np.log(m)], axis=1)
    weighted = np.linalg.solve(covariance, design)
    inverse = np.linalg.inv(design.T @ weighted)
    line = inverse @ (weighted.T @ logs)
    return float(line[1]), float(np.sqrt(inverse[1, 1]))


def _powers(m: F64) -> F64:
    """Floor, random walk and drift (length, 3), over the white variance a/m."""
    return np.stack([m, m**2, m**3], axis=1)


def _find_rest(m: F64, logs: F64, covariance: F64) -> F64 | None:
    """Coefficients (b, c, d)/a of sigma² = a/m + b + c m + d m², or None where a/m suffices."""
    if len(m) < 3:
        return None
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    ones, target = whiten @ np.ones(len(m)), whiten @ (logs + np.log(m) / 2)
    level = float(ones @ target / (ones @ ones))
    chi2_white = float(np.sum((target - level * ones) ** 2))
    if chi2_white < KNEE_CHI2:
        return None
    powers = _powers(m / m[-1])

    def misfit(p: F64) -> F64:
        return np.asarray(target - whiten @ (p[0] + np.log1p(powers @ p[1:]) / 2))

    excess = max(float(np.exp(2 * (logs[-1] + np.log(m[-1]) / 2 - level))) - 1, 0.1)
    starts = [(level, *(excess * shares)) for shares in 0.05 + 0.85 * np.eye(3)]
    limits = ([-np.inf, 0, 0, 0], np.inf)
    fits = [least_squares(misfit, start, bounds=limits) for start in starts]
    best = min(fits, key=lambda fit: float(fit.cost))
    if chi2_white - 2 * best.cost < KNEE_CHI2:
        return None
    return np.asarray(best.x[1:] / _powers(m[-1:])[0])


def _knee(rest: F64) -> float:
    """Length where b m + c m² + d m³ = 1."""
    power = np.arange(1, 4)
    used = rest > 0
    upper = float(np.min(rest[used] ** (-1 / power[used])))
    return float(brentq(lambda m: float(rest @ m**power) - 1, 0, upper * 1.001))
