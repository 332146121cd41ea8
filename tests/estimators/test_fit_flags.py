"""Pixels that do not fit, beside pixels that all fit a little worse than noise would."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pixcal.estimators.fringe_fit.fit_flags import excess_scatter, fit_flags, typical_chi2
from pixcal.model.flags import PixelFlag

SHAPE, FREEDOM = (97, 113), 497


def of_noise(scale: np.ndarray | float = 1.0, seed: int = 1) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return scale * rng.chisquare(FREEDOM, SHAPE) / FREEDOM


def flagged(chi2: np.ndarray, noise: float, excess: float, limit: float = 1.1) -> np.ndarray:
    ones = np.ones(SHAPE, np.float32)
    count = (FREEDOM + 3) * ones
    maps: Any = SimpleNamespace(
        iota=100 * ones, alpha=80 * ones, sigma=0.01 * ones, chi2=chi2, count=count
    )
    found = fit_flags(np.zeros(SHAPE, np.uint8), maps, noise, excess, limit)
    return found == PixelFlag.BAD_FIT


@pytest.mark.parametrize("freedom", [13, 97, FREEDOM])
def test_pure_noise_is_usual_and_has_no_excess(freedom: int) -> None:
    values = np.random.default_rng(3).chisquare(freedom, 200_000) / freedom
    assert typical_chi2(1.7 * values, freedom) == pytest.approx(1.7, rel=3e-3)
    # the square root of what is left of a difference of squares
    assert excess_scatter(1.7 * values, freedom) < 0.2 * np.sqrt(2 / freedom)


@pytest.mark.parametrize("excess", [0.05, 0.2])
def test_excess_scatter_is_found_beside_defects(excess: float) -> None:
    more = 1 + excess * np.random.default_rng(4).standard_normal(SHAPE)
    chi2 = of_noise(more).ravel()
    # The error of a distance of quantiles is 1.3 standard deviations over the root of the number.
    error = 1.3 / np.sqrt(chi2.size) * (excess**2 + 2 / FREEDOM) / excess
    assert excess_scatter(chi2, FREEDOM) == pytest.approx(excess, abs=4 * error)
    chi2[::100] *= 50
    assert excess_scatter(chi2, FREEDOM) == pytest.approx(excess, abs=4 * error + 0.04 * excess)


def test_pixels_that_share_an_effect_are_no_defects() -> None:
    unlike = np.random.default_rng(5).standard_normal(SHAPE)
    chi2 = of_noise(1 + 0.3 * unlike**2)
    chi2[11, 13] = 20
    usual = (typical_chi2(chi2.ravel(), FREEDOM), excess_scatter(chi2.ravel(), FREEDOM))
    found = flagged(chi2, *usual)
    assert found[11, 13]
    assert found.mean() < 1e-3
    assert flagged(chi2, usual[0], 0.0).mean() > 0.02


def test_without_pixels_nothing_is_unusual() -> None:
    assert typical_chi2(np.empty(0), 7) == 1.0
    assert excess_scatter(np.empty(0), 7) == 0.0
