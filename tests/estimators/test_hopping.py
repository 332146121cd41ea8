"""Hops between two levels: size and rate come out as put in, short stays and all."""

import numpy as np
import pytest

from pixcal.estimators.frame_series.hopping import find_hopping, scatter_of

STEP_S = 0.14
F64 = np.ndarray


def hopping(
    rng: np.random.Generator,
    frames: int,
    size: float,
    rate: float,
    noise: float,
    slope: float = 0.0,
) -> F64:
    hops = rng.poisson(rate * STEP_S, frames)
    levels = size * (np.cumsum(hops) % 2) + slope * np.arange(frames)
    return np.asarray(levels + noise * rng.standard_normal(frames))


def times(series: list[np.ndarray]) -> list[np.ndarray]:
    return [STEP_S * np.arange(len(one)) for one in series]


@pytest.mark.quick(1)
@pytest.mark.parametrize("slope", [0.0, 0.02])
@pytest.mark.parametrize(("size", "rate"), [(2.5, 0.2), (6.0, 0.5), (40.0, 1.5)])
def test_size_and_rate_are_found_within_their_errors(
    size: float, rate: float, slope: float
) -> None:
    rng = np.random.default_rng(7)
    pulls, rates = [], []
    for _ in range(60):
        series = [hopping(rng, n, size, rate, s, slope) for n, s in ((311, 1.0), (173, 1.7))]
        found = find_hopping(series, times(series), [slope / STEP_S] * 2, 0.8 * size, 0.4 * rate)
        np.testing.assert_allclose(found.noise, (1.0, 1.7), rtol=0.25)
        ramp = (found.ramp - slope / STEP_S) / found.ramp_error
        pulls.append(
            ((found.size - size) / found.error, (found.rate - rate) / found.rate_error, ramp)
        )
        rates.append(found.rate)
    pull = np.array(pulls)
    assert np.all(np.abs(pull.mean(axis=0)) < 4 * 1.1 / np.sqrt(60))
    assert np.all(pull.std(axis=0) < 1.35)
    assert np.mean(rates) == pytest.approx(rate, rel=0.1)


def test_of_strong_hops_the_error_of_the_rate_is_that_of_their_number() -> None:
    rate = 0.3
    series = [hopping(np.random.default_rng(n), 901, 100.0, rate, 1.0) for n in range(3)]
    found = find_hopping(series, times(series), [0.0] * 3, 90.0, 0.1)
    number = sum(np.count_nonzero(np.abs(np.diff(s)) > 50) for s in series)
    seconds = 3 * 900 * STEP_S
    # Two hops within a step are none: the chance of a change is (1 - exp(-2 rate step)) / 2.
    share = number * STEP_S / seconds
    assert found.rate == pytest.approx(-np.log(1 - 2 * share) / (2 * STEP_S), rel=1e-3)
    assert found.rate_error == pytest.approx(found.rate / np.sqrt(number), rel=0.1)


def test_the_unit_and_the_side_do_not_matter() -> None:
    series = hopping(np.random.default_rng(5), 397, 5.0, 0.3, 1.0)
    one = find_hopping([series], times([series]), [0.0], 5.0, 0.3)
    for factor in (1e-6, -1e-6):
        other = find_hopping([factor * series], times([series]), [0.0], 5e-6, 0.3)
        assert other.size == pytest.approx(1e-6 * one.size, rel=0.02)
        assert other.rate == pytest.approx(one.rate, rel=0.02)


def test_nothing_and_no_noise_are_finite() -> None:
    steady = np.zeros(43)
    for series in (steady, np.arange(43.0), (np.arange(43) // 20 % 2).astype(float)):
        found = find_hopping([series], times([series]), [0.0], 1.0, 0.2)
        assert np.isfinite([found.size, found.error, found.rate, found.rate_error]).all()
    assert found.size == pytest.approx(1.0, rel=1e-3)
    assert found.rate * 43 * STEP_S == pytest.approx(2, rel=0.1)


def test_scatter_from_frame_to_frame_is_the_noise_beneath_hops() -> None:
    series = hopping(np.random.default_rng(6), 3001, 50.0, 0.2, 2.0)
    assert scatter_of(series) == pytest.approx(2.0, rel=0.1)
    assert scatter_of(np.zeros(9)) > 0
