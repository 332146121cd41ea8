"""Settling of rows: a step of the phase is told from harmonics of the frame's own phase."""

import numpy as np
import pytest

from pixcal.estimators.frame_series.row_sums import steps_of, without_own_harmonics


@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_harmonics_of_a_frames_own_phase_are_no_step(order: int) -> None:
    phi = np.random.default_rng(order).uniform(-np.pi, np.pi, 301)
    own = 0.3 * np.sin(order * phi + 0.4) + 1.7
    np.testing.assert_allclose(without_own_harmonics(own, phi), 0.0, atol=1e-10)


@pytest.mark.parametrize("way", [-1, 1])
def test_half_of_the_steps_of_random_phases_is_left(way: int) -> None:
    phi = np.random.default_rng(5).uniform(0, 2 * np.pi, 20_001)
    step = steps_of(phi, way, 0.0)
    # The other frame's phase and all harmonics of its own beyond the fourth.
    beyond = 1 - 6 / np.pi**2 * sum(1 / n**2 for n in range(1, 5))
    left = np.var(without_own_harmonics(step, phi)) / np.var(step)
    assert left == pytest.approx((1 + beyond) / 2, rel=0.03)
