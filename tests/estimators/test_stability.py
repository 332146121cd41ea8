"""Level, slope and knee are honest: Monte Carlo against known noise."""

from collections.abc import Callable, Iterator
from itertools import count, islice
from typing import Any

import allantools
import numpy as np
import pytest
from allantools import ci
from numpy.typing import NDArray

from pixcal.estimators.frame_series.stability import (
    ONE_SIGMA,
    AllanCurve,
    White,
    fit_curve,
    shared_noise,
    white_population,
)
from pixcal.kernels.allan import allan_deviation, averaging_lengths, disjoint_differences

F64 = NDArray[np.float64]
Drift = Callable[[np.random.Generator, int, int], F64]
RUNS = 200


def no_drift(_rng: np.random.Generator, n: int, pixels: int) -> F64:
    return np.zeros((n, pixels))


def random_walk(rng: np.random.Generator, n: int, pixels: int) -> F64:
    """Of each pixel; its Allan variance is q (2 m² + 1) / (6 m) with q the variance of a step."""
    return 0.1 * rng.normal(size=(n, pixels)).cumsum(axis=0)


def shared_drift(_rng: np.random.Generator, n: int, pixels: int) -> F64:
    """The same in all pixels; its Allan variance is (0.05 m)² / 2."""
    return 0.05 * np.arange(n)[:, None] * np.ones(pixels)


def curves(
    n: int,
    pixels: int,
    drift: Drift = no_drift,
    *,
    noise: F64 | None = None,
    gap: slice = slice(0, 0),
) -> Iterator[AllanCurve]:
    """Curves of runs of white noise plus a drift, run after run."""
    present = np.ones(n, bool)
    present[gap] = False
    lengths = fitting_lengths(present)
    noise = np.ones(pixels) if noise is None else noise
    levels = np.quantile(noise, (np.arange(64) + 0.5) / 64)
    white = white_population(present, lengths, levels if pixels > 1 else None)
    for seed in count():
        rng = np.random.default_rng([7, seed])
        series = noise * rng.normal(size=(n, pixels)) + drift(rng, n, pixels)
        series[~present] = np.nan
        yield measure(series, noise, lengths, white)


def fitting_lengths(present: NDArray[np.bool_]) -> tuple[int, ...]:
    """Those for which two neighbouring means fit between the gaps."""
    series = np.where(present, 1.0, np.nan)[:, None]
    lengths = averaging_lengths(len(present))
    found = allan_deviation(series, lengths)[:, 0]
    return tuple(m for m, value in zip(lengths, found, strict=True) if np.isfinite(value))


def measure(series: F64, noise: F64, lengths: tuple[int, ...], white: White) -> AllanCurve:
    low, median, high = np.quantile(
        allan_deviation(series, lengths), (ONE_SIGMA[0], 0.5, ONE_SIGMA[1]), axis=1
    )
    steps = [np.nan_to_num(disjoint_differences(series / noise, m, 32)) for m in lengths]
    pixels = series.shape[1]
    shared = shared_noise([s @ s.T for s in steps], pixels)
    return fit_curve(lengths, median, np.log(high / low) / 2, pixels, shared, white)


WHITE_CASES: dict[str, tuple[int, int, dict[str, Any]]] = {
    "window": (60, 300, {}),
    "few batches": (9, 250, {}),
    "few pixels": (24, 30, {}),
    "gap": (41, 200, {"gap": slice(15, 22)}),
    "uneven noise": (30, 300, {"noise": np.exp(0.5 * np.random.default_rng(1).normal(size=300))}),
}


@pytest.mark.long
@pytest.mark.parametrize("name", WHITE_CASES)
def test_white_noise_is_found_white(name: str) -> None:
    n, pixels, options = WHITE_CASES[name]
    present = np.ones(n, bool)
    present[options.get("gap", slice(0, 0))] = False
    lengths = np.array(fitting_lengths(present))
    found = list(islice(curves(n, pixels, **options), RUNS))
    truth = np.median(options.get("noise", np.ones(1))) / np.sqrt(lengths)

    pulls = np.array([np.log(c.adev / truth) / (c.error / c.adev) for c in found])
    assert np.abs(pulls.mean(axis=0)).max() < 0.3, "no bias beyond that of the truth's quantiles"
    assert pulls.std(axis=0) == pytest.approx(np.ones(len(lengths)), abs=0.17)
    inside = np.mean([(c.low < truth) & (truth < c.high) for c in found], axis=0)
    assert np.all((inside > 0.58) & (inside < 0.8))

    slopes = np.array([(c.slope, c.slope_error) for c in found])
    within = np.abs(slopes[:, 0] + 0.5) < slopes[:, 1]
    assert 0.683 - 3 * 0.033 < within.mean() < 0.683 + 3 * 0.033
    assert abs(np.mean((slopes[:, 0] + 0.5) / slopes[:, 1])) < 0.25
    assert sum(c.knee is not None for c in found) <= 0.02 * RUNS


@pytest.mark.quick(1)
@pytest.mark.parametrize("n", [24, 101])
def test_a_single_pixel(n: int) -> None:
    lengths = np.array(averaging_lengths(n))
    found = list(islice(curves(n, 1), RUNS))
    series = np.random.default_rng([7, 0]).normal(size=(n, 1))[:, 0]
    _, plain, _, _ = allantools.oadev(series, data_type="freq", taus=lengths.astype(float))
    assert found[0].adev == pytest.approx(plain, rel=1e-12)

    truth = 1 / np.sqrt(lengths)
    inside = np.mean([(c.low < truth) & (truth < c.high) for c in found], axis=0)
    assert inside == pytest.approx(np.full(len(lengths), 0.683), abs=0.1)
    slopes = np.array([(c.slope, c.slope_error) for c in found if c.slope is not None])
    within = np.abs(slopes[:, 0] + 0.5) < slopes[:, 1]
    assert within.sum() / RUNS == pytest.approx(0.683, abs=0.1)
    assert sum(c.knee is not None for c in found) <= 0.02 * RUNS


def test_limits_of_a_pixel_agree_with_chi_square() -> None:
    """With many batches the simulated limits are those of NIST SP 1065, equation 45, table 5."""
    lengths = (1, 2, 3, 4, 6)
    limits = white_population(np.ones(120, bool), lengths).limits
    for m, low, high in zip(lengths, *limits, strict=True):
        inverse = ci.confidence_interval(1.0, ci.edf_simple(121, m, 0))
        assert (1 / high, 1 / low) == pytest.approx(inverse, rel=0.01)


@pytest.mark.parametrize(
    ("drift", "knee", "most"),
    [(random_walk, np.sqrt(3 / 0.01), 1.5), (shared_drift, np.cbrt(2 / 0.05**2), 1.5)],
)
def test_a_strong_drift_is_found_where_it_is(drift: Drift, knee: float, most: float) -> None:
    found = list(islice(curves(60, 400, drift), 20))
    for curve in found:
        assert curve.knee is not None
        assert knee / most < curve.knee < knee * most
    slopes = np.array([(c.slope, c.slope_error) for c in found])
    assert np.mean(np.abs(slopes[:, 0] + 0.5) < 2 * slopes[:, 1]) > 0.8, "of the white part only"


def test_a_floor_is_found_where_it_is() -> None:
    def floor(rng: np.random.Generator, n: int, pixels: int) -> F64:
        """Flicker: one random walk that forgets for each octave of times."""
        out = np.zeros((n, pixels))
        for time in 2.0 ** np.arange(-1, 9):
            keep = np.exp(-1 / time)
            state = rng.normal(size=pixels)
            for k in range(n):
                state = keep * state + np.sqrt(1 - keep**2) * rng.normal(size=pixels)
                out[k] += 0.25 * state
        return out

    lengths = averaging_lengths(96)
    flicker = floor(np.random.default_rng(2), 96, 4000)
    level = np.sqrt(np.mean(allan_deviation(flicker, lengths) ** 2, axis=1))
    assert level[3:] == pytest.approx(np.full(len(level) - 3, level[3:].mean()), rel=0.1), "flat"
    expected = 1 / level[3:].mean() ** 2
    for curve in islice(curves(96, 500, floor), 5):
        assert curve.knee == pytest.approx(expected, rel=0.5)


def test_noise_that_pixels_share_widens_the_error() -> None:
    """Half of the variance is one pattern that comes and goes: few pixels' worth of knowledge."""
    n, pixels = 60, 400

    def pattern(rng: np.random.Generator, n: int, pixels: int) -> F64:
        return np.outer(rng.normal(size=n), np.where(np.arange(pixels) % 2, 1, -1))

    found = list(islice(curves(n, pixels, pattern), RUNS))
    logs = np.log([c.adev for c in found])
    claimed = np.mean([c.error / c.adev for c in found], axis=0)
    ratio = logs.std(axis=0) / claimed
    assert np.all((ratio > 0.6) & (ratio < 1.3))
    alone = list(islice(curves(n, pixels), 10))
    assert np.all(claimed > 4 * np.mean([c.error / c.adev for c in alone], axis=0))
    assert sum(c.knee is not None for c in found) <= 0.02 * RUNS, "white all the same"


def test_shared_noise_counts_independent_pixels() -> None:
    rng = np.random.default_rng(0)
    steps = rng.normal(size=(16, 50))
    same = np.repeat(steps, 8, axis=1)
    (share,) = shared_noise([same @ same.T], 400)
    assert 1 / share == pytest.approx(50, rel=0.4)
    one = np.outer(rng.normal(size=16), np.ones(400))
    assert shared_noise([one @ one.T], 400) == pytest.approx([1.0])
    lone = rng.normal(size=(16, 400))
    assert shared_noise([lone @ lone.T], 400) == pytest.approx([1 / 400])
    gap = np.zeros((3, 400))
    assert shared_noise([one @ one.T, gap @ gap.T], 400) == pytest.approx([1.0, 1.0])


def test_the_yardstick_is_the_same_every_time() -> None:
    present, lengths = np.ones(17, bool), (1, 2, 4)
    first = white_population(present, lengths, np.ones(64))
    white_population.__globals__["_draws"].cache_clear()
    again = white_population(present, lengths, np.ones(64))
    np.testing.assert_array_equal(first.bias, again.bias)
    np.testing.assert_array_equal(first.covariance, again.covariance)


def test_too_few_lengths_give_no_slope() -> None:
    (curve,) = islice(curves(4, 50), 1)
    assert len(curve.adev) == 1
    assert (curve.slope, curve.slope_error, curve.knee) == (None, None, None)
