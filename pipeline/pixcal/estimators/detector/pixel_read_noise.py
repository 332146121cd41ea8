"""Read noise pixel by pixel, from the scatter of few frames without light.

The variance of a pixel in n frames has a relative error of sqrt(2 / (n - 1)), often more than
pixels differ by. Values are drawn from the posterior; its prior is the likeliest distribution of
all pixels on a grid (Kiefer & Wolfowitz 1956, Ann. Math. Statist. 27, 887).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import digamma, polygamma, stdtrit

from pixcal.kernels.medians import robust_sigma
from pixcal.model.arrays import F32, F64, Indices, Mask

FEWEST = 8  # frames needed for noise by pixel
OUTLIER = 4.0  # standard deviations of all pixels beyond which one is excluded from the mean
FINENESS, MOST = 8, 256  # grid points: per error of a logarithm, and at most
STEPS = 1000  # of expectation maximisation
BROAD = 0.01  # share of the start distribution that is uniform over the grid
HIT = 1e-6  # chance of a normal sample beyond which it is a hit by a particle


@dataclass(frozen=True)
class PixelNoise:
    """Posterior of the relative read noise of the pixels."""

    bin: Indices  # (y, x) bin of the measured variance; -1 in masked pixels
    cumulative: F64  # (bin, n) cumulative posterior probability on the grid of true variances
    log: F64  # (n,) that grid: logarithm of the variance over its mean, in equal steps
    rounding: float = 0.0  # share of the variance that the converter's rounding adds

    @classmethod
    def of(
        cls, stacks: Sequence[F32], good: Mask, rounding: float = 0.0, noisy: Mask | None = None
    ) -> "PixelNoise | None":
        """From frames (t, y, x) without light, ADU, and ``noisy`` pixels; None below `FEWEST`."""
        stacks = [s for s in stacks if len(s) >= 2]
        freedom = sum(len(s) - 1 for s in stacks)
        if freedom + len(stacks) < FEWEST or good.sum() < FEWEST:
            return None
        squares = np.zeros(good.shape)
        for frames in stacks:
            rest = frames - frames.mean(axis=0)
            rest -= np.median(rest[:, good], axis=1)[:, None, None]
            squares += squares_without_hits(rest)
        measured = good
        if noisy is not None:
            loud = 1 + OUTLIER * np.sqrt(2 / freedom)
            measured = good | (noisy & (squares > loud * np.median(squares[good])))
        seen = np.log(np.maximum(squares / freedom, 1e-12)[measured])
        half = freedom / 2
        # Bias and variance of the logarithm of a variance of normal samples.
        bias, error = float(digamma(half) - np.log(half)), float(polygamma(1, half))
        used = good[measured]
        seen -= float(np.median(seen[used]))
        spread = robust_sigma(seen[used]) ** 2
        step = max(np.sqrt(error) / FINENESS, float(np.ptp(seen)) / (MOST - 3))
        log = np.arange(np.floor(seen.min() / step) - 1, np.ceil(seen.max() / step) + 2) * step
        # Bins of measured variances are centred on grid points.
        bins = np.rint((seen - log[0]) / step).astype(int)
        ratio = log[:, None] - log
        chance = np.exp(half * (ratio + 1 - np.exp(ratio)))
        true = max(spread - error, (step / 3) ** 2)
        start = np.exp(-0.5 * (log + bias) ** 2 / true)
        start = (1 - BROAD) * start / start.sum() + BROAD / len(log)
        posterior = chance * _likeliest(chance, np.bincount(bins, minlength=len(log)), start)
        posterior /= posterior.sum(axis=1, keepdims=True)
        ordinary = used & (np.abs(seen) <= OUTLIER * np.sqrt(max(spread, error)))
        mean = float(np.mean((posterior @ np.exp(log))[bins[ordinary]]))
        binned = np.full(good.shape, -1)
        binned[measured] = bins
        return cls(binned, np.cumsum(posterior, axis=1), log - np.log(mean), rounding)

    def drawn(self, rng: np.random.Generator) -> F32:
        """Read noise (y, x) of every pixel before rounding, over that of the detector."""
        known = self.bin >= 0
        bins, n = self.bin[known], len(self.log)
        chance, within = rng.random((2, *self.bin.shape))
        # One search in the concatenated distributions.
        order = (self.cumulative + np.arange(len(self.cumulative))[:, None]).ravel()
        index = np.clip(np.searchsorted(order, bins + chance[known]) - bins * n, 0, n - 1)
        log = np.zeros(self.bin.shape)
        log[known] = self.log[index] + (within[known] - 0.5) * (self.log[1] - self.log[0])
        before = (np.exp(log) - self.rounding) / (1 - self.rounding)
        return np.sqrt(np.maximum(before, 0)).astype(np.float32)


def squares_without_hits(frames: F32) -> F64:
    """Sum of squares (y, x) of frames (t, y, x) about their mean, as without a single hit."""
    # A pixel that a particle hits in one frame is not noisy: a sample that is no normal number
    # beside the others of its pixel, nor beside those of usual pixels (the others may have one
    # code), is left out, and their sum extrapolated. It takes `FEWEST` frames.
    count, rest = len(frames), frames - frames.mean(axis=0)
    rest *= rest
    total: F64 = rest.sum(axis=0, dtype=float)
    if count < FEWEST:
        return total
    # What a sample takes with it when it is left out: it displaces the mean as well.
    largest = rest.max(axis=0) * (count / (count - 1))
    variance = np.maximum(total - largest, 0) / (count - 2)
    usual = np.maximum(variance, np.median(variance))
    hit = largest > stdtrit(count - 2, 1 - HIT / 2) ** 2 * usual
    return np.asarray(np.where(hit, variance * (count - 1), total))


def _likeliest(chance: F64, count: Indices, start: F64) -> F64:
    """Distribution (n,) of true values that makes the counts (bin,) likeliest."""
    # By expectation maximisation from a start; ``chance``: (bin, n) likelihood of each true value.
    share = start
    for _ in range(STEPS):
        share = share * (chance.T @ (count / np.maximum(chance @ share, 1e-300))) / count.sum()
    return np.asarray(share)
