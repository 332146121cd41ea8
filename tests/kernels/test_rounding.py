"""What rounding does to noise and levels is computed exactly, and is taken out again."""

import numpy as np
import pytest

from pixcal.kernels.rounding import (
    SHEPPARD,
    level_before_rounding,
    noise_before_rounding,
    rounded_moments,
)

PIXELS = 20_000


@pytest.mark.parametrize("sigma", [0.1, 0.3, 0.5, 0.9, 1.0, 3.0])
@pytest.mark.parametrize("level", [200.0, 200.4, 200.5, 199.8])
def test_moments_are_those_of_rounded_normal_numbers(level: float, sigma: float) -> None:
    samples = np.rint(np.random.default_rng(3).normal(level, sigma, 400_000))
    mean, variance = rounded_moments(np.array([level]), sigma)
    error = np.sqrt(variance[0] / samples.size)
    assert mean[0] == pytest.approx(samples.mean(), abs=5 * error + 1e-12)
    assert variance[0] == pytest.approx(samples.var(), rel=0.015, abs=5e-5)


def test_a_step_of_noise_makes_it_sheppards_correction() -> None:
    level = np.linspace(0, 1, 11)
    mean, variance = rounded_moments(level, 0.9999)
    np.testing.assert_allclose(mean, level, atol=1e-7)
    np.testing.assert_allclose(variance, 0.9999**2 + SHEPPARD, rtol=1e-6)


@pytest.mark.parametrize("sigma", [0.2, 0.4, 0.8, 2.0])
def test_levels_come_back_from_the_means_of_codes(sigma: float) -> None:
    level = np.linspace(98.55, 101.45, 40)
    inside = np.abs(level - np.rint(level)) > (0.1 if sigma < 0.3 else -1)
    found = level_before_rounding(rounded_moments(level, sigma)[0], sigma)
    np.testing.assert_allclose(found[inside], level[inside], atol=3e-3)


@pytest.mark.parametrize("scatter", [0.0, 1.5])
@pytest.mark.parametrize("level", [29.0, 29.4, 200.5])
@pytest.mark.parametrize("sigma", [0.45, 0.6, 1.0, 3.0])
def test_the_noise_before_rounding_is_found_within_a_per_cent(
    sigma: float, level: float, scatter: float
) -> None:
    rng = np.random.default_rng(round(1000 * sigma + 10 * level + scatter))
    levels = level + scatter * rng.standard_normal(PIXELS)
    frames = np.rint(levels + sigma * rng.standard_normal((30, PIXELS)))
    variance = 0.5 * np.mean((frames[1::2] - frames[::2]) ** 2)
    error = variance * np.sqrt(2 / (15 * PIXELS))
    found = noise_before_rounding(variance, error, frames.mean(axis=0), 30)
    assert found is not None
    assert found[0] == pytest.approx(sigma, rel=0.01)
    assert found[1] < 0.005 * sigma


def test_noise_far_below_a_step_is_told_only_where_levels_differ() -> None:
    rng = np.random.default_rng(8)
    noise = 0.1 * rng.standard_normal((30, PIXELS))
    for levels, known in ((np.full(PIXELS, 29.4), False), (rng.uniform(20, 40, PIXELS), True)):
        frames = np.rint(levels + noise)
        variance = 0.5 * np.mean((frames[1::2] - frames[::2]) ** 2)
        found = noise_before_rounding(variance, 1e-3 * variance, frames.mean(axis=0), 30)
        assert (found is not None) == known
        if found is not None:
            assert found[0] == pytest.approx(0.1, abs=4 * found[1])
