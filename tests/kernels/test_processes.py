"""Processes: their correlation and size, the same first samples whatever their number."""

import numpy as np
import pytest

from pixcal.kernels.processes import autoregression, mean_sine, ramp_step


def test_a_damped_walk_is_the_recursion_that_defines_it() -> None:
    drawn, keep = np.random.default_rng(1).standard_normal(50), 0.8
    expected = [drawn[0]]
    for step in drawn[1:]:
        expected.append(keep * expected[-1] + np.sqrt(1 - keep**2) * step)
    np.testing.assert_allclose(autoregression(drawn, keep), expected, rtol=1e-12)
    first = autoregression(drawn[:20], keep)
    np.testing.assert_array_equal(autoregression(drawn, keep)[:20], first)
    np.testing.assert_allclose(autoregression(drawn, 0.0), drawn)
    assert len(autoregression(drawn[:0], keep)) == 0


def test_a_swing_is_the_mean_of_the_sine_over_the_exposure() -> None:
    time, hz, phase, exptime = np.array([0.0, 0.31, 7.7]), 3.7, 0.4, 0.2
    inside = (np.arange(20_000) + 0.5) / 20_000 * exptime
    means = np.sin(2 * np.pi * hz * (time[:, None] + inside) + phase).mean(axis=1)
    np.testing.assert_allclose(mean_sine(time, hz, phase, exptime), means, atol=1e-8)
    assert mean_sine(time, 5.0, phase, 0.2) == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("step", [0.35, -1.1, 3.0])
def test_the_step_of_a_ramp_is_found_and_random_phases_are_none(step: float) -> None:
    rng = np.random.default_rng(3)
    noise = 0.05 * rng.standard_normal(101)
    wrapped = np.angle(np.exp(1j * (0.7 + step * np.arange(101) + noise)))
    assert ramp_step(wrapped) == pytest.approx(step, abs=0.01)
    assert ramp_step(2 * np.pi * rng.random(101)) == 0
    assert ramp_step(np.zeros(1)) == 0
