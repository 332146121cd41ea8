"""Hidden states: the likelihood is that of all ways that the states can go."""

from itertools import product

import numpy as np
import pytest

from pixcal.estimators.frame_series.hopping import log_growth


@pytest.mark.parametrize("size", [0.7, 30.0, 800.0])
@pytest.mark.parametrize("most", [1e-4, 0.2, 0.5])
def test_the_likelihood_is_a_sum_over_all_ways(size: float, most: float) -> None:
    odds = size * np.random.default_rng(3).standard_normal(7)
    change = most * np.linspace(0.3, 1, len(odds) - 1)
    ways = np.array(list(product((0, 1), repeat=len(odds))))
    changed = np.diff(ways, axis=1) != 0
    log = ways @ odds + np.where(changed, np.log(change), np.log1p(-change)).sum(axis=1)
    log += np.log(0.5)
    expected = log.max() + np.log(np.exp(log - log.max()).sum())
    assert log_growth(odds, change) == pytest.approx(expected, rel=1e-9, abs=1e-9)


def test_one_frame_is_by_itself() -> None:
    likelihood = log_growth(np.array([1.0]), np.zeros(0))
    assert likelihood == pytest.approx(np.log((1 + np.e) / 2))
