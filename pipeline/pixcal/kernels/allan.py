"""Allan deviation of many series at once, with gaps (NIST SP 1065, equation 11)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels import inner, kernel
from pixcal.model.arrays import F64

# series whose running sums are kept at the same time, to fit the processor's cache
PIXELS_AT_ONCE = 128


def averaging_lengths(n_batches: int) -> tuple[int, ...]:
    """Powers of two and steps between (1, 2, 3, 4, 6, 8, 12, …), up to a third of the batches."""
    octaves = [1 << n for n in range(n_batches.bit_length())]
    lengths = sorted({*octaves, *(3 * m for m in octaves)})
    return tuple(m for m in lengths if m <= n_batches // 3)


def allan_deviation(series: NDArray[np.floating], lengths: Sequence[int]) -> F64:
    r"""Overlapping Allan deviation of each column, in the unit of the series.

    .. math:: \sigma^2(m) = \tfrac12 \langle (\bar y_{k+m} - \bar y_k)^2 \rangle_k

    with :math:`\bar y_k` the mean of ``m`` batches from ``k`` on. Means with a missing batch are
    left out; batches on both sides of a gap are never joined. ``series``: (batch, pixel) evenly
    spaced in time; NaN where there is no batch. ``lengths``: of averages, batches. Returns (length,
    pixel); NaN where there is no pair of means.
    """
    out = np.empty((len(lengths), series.shape[1]))
    # Outside compiled code, because numpy's functions take longer to compile than loops.
    running, sums = np.zeros((2, len(series) + 1, PIXELS_AT_ONCE)), np.empty((2, PIXELS_AT_ONCE))
    given = np.ascontiguousarray(series), np.array(lengths, dtype=np.int64)
    _deviations(*given, *running, *sums, out)
    return out


@kernel()
def _deviations(
    series: Any, lengths: Any, total: Any, missing: Any, squares: Any, count: Any, out: Any
) -> None:
    n, n_pixels = series.shape
    for start in range(0, n_pixels, PIXELS_AT_ONCE):
        size = min(PIXELS_AT_ONCE, n_pixels - start)
        for k in range(n):
            for p in range(size):
                value = np.float64(series[k, start + p])
                absent = value != value
                total[k + 1, p] = total[k, p] + (0.0 if absent else value)
                missing[k + 1, p] = missing[k, p] + (1.0 if absent else 0.0)
        for number in range(len(lengths)):
            m = lengths[number]
            for p in range(PIXELS_AT_ONCE):
                squares[p], count[p] = 0.0, 0.0
            for k in range(n - 2 * m + 1):
                _add_difference(total, missing, k, m, squares, count)
            for p in range(size):
                mean = squares[p] / (2.0 * count[p]) if count[p] > 0 else np.nan
                out[number, start + p] = np.sqrt(mean) / m


@inner()
def _add_difference(total, missing, k, m, squares, count):  # type: ignore[no-untyped-def]
    for p in range(PIXELS_AT_ONCE):
        whole = 1.0 if missing[k + 2 * m, p] == missing[k, p] else 0.0
        step = total[k + 2 * m, p] - 2.0 * total[k + m, p] + total[k, p]
        squares[p] += whole * step * step
        count[p] += whole


def disjoint_differences(series: NDArray[np.floating], m: int, most: int) -> F64:
    """Differences (difference, pixel) of successive means of ``m`` batches; no batch is used twice.

    In white noise they are independent in time, so that their products measure the correlation of
    pixels. At most ``most`` differences, spread over a series as in `allan_deviation`.
    """
    pairs = len(series) // (2 * m)
    chosen = np.unique(np.linspace(0, pairs - 1, min(pairs, most)).round().astype(np.int64))
    before, after = np.zeros((2, len(chosen), series.shape[1]))
    for k in range(m):
        before += series[2 * m * chosen + k]
        after += series[2 * m * chosen + m + k]
    return after / m - before / m
