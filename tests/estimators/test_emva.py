"""Figures of merit after EMVA 1288: components of known variance, closed forms, honest errors."""

import numpy as np
import pytest

from pixcal.estimators.detector.emva import (
    alternation,
    dark_slope,
    dynamic_range,
    full_level,
    nonuniformity,
    saturation,
    spectrogram,
    transfer_points,
    without_gaps,
    without_trend,
)

SHAPE = (60, 80)
PARTS = {"row": 0.5, "column": 0.3, "pixel": 1.0}


def pair(rng, parts, noise, shape=SHAPE):
    """Two averages of the same pattern, with noise of their own."""
    pattern = parts["pixel"] * rng.standard_normal(shape)
    pattern += parts["row"] * rng.standard_normal((shape[0], 1))
    pattern += parts["column"] * rng.standard_normal((1, shape[1]))
    return pattern + 100 + noise * rng.standard_normal((2, *shape))


def test_components_come_out_within_their_errors_whatever_the_noise():
    pulls = []
    for draw in range(60):
        rng = np.random.default_rng(draw)
        a, b = pair(rng, PARTS, noise=2.0)
        good = rng.random(SHAPE) > 0.05
        a[~good] = b[~good] = 1e4
        found = nonuniformity(without_gaps(a, good), without_gaps(b, good), int((~good).sum()))
        pulls.append([(getattr(found, n)[0] - v) / getattr(found, n)[1] for n, v in PARTS.items()])
    # The chance that the mean of 60 leaves 4 errors, or their spread 30 %, is 1e-4 each.
    assert np.abs(np.mean(pulls, axis=0)).max() < 4 / np.sqrt(60)
    assert np.all(np.abs(np.std(pulls, axis=0) - 1) < 0.3)


def test_noise_alone_is_no_nonuniformity():
    rng = np.random.default_rng(3)
    a, b = pair(rng, dict.fromkeys(PARTS, 0.0), noise=1.0)
    found = nonuniformity(a, b, 0)
    for name in (*PARTS, "total"):
        value, error = getattr(found, name)
        assert value <= 3 * error


def test_an_uneven_lamp_is_taken_off_and_pixels_stay():
    rng = np.random.default_rng(5)
    y, x = np.mgrid[-1 : 1 : SHAPE[0] * 1j, -1 : 1 : SHAPE[1] * 1j]
    response = 0.01 * rng.standard_normal(SHAPE)
    lamp = 1 + 0.2 * x - 0.1 * y**2 + 0.05 * x * y
    rest = without_trend(3e4 * (lamp + response), np.ones(SHAPE, bool))
    assert np.std(rest) == pytest.approx(np.std(response) / lamp.mean(), rel=0.01)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_spectrum_shows_a_repeat_where_it_is_and_white_noise_flat(axis):
    rng = np.random.default_rng(axis)
    a, b = pair(rng, dict.fromkeys(PARTS, 0.0) | {"pixel": 1.0}, noise=0.5)
    place = np.arange(SHAPE[axis])
    wave = 0.2 * (-1.0) ** place
    a, b = (v + (wave if axis else wave[:, None]) for v in (a, b))
    frequency, amplitude, noise = spectrogram(
        *(without_gaps(v, np.ones(SHAPE, bool)) for v in (a, b)), axis=axis
    )
    assert frequency[-1] == 0.5
    # A wave of amplitude A has A sqrt(n) at its frequency.
    white = np.median(amplitude[:-1])
    expected = np.hypot(0.2 * np.sqrt(SHAPE[axis]), white)
    assert amplitude[-1] == pytest.approx(expected, rel=0.1)
    assert white == pytest.approx(np.hypot(1.0, 0.5 / np.sqrt(2)), rel=0.05)
    assert noise == pytest.approx(0.5 / np.sqrt(2), rel=0.03)


def test_saturation_is_where_the_variance_falls():
    level = np.linspace(100, 4000, 40)
    dof = np.full(40, 1e4)
    variance = np.where(level < 3500, level / 2, 10.0)
    points = transfer_points(np.stack([dof, dof * level, dof * variance], axis=1))
    assert saturation(points) == pytest.approx((3450.0, 50.0))
    assert full_level(points) == pytest.approx(3500.0)
    rising = transfer_points(np.stack([dof, dof * level, dof * level / 2], axis=1))
    assert saturation(rising) is None
    assert full_level(rising) == np.inf
    np.testing.assert_allclose(points[:, 2], points[:, 1] * np.sqrt(2e-4))


def test_few_samples_of_low_variance_are_no_saturation():
    # A single level of flats that reaches a little into the next bin.
    rng = np.random.default_rng(3)
    dof = np.array([2e4, 8.0])
    found = 0
    for _ in range(300):
        variance = 2e4 * rng.chisquare(dof) / dof
        found += (
            saturation(transfer_points(np.stack([dof, dof * 2.2e4, dof * variance], 1))) is not None
        )
    assert found <= 3
    full = transfer_points(np.stack([dof, dof * [2.2e4, 2.3e4], dof * [2e4, 30.0]], axis=1))
    assert saturation(full) is not None


def test_many_bins_are_put_together_without_loss():
    sums = np.abs(np.random.default_rng(1).standard_normal((512, 3))) + 0.1
    points = transfer_points(sums, most=50)
    assert len(points) <= 50
    dof = 2 * (points[:, 1] / points[:, 2]) ** 2
    assert dof.sum() == pytest.approx(sums[:, 0].sum())
    assert (dof * points[:, 0]).sum() == pytest.approx(sums[:, 1].sum())


def test_the_dynamic_range_without_read_noise_is_the_full_well():
    assert dynamic_range((1e4, 0.0), (0.0, 0.0)) == pytest.approx((1e4, 0.0, 80.0))
    ratio, error, decibels = dynamic_range((5e4, 500.0), (10.0, 0.1))
    least = np.sqrt(100.25) + 0.5
    # The signal that equals its own noise.
    assert np.sqrt(least + 10.0**2) == pytest.approx(least)
    assert ratio == pytest.approx(5e4 / least)
    assert decibels == pytest.approx(20 * np.log10(ratio))
    assert error / ratio == pytest.approx(np.hypot(0.01, 0.1 / least * 10 / np.sqrt(100.25)))


def test_dark_current_counts_the_drift_of_frames():
    times = np.repeat([0.0, 1.0, 10.0], 20)
    pulls = []
    for draw in range(60):
        drift = 0.3 * np.random.default_rng(draw).standard_normal(60)
        slope, error = dark_slope(times, 500 + 2.0 * times + drift)
        pulls.append((slope - 2.0) / error)
    assert abs(np.mean(pulls)) < 4 / np.sqrt(60)
    assert abs(np.std(pulls) - 1) < 0.3
    assert dark_slope(np.ones(9), np.ones(9)) is None


def test_dark_current_counts_a_black_level_that_is_set_anew_for_each_exposure_time():
    times = np.repeat(np.arange(8.0), 20)
    pulls = []
    for draw in range(60):
        rng = np.random.default_rng(draw)
        level = np.repeat(0.5 * rng.standard_normal(8), 20) + 0.05 * rng.standard_normal(160)
        slope, error = dark_slope(times, 500 + 2.0 * times + level)
        pulls.append((slope - 2.0) / error)
    # A Student variable of six degrees of freedom.
    assert abs(np.mean(pulls)) < 4 / np.sqrt(60)
    assert abs(np.std(pulls) / np.sqrt(6 / 4) - 1) < 0.3


@pytest.mark.parametrize("axis", [0, 1])
def test_every_second_line_that_is_higher_is_told_with_its_error(axis: int) -> None:
    rng = np.random.default_rng(20)
    found, shape = [], (120, 161)
    for size in (0.0, 2.5):
        line = size * (np.arange(shape[axis]) % 2)
        fixed = rng.normal(0, 3, shape) + np.expand_dims(line, 1 - axis)
        halves = (fixed + rng.normal(0, 1, shape) for _ in range(2))
        found.append(alternation(*halves, axis=axis))
    (none, of_none), (seen, error) = found
    assert none < 5 * of_none
    assert abs(seen - 2.5) < 5 * error < 1.5
