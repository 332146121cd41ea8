"""Medians and robust standard deviations of values."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

_SAMPLED = 4096  # values above which the median is sought near that of a sample
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
