"""What offsets of independent frames differ by, over what their errors allow."""

from types import SimpleNamespace

import numpy as np
import pytest

from pixcal.stages.diagnose.measure_nominal import excess_scatter

SHAPE, K, ERROR = (67, 53), 0.7, 1e-3


def halves(times):
    """Two halves of the frames: alike but for errors, which are so many times those told."""
    rng = np.random.default_rng(3)
    true = 6e-3 * rng.standard_normal(SHAPE)
    return [
        SimpleNamespace(
            k=(K, 0.0),
            delta=true + times * ERROR * rng.standard_normal(SHAPE),
            sigma=np.full(SHAPE, ERROR * K),
        )
        for _ in range(2)
    ]


@pytest.mark.parametrize("times", [1.0, 2.5])
def test_errors_larger_than_told_are_seen_and_true_offsets_are_not(times):
    good = np.random.default_rng(4).random(SHAPE) > 0.01
    assert excess_scatter(halves(times), good) == pytest.approx(times, rel=0.05)


def test_errors_smaller_than_told_and_a_single_part_change_nothing():
    assert excess_scatter(halves(0.3), np.ones(SHAPE, bool)) == 1
    assert excess_scatter(halves(1.0)[:1], np.ones(SHAPE, bool)) == 1
