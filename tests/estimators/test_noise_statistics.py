"""Read noise distribution where samples are coarse; power of lines."""

import numpy as np

from pixcal.estimators.test_statistics.noise import QUANTILES, line_power, ranges_about


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


def test_only_white_noise_of_lines_adds_as_much_to_pairs_as_to_differences() -> None:
    """Columns that alternate, or share noise in pairs, are no white noise of columns."""
    rng = np.random.default_rng(5)
    white = rng.standard_normal((2000, 1, 60))
    kinds = white, (-1.0) ** np.arange(60) * white[:, :, :1], np.repeat(white[:, :, ::2], 2, axis=2)
    good = np.ones((20, 60), bool)
    frames = rng.standard_normal((2000, 20, 60))
    plain = line_power(np.float32(frames), good)
    for columns, shares in zip(kinds, ((1, 1), (0, 2), (1.5, 0.5)), strict=True):
        power = line_power(np.float32(frames + 0.1 * columns), good) / plain - 1
        np.testing.assert_allclose(power[2:] / 0.2, shares, atol=0.15)
        np.testing.assert_allclose(power[:2], 0, atol=0.02)
