"""Hidden states: chances are those of all ways that the states can go."""

from itertools import product

import numpy as np
import pytest

from pixcal.estimators.frame_series.hopping import likely_states


@pytest.mark.parametrize("size", [0.7, 30.0, 800.0])
@pytest.mark.parametrize("most", [1e-4, 0.2, 0.5])
def test_chances_are_sums_over_all_ways(size: float, most: float) -> None:
    odds = size * np.random.default_rng(3).standard_normal(7)
    change = most * np.linspace(0.3, 1, len(odds) - 1)
    ways = np.array(list(product((0, 1), repeat=len(odds))))
    changed = np.diff(ways, axis=1) != 0
    changes = np.count_nonzero(changed, axis=1)
    log = ways @ odds + np.where(changed, np.log(change), np.log1p(-change)).sum(axis=1)
    log += np.log(0.5)
    weight = np.exp(log - log.max())
    second, expected, likelihood = likely_states(odds, change)
    np.testing.assert_allclose(second, weight @ ways / weight.sum(), rtol=1e-9, atol=1e-300)
    assert expected == pytest.approx(weight @ changes / weight.sum(), rel=1e-9, abs=1e-12)
    assert likelihood == pytest.approx(log.max() + np.log(weight.sum()), rel=1e-9, abs=1e-9)


def test_one_frame_is_by_itself() -> None:
    second, changes, likelihood = likely_states(np.array([1.0]), np.zeros(0))
    assert second[0] == pytest.approx(1 / (1 + np.exp(-1)))
    assert changes == 0
    assert likelihood == pytest.approx(np.log((1 + np.e) / 2))
