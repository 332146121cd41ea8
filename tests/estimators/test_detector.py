"""Bias, dark signal, response and linearity from combined frames, in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2

from pixcal.estimators.detector.calibration import (
    ExposureLevel,
    dark_line,
    linearity,
    relative_response,
    step_levels,
    usual_variance,
)
from pixcal.kernels.medians import median_and_sigma

F64 = NDArray[np.float64]
SHAPE = (7, 11)


def full(value: float) -> F64:
    return np.full(SHAPE, value)


def test_a_line_through_bias_and_darks_is_exact_without_noise() -> None:
    rng = np.random.default_rng(0)
    bias, rate = rng.normal(500, 5, SHAPE), rng.exponential(20, SHAPE)
    times, counts = [0.0, 0.3, 2.0], [full(40), full(5), full(16)]
    line = dark_line([bias + rate * t for t in times], counts, times)
    np.testing.assert_allclose(line.bias, bias)
    np.testing.assert_allclose(line.rate, rate)
    np.testing.assert_allclose(line.signal(1.7), bias + rate * 1.7)


def test_the_errors_of_a_line_are_those_of_weighted_least_squares() -> None:
    times, counts = np.array([0.0, 0.3, 2.0]), np.array([40.0, 5.0, 16.0])
    line = dark_line([full(500.0)] * 3, [full(n) for n in counts], list(times))
    design = np.stack([np.ones(3), times], axis=1)
    covariance = np.linalg.inv(design.T @ (counts[:, None] * design))
    for t in (0.0, 0.5, 3.0):
        at = np.array([1, t])
        np.testing.assert_allclose(line.variance(t), at @ covariance @ at)
    np.testing.assert_allclose(line.per_rate, covariance[1, 1])


def test_one_exposure_time_gives_no_rate() -> None:
    line = dark_line([full(510.0), full(520.0)], [full(3), full(1)], [0.5, 0.5])
    np.testing.assert_allclose(line.bias, 512.5)
    np.testing.assert_array_equal(line.rate, 0)
    np.testing.assert_allclose(line.variance(7.0), 1 / 4)


def test_a_pixel_without_samples_has_no_line() -> None:
    bias, dark = full(500.0), full(520.0)
    bias[2, 3] = dark[2, 3] = np.nan
    dark[4, 5] = np.nan
    line = dark_line([bias, dark], [full(9), full(9)], [0.0, 1.0])
    assert np.isnan(line.bias[2, 3])
    assert np.isnan(line.rate[4, 5])
    assert np.isfinite(line.rate).sum() == line.rate.size - 2


def test_levels_of_a_colour_filter_stay_on_their_line() -> None:
    """Half of the pixels see 40 % less light; noise moves the median between the two."""
    rng = np.random.default_rng(5)
    colour = np.where(np.indices((31, 37)).sum(axis=0) % 2, 0.6, 1.0)
    times = np.array([0.1, 0.2, 0.4, 0.8])
    signals = [rng.poisson(2e4 * t * colour).astype(float) for t in times]
    steps = [
        ExposureLevel(float(t), 1, s, s, float(s.mean()))
        for t, s in zip(times, signals, strict=True)
    ]
    levels = step_levels(steps)
    error = np.sqrt(levels / (0.8 * colour.size))
    line = times * levels.sum() / times.sum()
    assert np.all(np.abs(levels - line) < 4 * error)


def test_the_response_is_all_charge_over_all_light() -> None:
    rate = np.random.default_rng(1).normal(1e5, 1e3, SHAPE)
    times = (0.1, 0.2, 0.4)
    steps = [
        ExposureLevel(t, n, rate * t, full(rate.mean() * t / n), rate.mean() * t)
        for t, n in zip(times, (3, 5, 7), strict=True)
    ]
    levels = step_levels(steps)
    found, error = relative_response(steps, levels)
    np.testing.assert_allclose(found, rate / np.median(rate))
    light = sum(level * n for level, n in zip(levels, (3, 5, 7)))  # noqa: B905
    seconds = sum(t * n for t, n in zip(times, (3, 5, 7)))  # noqa: B905
    # Poisson: the variance of the whole charge is that charge.
    np.testing.assert_allclose(error, np.sqrt(rate.mean() * seconds) / light)


def test_a_saturated_step_does_not_count() -> None:
    short, long = full(1e4), full(4e4)
    long[3, 3] = np.nan
    short[5, 5] = long[5, 5] = np.nan
    steps = [
        ExposureLevel(0.1, 4, short, full(1.0), 1.0),
        ExposureLevel(0.4, 4, long, full(1.0), 1.0),
    ]
    found, _ = relative_response(steps, step_levels(steps))
    assert found[3, 3] == pytest.approx(1)
    assert np.isnan(found[5, 5])


def test_a_straight_ladder_is_straight() -> None:
    times = np.array([0.1, 0.2, 0.5, 1.0])
    found = linearity(times, 3 + 4e4 * times, np.ones(4, np.bool_))
    assert found is not None
    assert found.max_deviation < 1e-12
    assert found.slope == pytest.approx(4e4)
    assert found.intercept == pytest.approx(3)


def test_a_bent_ladder_is_bent() -> None:
    times = np.linspace(0.1, 1, 8)
    straight = 5e4 * times
    bent = straight * (1 - 0.03 * straight / 5e4)
    found = linearity(times, bent, np.ones(8, np.bool_))
    assert found is not None
    # A parabola of 3 % at full scale, after a line is taken out.
    assert 0.003 < found.max_deviation < 0.015
    assert found.deviation[0] * found.deviation[4] < 0


def test_steps_that_are_not_used_have_no_deviation() -> None:
    times = np.array([0.1, 0.2, 0.3, 0.4])
    levels = np.array([1e4, 2e4, 3e4, 3.1e4])
    found = linearity(times, levels, np.array([True, True, True, False]))
    assert found is not None
    assert found.max_deviation < 1e-12
    assert np.isnan(found.deviation[3])
    assert linearity(times, levels, np.array([True, True, False, False])) is None


@pytest.mark.parametrize("dof", [1, 2, 5, 30])
def test_the_usual_variance_is_unbiased_and_robust(dof: int) -> None:
    rng = np.random.default_rng(dof)
    variance = 9.0 * chi2.rvs(dof, size=200_000, random_state=rng) / dof
    variance[:2000] = 1e6
    variance[2000:4000] = np.nan
    assert usual_variance(variance, dof) == pytest.approx(9, rel=0.04)
    assert np.isnan(usual_variance(variance, 0))


@pytest.mark.parametrize("noise", [5.3, 9.7, 15.0])
def test_the_usual_variance_of_pairs_of_whole_numbers_lies_between_theirs(noise: float) -> None:
    pairs = np.rint(noise * np.random.default_rng(5).standard_normal((2, 20_000)))
    assert usual_variance(pairs.var(axis=0, ddof=1), 1) == pytest.approx(
        noise**2 + 1 / 12, rel=0.05
    )


def test_median_and_sigma_of_a_gaussian_with_outliers() -> None:
    values = np.random.default_rng(2).normal(5, 3, 100_000)
    values[:100], values[100:200] = np.nan, 1e9
    median, sigma = median_and_sigma(values)
    assert median == pytest.approx(5, abs=0.05)
    assert sigma == pytest.approx(3, rel=0.02)
    assert np.isnan(median_and_sigma(np.full(3, np.nan))).all()


def test_a_lamp_that_changes_leaves_the_response_of_saturated_pixels() -> None:
    pattern = np.random.default_rng(4).normal(1, 0.1, SHAPE)
    steps = [ExposureLevel(0.1, 2, light * pattern, full(1.0), 1.0) for light in (1e3, 2e3, 4e3)]
    whole, _ = relative_response(steps, step_levels(steps))
    for step in steps:
        step.signal[step.signal > 4.3e3] = np.nan
    assert np.isnan(steps[2].signal).any()
    found, _ = relative_response(steps, step_levels(steps))
    np.testing.assert_allclose(found, whole)


def test_levels_are_those_of_pixels_that_see_the_lamp() -> None:
    signal = np.random.default_rng(5).normal(1e3, 10, SHAPE)
    signal[:, :2] = np.random.default_rng(6).normal(0, 2, (len(signal), 2))
    ended = np.where(signal > 100, np.nan, signal)
    steps = [ExposureLevel(0.1, 2, s, full(1.0), 1.0) for s in (signal, 2 * signal, ended)]
    levels = step_levels(steps)
    assert levels[1] == pytest.approx(2 * levels[0])
    assert levels[0] == pytest.approx(1e3, rel=0.01)
    assert np.isnan(levels[2])


@pytest.mark.parametrize("late", [0.02, -0.01, 0.0])
def test_exposures_longer_than_stated_shift_the_zero_of_the_line(late: float) -> None:
    times = np.array([0.2, 0.5, 1.0, 2.0, 3.0, 4.0])
    noise = 1e-5 * np.random.default_rng(3).standard_normal(6)
    found = linearity(times, 1e4 * (times + late) * (1 + noise), np.ones(6, np.bool_))
    assert found is not None
    value, error = found.late
    assert abs(value - late) < 4 * error < 1e-4
    few = linearity(times[:3], 1e4 * times[:3], np.ones(3, np.bool_))
    assert few is not None
    assert np.isinf(few.late[1])
