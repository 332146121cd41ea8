"""Sums over all samples (t, y, x) of some frames, each in one sweep and without copies of them."""

from typing import Any

import numpy as np
from numba import njit

from pixcal.model.arrays import F32, F64, Indices, Mask

_FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def calm_residuals(rest: F32, variance: F32, good: Mask, limit: float) -> tuple[F32, F32]:
    """Residuals (t, y, x) over their noise, and as they are; zero for outliers and NaN."""
    calm, kept = np.empty_like(rest), np.empty_like(rest)
    most, zero = np.float32(limit), np.float32(0)
    for t in range(rest.shape[0]):
        for y in range(rest.shape[1]):
            for x in range(rest.shape[2]):
                size = rest[t, y, x] / np.sqrt(variance[t, y, x])
                # False of NaN.
                here = good[y, x] & (np.abs(size) <= most)
                calm[t, y, x] = size if here else zero
                kept[t, y, x] = rest[t, y, x] if here else zero
    return calm, kept


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def count_beyond(rest: F32, variance: F32, good: Mask, limits: F64) -> tuple[F64, F64]:
    """How many residuals of good pixels are below and above ascending limits (n,), in sigmas."""
    below, above = np.zeros(len(limits)), np.zeros(len(limits))
    least = np.float32(limits[0] ** 2)
    for t in range(rest.shape[0]):
        for y in range(rest.shape[1]):
            for x in range(rest.shape[2]):
                one = rest[t, y, x]
                if one * one > least * variance[t, y, x] and good[y, x]:
                    for n in range(len(limits)):
                        if one * one > limits[n] ** 2 * variance[t, y, x]:
                            below[n] += one < 0
                            above[n] += one > 0
    return below, above


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
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


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def pixel_moments(values: F32) -> tuple[F64, F64]:
    """Mean square and mean fourth power (y, x) of the samples (t, y, x) of each pixel."""
    nt, ny, nx = values.shape
    second, fourth = np.zeros((ny, nx)), np.zeros((ny, nx))
    for t in range(nt):
        for y in range(ny):
            for x in range(nx):
                square = np.float64(values[t, y, x]) ** 2
                second[y, x] += square
                fourth[y, x] += square * square
    return second / nt, fourth / nt


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def frame_means(values: Any, good: Mask) -> F64:
    """Mean (t,) over the good pixels of each frame (t, y, x); what others hold may be NaN."""
    nt, ny, nx = values.shape
    means, count = np.zeros(nt), 0
    for y in range(ny):
        for x in range(nx):
            count += good[y, x]
    for t in range(nt):
        total = 0.0
        for y in range(ny):
            for x in range(nx):
                total += np.float64(values[t, y, x]) if good[y, x] else 0.0
        means[t] = total / max(count, 1)
    return means


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
def neighbour_products(values: F32, pairs: F32, steps: Indices, every: int = 1) -> F64:
    """Sums of the products of samples with those some rows and columns on, by the first row.

    Parameters
    ----------
    values : (t, y, x) float32
    pairs : (step, y, x) float32
        Weight of each pair, by the place of its first row and of its
        column that is further left; those beyond the edges are not looked at.
    steps : (step, 2) int
        Rows down (not negative) and columns to the right.
    every : only every so many frames

    Returns
    -------
    (step, y) float64
    """
    sums = np.zeros((len(steps), values.shape[1]))
    for t in range(0, values.shape[0], every):
        for n in range(len(steps)):
            dy, dx = steps[n]
            here, there, width = max(0, -dx), max(0, dx), values.shape[2] - abs(dx)
            for y in range(values.shape[1] - dy):
                weight = pairs[n, y]
                one = values[t, y, here : here + width]
                other = values[t, y + dy, there : there + width]
                line = np.float32(0)
                for x in range(width):
                    line += weight[x] * one[x] * other[x]
                sums[n, y] += np.float64(line)
    return sums
