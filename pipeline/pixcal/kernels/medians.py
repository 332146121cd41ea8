"""Medians, quantiles and robust standard deviations of values."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.model.arrays import F32, F64

_SAMPLED = 4096  # values above which the median is sought near that of a sample
_DIGIT = 16  # bits of a number that `quantiles_of_parts` sorts per pass
SIGMA_OF_MAD = 1.482602218505602


def finite_median(values: NDArray[Any]) -> float:
    """Median of the finite values (n,); NaN if there are none."""
    finite = values[np.isfinite(values)]
    return median(finite) if finite.size else math.nan


def robust_sigma(values: NDArray[Any]) -> float:
    """Robust standard deviation of the finite values about zero (1.4826 median); NaN if none."""
    return SIGMA_OF_MAD * finite_median(np.abs(values))


def median(values: NDArray[Any]) -> float:
    """Median of finite values (n,), as numpy's but faster; may reorder them."""
    low, high = (len(values) - 1) // 2, len(values) // 2
    if len(values) > _SAMPLED:
        # Only values near the median of a sample are sorted; it is nearly always among them.
        sample = np.sort(values[:: int(len(values) ** (1 / 3)) | 1])
        reach = int(1.5 * len(sample) ** 0.5) + 1
        first, last = sample[len(sample) // 2 - reach], sample[len(sample) // 2 + reach]
        below = int(np.count_nonzero(values < first))
        near = values[(values >= first) & (values <= last)]
        if below <= low and high < below + len(near):
            values, low, high = near, low - below, high - below
    values.partition(high)
    lower = values[high] if low == high else values[:high].max()
    return float((lower + values[high]) / 2)


def median_and_sigma(values: NDArray[Any]) -> tuple[float, float]:
    """Median of the finite values and their robust standard deviation (1.4826 MAD); NaN if none."""
    finite = values[np.isfinite(values)].astype(float)
    if not finite.size:
        return np.nan, np.nan
    middle = median(finite)
    return middle, robust_sigma(finite - middle)


def quantiles_of_parts(
    parts: Callable[[], Iterable[F32]], levels: Sequence[float] | F64
) -> tuple[F64, int]:
    """Quantiles of positive finite numbers given in parts (n,), equal to `numpy.quantile` of all.

    Returns them (empty without numbers) and the count of numbers; ``parts`` is called twice.
    """
    # The bits of positive floats, read as integers, have the order of their values.
    counts = np.zeros(1 << _DIGIT, np.int64)
    for part in parts():
        counts += np.bincount(part.view(np.uint32) >> _DIGIT, minlength=len(counts))
    n = int(counts.sum())
    if not n:
        return np.zeros(0), 0
    at = np.asarray(levels) * (n - 1)
    ranks = np.stack([np.floor(at), np.ceil(at)]).astype(np.int64)
    before = np.cumsum(counts) - counts
    first = np.searchsorted(before, ranks, side="right") - 1
    within = {int(digit): np.zeros(1 << _DIGIT, np.int64) for digit in np.unique(first)}
    for part in parts():
        bits = part.view(np.uint32)
        for digit, tally in within.items():
            of_digit = bits[bits >> _DIGIT == digit] & ((1 << _DIGIT) - 1)
            tally += np.bincount(of_digit, minlength=len(tally))
    upto = {digit: np.cumsum(tally) for digit, tally in within.items()}
    values = np.empty(ranks.shape, np.float32)
    for place in np.ndindex(ranks.shape):
        digit = int(first[place])
        rank = ranks[place] - before[digit]
        last = int(np.searchsorted(upto[digit], rank, side="right"))
        values[place] = np.array(digit << _DIGIT | last, np.uint32).view(np.float32)
    shares = at - ranks[0]
    return np.array([np.quantile(v, s) for v, s in zip(values.T, shares, strict=True)]), n
