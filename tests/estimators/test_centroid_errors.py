"""Root mean squares of centroids: what a draw of the maps' errors adds is taken off again."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.stages.astrometry.summary import compare, running_means

F64 = NDArray[np.float64]


def drawn(true: float, error: float, stars: int, seed: int) -> tuple[F64, F64]:
    """Errors on a perfect grid and with the maps: maps are truth and error, pixels a draw more."""
    rng = np.random.default_rng(seed)
    offsets = rng.normal(0, true, (stars, 4))
    maps, draw = rng.normal(0, error, (2, stars, 4))
    return offsets + maps + draw, draw


@pytest.mark.parametrize(("true", "error"), [(3e-3, 2e-4), (1e-3, 1e-3), (2e-3, 3e-3)])
def test_the_draw_is_taken_off(true: float, error: float) -> None:
    perfect, measured = drawn(true, error, 4000, 1)
    found = compare(perfect, measured, measured, np.random.default_rng(0))
    for value, expected in (
        (found["perfect"], true),
        (found["measured"], error),
        (found["gain"], true / error),
    ):
        assert abs(value.value - expected) < 4 * value.error
    assert found["perfect"].error < 0.1 * true


def test_errors_are_those_of_other_stars() -> None:
    """The scatter of the results of many sets of stars is the error that each set gives itself."""
    results = [
        compare(*pair, pair[1], np.random.default_rng(n))
        for n, pair in enumerate(drawn(1e-3, 7e-4, 150, seed) for seed in range(60))
    ]
    for name in ("perfect", "measured", "gain"):
        values = np.array([r[name].value for r in results])
        errors = np.array([r[name].error for r in results])
        assert np.std(values) == pytest.approx(np.median(errors), rel=0.35), name


def test_what_is_not_seen_is_not_given() -> None:
    perfect, measured = drawn(0.0, 1e-3, 300, 2)
    found = compare(perfect, measured, measured, np.random.default_rng(0))
    assert math.isnan(found["perfect"].value)
    assert math.isnan(found["gain"].value)
    assert found["measured"].value == pytest.approx(1e-3, rel=0.1)


def test_against_a_truth_nothing_is_taken_off() -> None:
    perfect, measured = drawn(1e-3, 5e-4, 100, 3)
    perfect[3, 1] = measured[5] = np.nan
    found = compare(perfect, measured, np.zeros_like(measured), np.random.default_rng(0))
    good = np.isfinite(perfect) & np.isfinite(measured)
    assert found["perfect"].value == pytest.approx(np.sqrt(np.mean(perfect[good] ** 2)))
    assert found["measured"].value == pytest.approx(np.sqrt(np.mean(measured[good] ** 2)))


def test_no_stars_no_numbers() -> None:
    nothing = np.full((3, 2), np.nan)
    found = compare(nothing, nothing, nothing, np.random.default_rng(0))
    assert math.isnan(found["perfect"].value)
    assert math.isnan(found["gain"].value)


def test_means_of_the_first_positions() -> None:
    errors = np.array([[1.0, 3.0, np.nan, 5.0], [np.nan, np.nan, np.nan, 2.0]])
    one, two, all_four = running_means(errors, [1, 2, 4])
    np.testing.assert_array_equal(one, [[1.0], [np.nan]])
    np.testing.assert_array_equal(two, [[2.0], [np.nan]])
    np.testing.assert_array_equal(all_four, [[3.0], [2.0]])
