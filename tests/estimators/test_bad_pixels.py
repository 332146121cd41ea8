"""Flags are set on bad pixels, and on a perfect detector on fewer than one in 100,000."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import polygamma
from scipy.stats import chi2

from pixcal.estimators.detector.bad_pixels import (
    certainly_noisy,
    dead,
    hot,
    noisy,
    noisy_factor,
    nonlinear,
    variance_nearby,
)
from pixcal.estimators.detector.calibration import ExposureLevel, step_levels, usual_variance

F64 = NDArray[np.float64]
CLEAN = (1200, 1000)
FEW = 1e-5 * CLEAN[0] * CLEAN[1]


@pytest.mark.parametrize("dof", [1, 7, 39, 999])
def test_clean_noise_is_not_noisy(dof: int) -> None:
    variance = 25 * chi2.rvs(dof, size=CLEAN, random_state=np.random.default_rng(dof)) / dof
    same = np.ones(CLEAN)
    outliers = np.random.default_rng(0).poisson(6.4e-5 * (dof + 1), CLEAN).astype(float)
    kurtosis = np.random.default_rng(1).normal(0, np.sqrt(24 / (dof + 1)), CLEAN)
    found = noisy(variance, dof * same, 25 * same, np.maximum(kurtosis, -2), outliers, 1.5)
    assert found.sum() < FEW


def test_loud_telegraph_and_blinking_pixels_are_noisy() -> None:
    one = np.ones((1, 5))
    variance = 25 * np.array([[1.0, 9.0, 1.9, 1.9, 1.0]])
    kurtosis = np.array([[0.0, 0.0, 0.0, -1.0, 0.0]])
    outliers = np.array([[0.0, 0.0, 0.0, 0.0, 20.0]])
    found = noisy(variance, 500 * one, 25 * one, kurtosis, outliers, 1.5)
    assert found.tolist() == [[False, True, False, True, True]]


def test_without_samples_nothing_is_noisy() -> None:
    zero = np.zeros((3, 3))
    assert not noisy(zero, zero, zero + 1, zero, zero, 1.5).any()


def test_clean_darks_are_not_hot_and_hot_ones_are() -> None:
    rate = np.random.default_rng(2).normal(20, 3, CLEAN)
    error = np.full(CLEAN, 3.0)
    assert hot(rate, error, 3, 10).sum() < FEW
    rate[7, 9], rate[8, 9], error[8, 9] = 100, 100, 50
    assert np.argwhere(hot(rate, error, 3, 10)).tolist() == [[7, 9]]


def test_an_unknown_rate_is_not_hot() -> None:
    assert not hot(np.array([[1e6, np.nan]]), np.zeros((1, 2)), 0, 10).any()


@pytest.mark.parametrize("sigma", [0.01, 0.09])
def test_a_clean_flat_has_no_dead_pixels(sigma: float) -> None:
    flat = np.random.default_rng(3).normal(1, sigma, CLEAN)
    # The lamp's edge is no defect.
    flat *= np.linspace(0.2, 1.2, CLEAN[1])
    error = sigma * np.broadcast_to(np.linspace(0.2, 1.2, CLEAN[1]), CLEAN)
    assert dead(flat, error, 0.5, 2.0, 0.05).sum() < FEW


def test_pixels_that_respond_too_little_or_too_much_are_dead() -> None:
    flat = np.random.default_rng(4).normal(1, 0.01, (37, 53))
    flat[36, 52], flat[5, 6], flat[20:24, 30:34] = 0.4, 2.5, 0.0
    flat[:, 48:] *= 0.3
    flat[2, 50] = 0.1
    found = dead(flat, np.full(flat.shape, 0.01), 0.5, 2.0, 0.05)
    assert {tuple(map(int, w)) for w in np.argwhere(found)} == {
        (36, 52),
        (5, 6),
        (2, 50),
        *((y, x) for y in range(20, 24) for x in range(30, 34)),
    }


def test_columns_without_light_are_dead_and_those_beside_them_are_not() -> None:
    flat = np.ones((32, 64))
    flat[:, :27] = 0.0
    found = dead(flat, np.full(flat.shape, 0.01), 0.5, 2.0, 0.05)
    np.testing.assert_array_equal(found, flat == 0)


def ladder(
    rng: np.random.Generator, shape: tuple[int, int], frames: int = 4
) -> tuple[list[ExposureLevel], F64]:
    response = rng.normal(1, 0.02, shape)
    steps = []
    for t in (0.1, 0.2, 0.4, 0.8):
        expected = 4e4 * t * response
        variance = np.full(shape, (4e4 * t + 225) / frames)
        signal = rng.normal(expected, np.sqrt(variance))
        steps.append(ExposureLevel(t, frames, signal, variance, 4e4 * t + 225))
    return steps, response


def test_a_clean_ladder_is_linear() -> None:
    steps, _ = ladder(np.random.default_rng(5), CLEAN)
    assert nonlinear(steps, step_levels(steps), 0.03).sum() < FEW
    # Even without the allowance, by significance alone.
    assert nonlinear(steps, step_levels(steps), 1e-9).sum() < FEW


def test_a_curve_that_all_pixels_share_flags_none() -> None:
    steps, _ = ladder(np.random.default_rng(6), (100, 100))
    bent = [
        ExposureLevel(r.exptime, 4, r.signal - 2e-6 * r.signal**2, r.variance, r.noise)
        for r in steps
    ]
    assert not nonlinear(bent, step_levels(bent), 0.03).any()


def test_rows_lit_otherwise_at_each_step_are_not_nonlinear_but_their_bent_pixels_are() -> None:
    steps, _ = ladder(np.random.default_rng(8), (101, 100))
    for n, step in enumerate(steps):
        step.signal[:] *= (1 + 0.1 * np.sin(0.1 * np.arange(101) + n))[:, None]
        step.signal[30, 4] *= 1 - 0.3 * step.exptime
    assert np.argwhere(nonlinear(steps, step_levels(steps), 0.03)).tolist() == [[30, 4]]


def test_light_that_an_iris_shutter_slopes_is_not_nonlinear_but_a_bent_pixel_is() -> None:
    steps, _ = ladder(np.random.default_rng(9), (101, 100))
    y, x = np.mgrid[:101, :100]
    for step in steps:
        step.signal[:] *= 1 + 0.02 / step.exptime * np.hypot(y - 150, x - 120) / 200
        step.signal[30, 4] *= 1 - 0.3 * step.exptime
    assert np.argwhere(nonlinear(steps, step_levels(steps), 0.03)).tolist() == [[30, 4]]


def test_a_pixel_that_bends_is_nonlinear() -> None:
    steps, _ = ladder(np.random.default_rng(7), (50, 60))
    for step in steps:
        step.signal[3, 4] *= 1 - 0.2 * step.exptime
        step.signal[5, 6] *= 1 - 0.005 * step.exptime
    assert np.argwhere(nonlinear(steps, step_levels(steps), 0.03)).tolist() == [[3, 4]]


def test_two_levels_do_not_tell() -> None:
    steps, _ = ladder(np.random.default_rng(8), (20, 20))
    steps[2].signal[3, 4] = steps[3].signal[3, 4] = np.nan
    steps[0].signal[3, 4] *= 2
    steps[0].signal[5, 4] *= 2
    assert np.argwhere(nonlinear(steps, step_levels(steps), 0.03)).tolist() == [[5, 4]]
    assert not nonlinear(steps[:2], step_levels(steps[:2]), 0.03).any()


@pytest.mark.parametrize("columns", [3, 20, 70])
def test_columns_without_light_leave_the_others_linear(columns: int) -> None:
    steps, _ = ladder(np.random.default_rng(8), (101, 97))
    rng = np.random.default_rng(9)
    for step in steps:
        step.signal[:, :columns] = rng.normal(0, 2, (101, columns))
    assert not nonlinear(steps, step_levels(steps), 0.03)[:, columns:].any()


def test_colours_of_a_mosaic_are_not_dead() -> None:
    flat = np.random.default_rng(10).normal(1, 0.01, (70, 83))
    flat[::2, ::2] *= 0.6
    flat[1::2, 1::2] *= 0.4
    flat[8, 8] = 0.2
    found = dead(flat, np.full(flat.shape, 0.01), 0.5, 2.0, 0.05)
    assert np.argwhere(found).tolist() == [[8, 8]]


def test_the_glow_of_an_amplifier_is_not_hot() -> None:
    y, x = np.mgrid[:90, :110]
    rate = (
        20 + 3000 * np.exp(-np.hypot(y, x) / 25) + np.random.default_rng(11).normal(0, 3, y.shape)
    )
    rate[40, 50] += 900
    assert np.argwhere(hot(rate, np.full(y.shape, 3.0), 3, 10)).tolist() == [[40, 50]]


def measured_variance(seed: int, spread: float, dof: int) -> F64:
    """Variances (y, x) of pixels whose noise is lognormal, from ``dof`` degrees of freedom."""
    rng = np.random.default_rng(seed)
    noise = 3 * rng.lognormal(0, spread, (200, 300))
    return np.asarray(noise**2 * rng.chisquare(dof, noise.shape) / dof)


@pytest.mark.parametrize("dof", [24, 49, 400])
@pytest.mark.parametrize("spread", [0.0, 0.25])
def test_a_population_of_pixels_that_differ_is_not_noisy(spread: float, dof: int) -> None:
    variance = measured_variance(6, spread, dof)
    same = np.ones_like(variance)
    factor = noisy_factor(1.5, variance, dof, 1.0)
    expected = float(np.median(variance)) * same
    found = noisy(variance, dof * same, expected, np.nan * same, 0 * same, factor)
    # No more than of a normal distribution lie beyond four standard deviations.
    assert found.mean() < 1e-4
    by_chance = 0.5 * polygamma(1, dof / 2) ** 0.5
    reach = np.exp(4 * np.hypot(spread, by_chance))
    assert factor == pytest.approx(max(1.5, reach), rel=0.05)


def test_noise_below_a_step_has_a_population_too() -> None:
    rng = np.random.default_rng(8)
    noise = 0.66 * rng.lognormal(0, 0.3, (200, 300))
    frames = np.rint(40.3 + noise * rng.standard_normal((20, *noise.shape)))
    variance = frames.var(axis=0, ddof=1)
    same = np.ones_like(variance)
    factor = noisy_factor(1.5, variance, 19, 1.0)
    expected = usual_variance(variance, 19) * same
    found = noisy(variance, 19 * same, expected, np.nan * same, 0 * same, factor)
    assert found.mean() < 1e-3


@pytest.mark.parametrize(("noise", "frames"), [(0.3, 8), (0.7, 4), (1.2, 4), (2.0, 2)])
def test_few_codes_take_no_population_for_noisy_pixels(noise: float, frames: int) -> None:
    rng = np.random.default_rng(9)
    each = noise * rng.lognormal(0, 0.35, (200, 300))
    levels = 40.3 + rng.standard_normal(each.shape)
    variance = np.rint(levels + each * rng.standard_normal((frames, *each.shape))).var(0, ddof=1)
    same, dof = np.ones_like(variance), frames - 1
    factor = noisy_factor(1.5, variance, dof, 1.0, unlike=True)
    expected = max(usual_variance(variance, dof), 0.25) * same
    found = noisy(variance, dof * same, expected, np.nan * same, 0 * same, factor)
    assert found.mean() < 1e-3
    assert variance[~found].mean() > 0.99 * variance.mean()


@pytest.mark.parametrize("dof", [2, 4, 7])
@pytest.mark.parametrize("spread", [0.0, 0.3])
def test_few_frames_take_no_population_for_noisy_pixels(spread: float, dof: int) -> None:
    variance = measured_variance(7, spread, dof)
    same = np.ones_like(variance)
    factor = noisy_factor(1.5, variance, dof, 1.0)
    if not spread:  # as if no factor was asked for
        assert factor == pytest.approx(float(certainly_noisy(dof)) ** 0.5, rel=0.05)
    expected = usual_variance(variance, dof) * same
    found = noisy(variance, dof * same, expected, np.nan * same, 0 * same, factor)
    assert found.mean() < 1e-3


@pytest.mark.parametrize("dof", [20, 60, 500])
def test_pixels_of_a_noisier_amplifier_are_not_noisy(dof: int) -> None:
    rng = np.random.default_rng(dof)
    usual = np.where(np.arange(160) < 96, 1.0, 2.2) * np.ones((96, 1))
    variance = usual * rng.chisquare(dof, usual.shape) / dof
    bad = rng.random(usual.shape) < 2e-3
    variance[bad] *= 25
    every = np.full(usual.shape, float(dof))
    nearby = variance_nearby(variance, every, 1.0)
    found = noisy(variance, every, nearby, np.nan * usual, 0 * usual, 1.5)
    np.testing.assert_array_equal(found & bad, bad)
    assert np.count_nonzero(found & ~bad) <= 3
    # Of few samples the median of a variance is below its mean, which counts.
    assert np.median(nearby[:, 96:]) == pytest.approx(2.2, rel=0.05)


@pytest.mark.parametrize("soft", [1.5, 3.0, 8.0])
def test_the_soft_edge_of_a_round_field_is_not_dead(soft: float) -> None:
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:160, :176]
    lit = 1 / (1 + np.exp((np.hypot(y - 80, x - 88) - 70) / soft))
    true = rng.random(lit.shape) < 2e-3
    true[40:44, 90:94] = True
    flat = lit * (1 + 0.01 * rng.standard_normal(lit.shape)) * np.where(true, 0.2, 1.0)
    found = dead(flat, np.full(lit.shape, 1e-3), 0.5, 1.5, 0.05)
    seen = lit > 0.25
    assert np.count_nonzero(found & ~true & seen) <= 1e-4 * lit.size
    # Beside the edge a dead pixel may be as bright as those on one side of it.
    assert found[true & (lit > 0.8)].all()
    assert found[lit < 0.04].all()
