"""Sums over all samples (t, y, x) of some frames."""

from typing import Any

import numpy as np

from pixcal.kernels import kernel
from pixcal.model.arrays import F32, F64, Indices, Mask


def clipped_residuals(
    samples: F32, model: F32, shot: F32, read: F32, good: Mask, most: float, limits: F64
) -> tuple[F32, F32, F64, F64]:
    """Residuals with and without division by their noise, and sums from the same sweep.

    samples, model : (t, y, x)
    shot, read : (y, x) the variance of a sample is ``shot * max(model, 0) + read``
    good : (y, x)
    most : standard deviations beyond which a residual is an outlier
    limits : (n,) standard deviations beyond which residuals are counted, ascending

    Returns the residuals (t, y, x), float32, zero for outliers, for NaN and in pixels that are not
    good; the mean variance (t,) of the good pixels; the number (2, n) of residuals of good pixels
    below and above each limit.
    """
    calm, kept = np.zeros_like(samples), np.zeros_like(samples)
    variance, beyond = np.zeros(len(samples)), np.zeros((2, len(limits)))
    square = np.float32(most**2)
    # Frame by frame, to stay in the cache.
    for t, (own, signal) in enumerate(zip(samples, model, strict=True)):
        noise = shot * np.maximum(signal, np.float32(0)) + read
        rest = own - signal
        inside = good & (rest * rest < square * noise)
        np.copyto(kept[t], rest, where=inside)
        np.divide(rest, np.sqrt(noise, where=inside, out=noise.copy()), out=calm[t], where=inside)
        variance[t] = np.sum(noise, dtype=float, where=good)
        beyond += count_beyond(rest, noise, good, limits)
    return calm, kept, variance / max(int(np.count_nonzero(good)), 1), beyond


def count_beyond(rest: F32, variance: F32, good: Mask, limits: F64) -> F64:
    """How many residuals of good pixels are below and above (2, n) ascending limits, in sigmas.

    ``rest, variance``: (..., y, x), NaN left out; ``good``: (y, x).
    """
    far = good & (rest * rest > np.float32(limits[0] ** 2) * variance)
    some = rest[far]
    beyond = (some * some)[:, None] > limits**2 * variance[far][:, None]
    return np.stack([beyond[some < 0].sum(axis=0), beyond[some > 0].sum(axis=0)]).astype(float)


@kernel()
def level_sums(
    level: F32, good: Mask, low: float, step: float, values: F32, squared: F32, sums: F64
) -> None:
    """Add samples of good pixels to bins of their level; beyond the last bin they are in it.

    Of ``level``, ``values``, ``squared`` (t, y, x); bins begin at ``low`` and are ``step`` wide.
    To ``sums`` (n, 3) are added count, sum of values, sum of the squares of the others.
    """
    first, scale, last = np.float32(low), np.float32(1 / step), len(sums) - 1
    for t in range(level.shape[0]):
        for y in range(level.shape[1]):
            for x in range(level.shape[2]):
                if good[y, x]:
                    n = min(max(int((level[t, y, x] - first) * scale), 0), last)
                    sums[n, 0] += 1
                    sums[n, 1] += values[t, y, x]
                    sums[n, 2] += np.float64(squared[t, y, x]) ** 2


def count_remainders(codes: Any, good: Mask, divisor: int) -> Indices:
    """Counts of each remainder, on division by 2ⁿ, of whole numbers (t, y, x) of good pixels."""
    # Frame by frame: NumPy counts in a copy of 64 bits.
    counts = (np.bincount(frame[good] & (divisor - 1), minlength=divisor) for frame in codes)
    return np.asarray(np.sum(list(counts), axis=0))


def pixel_moments(values: F32) -> tuple[F64, F64]:
    """Mean square and mean fourth power (y, x) of the samples (t, y, x) of each pixel."""
    second, fourth = np.zeros((2, *values.shape[1:]))
    for frame in values:
        square = frame.astype(float) ** 2
        second += square
        fourth += square * square
    return second / len(values), fourth / len(values)


def frame_means(values: Any, good: Mask) -> F64:
    """Mean (t,) over the good pixels of each frame (t, y, x); the others may be NaN."""
    sums: F64 = np.sum(values, axis=(1, 2), dtype=float, where=good)
    return sums / max(int(np.count_nonzero(good)), 1)


def neighbour_products(values: F32, pairs: F32, steps: Indices, every: int = 1) -> F64:
    """Sums (step, y) of the products of samples with those a step away, by their first row.

    ``pairs``: (step, y, x) weight of each pair, by the place of its first row and of its column
    that is further left; those beyond the edges are ignored. ``steps``: (step, 2) rows down (not
    negative) and columns to the right. Only ``every`` so many frames are used.
    """
    sums = np.zeros((len(steps), values.shape[1]))
    _add_products(values, pairs, steps, every, sums)
    return sums


def products_by_level(
    values: F32, level: F32, middle: np.float32, pairs: F32, steps: Indices, every: int = 1
) -> F64:
    """As above (2, step, y), of pairs both above the ``middle`` of ``level``, and both below."""
    some, high = values[::every], level[::every] > middle
    parts = (some * part for part in (high, ~high))  # a choice takes many times as long
    return np.stack([neighbour_products(part, pairs, steps) for part in parts])


@kernel(fastmath={"reassoc", "contract", "nsz", "arcp"})
def _add_products(values: F32, pairs: F32, steps: Indices, every: int, sums: F64) -> None:
    for t in range(0, values.shape[0], every):
        for n in range(len(steps)):
            dy, dx = steps[n, 0], steps[n, 1]
            here, there, width = max(0, -dx), max(0, dx), values.shape[2] - abs(dx)
            for y in range(values.shape[1] - dy):
                weight = pairs[n, y]
                one = values[t, y, here : here + width]
                other = values[t, y + dy, there : there + width]
                line = np.float32(0)
                for x in range(width):
                    line += weight[x] * one[x] * other[x]
                sums[n, y] += np.float64(line)
