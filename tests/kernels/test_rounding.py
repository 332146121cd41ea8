"""What rounding does to noise and levels is computed exactly, and is taken out again."""

import numpy as np
import pytest

from pixcal.kernels.rounding import SHEPPARD, level_before_rounding, rounded_moments


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
