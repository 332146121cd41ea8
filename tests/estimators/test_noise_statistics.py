"""Read noise distribution of the pixels where samples are coarse."""

import numpy as np
import pytest

from pixcal.estimators.test_statistics.noise import QUANTILES, calm_variance, ranges_about


def test_of_evenly_spread_values_they_are_the_quantiles() -> None:
    values = np.random.default_rng(1).permutation(np.linspace(0, 1, 100_001))
    np.testing.assert_allclose(ranges_about(values, QUANTILES), QUANTILES, atol=1e-4)


def test_whole_numbers_scatter_as_much_as_real_ones() -> None:
    def scatter(of: str) -> np.ndarray:
        found = []
        for seed in range(40):
            samples = np.random.default_rng(seed).normal(0.3, 0.57, (20, 5000))
            samples = np.rint(samples) if of == "codes" else samples
            found.append(ranges_about(samples.var(axis=0, ddof=1), QUANTILES))
        return np.std(found, axis=0) / np.mean(found, axis=0)

    # Quantiles themselves: 4.5 times as much at the median, 0.13 times at 0.9.
    np.testing.assert_allclose(scatter("codes"), scatter("real"), rtol=0.35)


@pytest.mark.parametrize("count", [11, 40])
def test_variance_without_the_furthest_sample_is_that_of_normal_noise(count: int) -> None:
    frames = np.random.default_rng(3).normal(7, 2, (count, 131, 97)).astype(np.float32)
    assert calm_variance(frames).mean() == pytest.approx(4, rel=0.015)


def test_a_particle_does_not_make_a_pixel_noisy() -> None:
    frames = np.random.default_rng(4).standard_normal((20, 60, 61)).astype(np.float32)
    frames[5] += 50
    assert calm_variance(frames).mean() < 1.35
    frames[6] += 50  # Twice is no particle.
    assert calm_variance(frames).mean() > 100
