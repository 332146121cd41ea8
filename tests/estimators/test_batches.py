"""Batches on a regular grid of time."""

import itertools

import numpy as np
import pytest

from pixcal.estimators.fringe_fit.sweep import plan_batches


def test_a_long_run_has_batches_of_500():
    batches = plan_batches(np.arange(12_345) * 0.14)
    assert batches.frames == 500
    assert batches.ranges[0] == (0, 500)
    assert batches.ranges[-1] == (11_500, 12_000)
    np.testing.assert_allclose(np.diff(batches.time), 70.0)


def test_a_short_run_has_some_24():
    batches = plan_batches(np.arange(601) * 0.14)
    assert batches.frames == 25
    assert len(batches.ranges) == 24
    assert (batches.count == 25).all()


def test_a_pause_is_empty_batches():
    time = np.arange(100) * 0.5
    time[60:] += 20.0
    batches = plan_batches(time, 10)
    assert batches.count.tolist() == [10] * 6 + [0] * 4 + [10] * 4
    assert batches.ranges[10] == (60, 70)


def test_a_batch_that_lost_frames_is_a_gap():
    time = np.delete(np.arange(100) * 0.5, [32, 35, 36, 37])
    batches = plan_batches(time, 10)
    assert batches.count.tolist() == [10, 10, 10, 0, 10, 10, 10, 10, 10, 10]


def test_a_period_that_is_off_does_not_add_up():
    rng = np.random.default_rng(0)
    time = np.cumsum(0.14 * (1 + 0.2 * rng.uniform(-1, 1, 5000)))
    assert plan_batches(time).count.tolist() == [500] * 9 or plan_batches(time).frames < 500


@pytest.mark.parametrize(
    "time", [np.zeros(50), np.concatenate([np.arange(25), 1e9 + np.arange(25)])]
)
def test_irregular_stamps_count_frames(time):
    batches = plan_batches(time.astype(float), 10)
    assert batches.count.tolist() == [10] * 5
    assert "irregular" in batches.note


def test_every_frame_is_in_one_batch_at_most():
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.choice([0.1, 0.1, 0.1, 0.1, 1.7], 997))
    ranges = [r for r in plan_batches(time, 20).ranges if r[1] > r[0]]
    assert all(b1 <= a2 for (_, b1), (a2, _) in itertools.pairwise(ranges))
