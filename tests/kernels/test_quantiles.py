"""Quantiles of numbers in parts."""

from collections.abc import Iterator

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.kernels.medians import quantiles_of_parts

F32 = NDArray[np.float32]
LEVELS = (0.0, 0.15865525393145707, 0.3, 0.5, 0.8413447460685429, 1.0)


@pytest.mark.parametrize("number", [1, 2, 7, 5003])
@pytest.mark.parametrize("spread", [1e-9, 0.3, 20.0])
def test_they_are_those_of_all_at_once(number: int, spread: float) -> None:
    values = np.exp(np.random.default_rng(number).normal(-7, spread, number)).astype(np.float32)
    values[: number // 3] = values[-1]  # many alike

    def parts() -> Iterator[F32]:
        yield from np.array_split(values, 7)

    found, count = quantiles_of_parts(parts, LEVELS)
    assert count == number
    np.testing.assert_array_equal(found, np.quantile(values, LEVELS))


def test_of_no_numbers_there_are_none() -> None:
    found, count = quantiles_of_parts(lambda: [np.zeros(0, np.float32)], LEVELS)
    assert (len(found), count) == (0, 0)
