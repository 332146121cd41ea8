"""Charge that stays behind: binomial, and never more than there is."""

import numpy as np
import pytest

from pixcal.kernels.charge_release import in_bands, left_behind

SHAPE = (211, 307)


def stays(charge: float, share: float, seed: int | None = 0) -> np.ndarray:
    normal = np.zeros(SHAPE)
    if seed is not None:
        normal = np.random.default_rng(seed).standard_normal(SHAPE)
    full = (np.full(SHAPE, value, np.float32) for value in (charge, share))
    of_charge, of_share = full
    return left_behind(of_charge, of_share * of_charge, of_share, normal.astype(np.float32))


@pytest.mark.parametrize("share", [0.0, 0.01, 0.3, 0.5])
def test_mean_and_variance_are_binomial(share: float) -> None:
    charge = 1e4
    found, variance = stays(charge, share), charge * share * (1 - share)
    assert found.mean() == pytest.approx(charge * share, abs=5 * np.sqrt(variance / found.size))
    assert found.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / found.size), abs=1e-9)


def test_without_noise_it_is_the_share() -> None:
    np.testing.assert_allclose(stays(5000.0, 0.02, None), 100.0, rtol=1e-6)


@pytest.mark.parametrize("charge", [-3.0, 0.0, 0.5, 3.0])
def test_no_more_stays_than_there_is(charge: float) -> None:
    found = stays(charge, 0.4)
    assert found.min() >= 0
    assert found.max() <= max(charge, 0.0)


def test_bands_of_the_charge_are_the_whole_of_it() -> None:
    charge = np.array([[500.0, 1500.0, 5000.0, -3.0]], np.float32)
    np.testing.assert_allclose(
        in_bands(charge, 8000.0),
        [[[500, 1000, 1000, 0]], [[0, 500, 1000, 0]], [[0, 0, 2000, 0]], [[0, 0, 1000, 0]]],
    )
    np.testing.assert_allclose(in_bands(charge, 8000.0, 2)[1], [[0, 500, 4000, 0]])
