"""Flicker of a lamp from few frames."""

import numpy as np
import pytest

from pixcal.estimators.detector.flat_ladder import _EFFICIENCY, _rms


@pytest.mark.parametrize("count", [4, 7, 13, 40])
def test_rms_of_few_normal_values_is_unbiased_with_the_stated_freedom(count: int) -> None:
    values = np.random.default_rng(count).normal(0, 3e-4, (4000, count))
    squares = np.array([_rms(one) for one in values]) ** 2 / 9e-8
    freedom = 2 * squares.mean() ** 2 / squares.var()
    assert squares.mean() == pytest.approx(1, abs=0.05)
    assert freedom == pytest.approx(_EFFICIENCY * count, rel=0.12)


def test_a_changed_lamp_hardly_counts() -> None:
    values = np.random.default_rng(3).normal(0, 1.0, 20)
    assert _rms(np.append(values, [500.0])) < 1.25 * _rms(values)
    assert _rms(np.zeros(5)) == 0
