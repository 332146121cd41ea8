"""Read noise distribution of the pixels where samples are coarse."""

import numpy as np

from pixcal.estimators.test_statistics.noise import QUANTILES, ranges_about


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
