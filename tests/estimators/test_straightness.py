"""Why levels of flats are off a line over exposure time: response, lamp, or rounded times."""

import tracemalloc
from collections.abc import Callable, Sequence
from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pixcal.estimators.detector.straightness import Level, Straightness, straightness
from pixcal.model.arrays import F64
from pixcal.stages.reduce.detector_warnings import _linearity_warnings

STAMPS = np.array([0.04, 0.08, 0.17, 0.33, 0.5, 0.71])
RATE, READ, SAMPLES, FRAMES = 6e4, 25.0, 200_000, 8


def straight(charge: F64) -> F64:
    return charge


def judged(
    stamps: Sequence[float] | F64,
    times: Sequence[float] | F64,
    *,
    lamp: Callable[[F64], F64] = np.ones_like,
    response: Callable[[F64], F64] = straight,
    order: Sequence[int] | None = None,
    frames: int = FRAMES,
    saturated: int = 0,
    read: float = READ,
    seed: int = 1,
) -> Straightness:
    """What is said of flats (one electron per ADU) of stamped and true exposure times (s).

    ``lamp``: light at the time of recording, one frame per second; ``order``: of the levels;
    ``saturated``: how many of the last levels are; ``read``: NaN without a noise curve.
    """
    rng = np.random.default_rng(seed)
    at = np.empty((len(times), frames))
    at[list(range(len(times)) if order is None else order)] = np.arange(at.size).reshape(at.shape)
    levels, points = [], []
    for t, stamp, seconds in zip(times, stamps, at, strict=True):
        charge = RATE * t * lamp(seconds)
        slope = (response(1.001 * charge) - response(0.999 * charge)) / (0.002 * charge)
        variance = float((slope**2 * charge).mean()) + READ
        light = response(charge) + np.sqrt(variance / SAMPLES) * rng.standard_normal(frames)
        error = variance * np.sqrt(2 / SAMPLES / frames)
        points.append((light.mean(), variance + error * rng.standard_normal(), error))
        usable = len(levels) < len(times) - saturated
        levels.append(Level(float(stamp), float(light.mean()), usable, light, seconds))
    found = straightness(levels, np.array(points), read)
    assert found is not None
    return found


def without_noise_curve(times: F64, frames: int, flicker: float, seed: int) -> Straightness:
    """What is said of flats in order, of a linear camera and a lamp that flickers (relative)."""
    rng = np.random.default_rng(seed)
    light = RATE * times[:, None] * (1 + flicker * rng.standard_normal((len(times), frames)))
    at = np.arange(float(light.size)).reshape(light.shape)
    rows = zip(times, light, at, strict=True)
    levels = [Level(float(t), float(own.mean()), True, own, seconds) for t, own, seconds in rows]
    found = straightness(levels, np.empty((0, 3)), np.nan)
    assert found is not None
    return found


@pytest.mark.parametrize("cut", [False, True], ids=["rounded", "cut off"])
def test_times_that_are_stamped_rounded_are_told_from_the_response(cut: bool) -> None:
    rounded = 0
    for seed in range(30):
        off = np.random.default_rng(seed).uniform(0, 1, len(STAMPS)) - (0 if cut else 0.5)
        found = judged(STAMPS, STAMPS + 0.01 * off, seed=seed)
        assert found.error is not None
        assert found.line.max_deviation > 0.005
        assert found.rounded in (0, 0.01)
        # Those that are not told scatter as a lamp does.
        assert found.rounded or found.scatter
        assert found.largest < 5 * found.error
        rounded += found.rounded > 0
    # Some are as like a lamp that scatters in proportion to the exposure.
    assert rounded > 15


def test_a_lamp_set_anew_for_each_level_is_not_taken_for_rounding() -> None:
    rounded = 0
    for seed in range(40):
        off = 1 + 0.01 * np.random.default_rng(seed).standard_normal(len(STAMPS))
        rounded += judged(STAMPS, STAMPS * off, seed=seed).rounded > 0
    assert rounded <= 4


def test_rounding_among_hundreds_of_levels_is_told_in_little_memory() -> None:
    stamps = np.arange(10, 310) * 0.01
    times = stamps + 0.01 * np.random.default_rng(0).uniform(-0.5, 0.5, 300)
    tracemalloc.start()
    found = judged(stamps, times, frames=2)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.rounded == 0.01
    assert peak < 3e7


RESPONSES = {
    "curved": lambda e: e * (1 - 0.04 * e / 4e4),
    "knee": lambda e: e - 0.3 * np.maximum(e - 3e4, 0),
    "rises at low light": lambda e: e * (1 - 0.03 * np.exp(-e / 6e3)),
}


@pytest.mark.parametrize("name", RESPONSES)
@pytest.mark.parametrize("seed", range(3))
def test_a_response_is_no_error_of_coarse_stamps(name: str, seed: int) -> None:
    found = judged(STAMPS, STAMPS, response=RESPONSES[name], seed=seed)
    assert not found.rounded
    assert not found.scatter
    assert not found.drift
    assert found.largest == found.line.max_deviation > 0.002


@pytest.mark.parametrize("seed", range(3))
def test_levels_that_scatter_beside_their_noise_are_not_of_the_response(seed: int) -> None:
    fine = STAMPS + 1.234567e-3
    off = 1 + 0.02 * np.random.default_rng(seed).standard_normal(len(STAMPS))
    found = judged(fine, fine * off, seed=seed)
    assert not found.rounded
    assert found.error is not None
    if found.scatter:
        assert found.largest < 4 * found.error
        assert found.scatter == pytest.approx(0.02, rel=0.8)


LAMPS = {"warms up": lambda s: 1 - 0.03 * np.exp(-s / 20), "ages": lambda s: 1 - 0.04 * s / 48}


@pytest.mark.parametrize("name", LAMPS)
@pytest.mark.parametrize("response", [straight, RESPONSES["curved"]], ids=["straight", "curved"])
def test_a_lamp_that_drifts_within_levels_does_not_bend_them(
    name: str, response: Callable[[F64], F64]
) -> None:
    alone = judged(STAMPS, STAMPS, response=response)
    found = judged(STAMPS, STAMPS, response=response, lamp=LAMPS[name])
    assert found.error is not None
    assert alone.error is not None
    if found.drift:
        assert found.drift == pytest.approx(np.ptp(LAMPS[name](np.arange(48.0))), rel=0.1)
        # A curved response changes the drift that is seen, too: the error includes it.
        assert found.largest == pytest.approx(alone.largest, abs=2 * found.error)
        assert found.error < 1e-3
    else:
        # A lamp whose drift makes up for the curve in part: the error includes it.
        assert response is not straight
        assert abs(found.largest - alone.largest) < 2 * found.error


def test_the_drift_is_not_extrapolated_over_saturated_levels() -> None:
    stamps = np.arange(1, 11) * 0.05
    lamp = lambda s: 1 - 0.03 * np.exp(-s / 20)  # noqa: E731
    for seed in range(5):
        found = judged(stamps, stamps, lamp=lamp, frames=5, saturated=3, seed=seed)
        assert found.drift == pytest.approx(np.ptp(lamp(np.arange(35.0))), rel=0.1)


@pytest.mark.parametrize("ladder", [(3, 3), (4, 3), (5, 3), (3, 4), (3, 5), (5, 5)])
def test_a_lamp_that_flickers_in_a_few_flats_does_not_drift(ladder: tuple[int, int]) -> None:
    count, frames = ladder
    times = np.linspace(0.1, 1.0, count)
    for seed in range(100):
        assert not without_noise_curve(times, frames, 1e-3, seed).drift


def test_a_lamp_is_not_blamed_for_what_an_ordinary_ladder_shows() -> None:
    """Single flats leave the error open, and some ‰ are told well enough by the linearity."""
    for count in (5, 10):
        for seed in range(20):
            assert not without_noise_curve(np.linspace(0.1, 1.0, count), 1, 1e-3, seed).lamp
    response = lambda e: e * (1 + 0.006 * e / 4e4)  # noqa: E731
    found = judged(STAMPS, STAMPS, response=response, frames=10, read=np.nan)
    assert 2e-3 < found.largest < 3e-3
    assert not found.lamp


def test_a_lamp_that_starts_anew_at_each_level_is_not_taken_to_drift() -> None:
    found = judged(STAMPS, STAMPS, lamp=lambda s: 1 + 0.01 * (s % FRAMES) / FRAMES)
    assert not found.drift
    assert found.largest < 1e-3


def test_the_first_level_again_at_the_end_tells_a_drift() -> None:
    """Two flats of each level tell none: the first level again does, a straight one at least."""
    stamps = np.append(STAMPS, STAMPS[0])

    def straight_drift(seconds: F64) -> F64:
        return 1 + 0.03 * seconds / 14

    def drift(seconds: F64) -> F64:
        return 1 + 0.03 * (seconds / 12) ** 2

    assert judged(STAMPS, STAMPS, lamp=drift, frames=2).lamp
    for lamp, frames in ((straight_drift, 2), (drift, 4)):
        again = judged(stamps, stamps, lamp=lamp, frames=frames)
        assert again.error is not None
        assert again.drift > 0.02
        assert again.largest < 4 * again.error < 3e-3


def test_levels_out_of_order_are_not_bent_by_a_drift() -> None:
    response = lambda e: e * (1 + 0.015 * e / 4e4)  # noqa: E731
    order = (4, 0, 2, 5, 1, 3)
    assert judged(STAMPS, STAMPS, response=response, read=np.nan).lamp
    assert not judged(STAMPS, STAMPS, response=response, read=np.nan, order=order).lamp


def test_levels_of_one_exposure_time_and_a_drifting_lamp_lie_on_no_line() -> None:
    drifting = np.linspace(1.0, 1.002, 8)
    levels = [
        Level(2.0, mean, True, mean * drifting, np.arange(8.0)) for mean in (1e3, 2e3, 4e3, 8e3)
    ]
    assert straightness(levels, np.empty((0, 3)), np.nan) is None


@pytest.mark.parametrize("gap", [100, 1000, 10_000])
def test_a_lamp_that_is_set_anew_does_not_drift(gap: float) -> None:
    """Its drift would change the light by many powers of ten until the next exposure time."""
    rng, levels = np.random.default_rng(1), []
    for t, mean in product((0.05, 1.0), (3e3, 2e3, 1e3)):
        light = mean * (1 + 1e-3 * rng.standard_normal(4))
        at = gap * (t == 1) + (3e3 - mean) / 50
        levels.append(Level(t, float(light.mean()), True, light, at + np.arange(4.0)))
    assert straightness(levels, np.empty((0, 3)), np.nan) is None


@pytest.mark.parametrize(
    ("found", "said"),
    [
        ({"rounded": 0.01}, "of up to 2.6 %, are within half a step (0.005 s) of the exposure"),
        ({"scatter": 0.01}, "possible causes: rounded exposure times, a lamp reset for each"),
        ({"drift": 0.026}, "the light of the flats changes by up to 2.6 %, as the frames of each"),
    ],
)
def test_sentences_on_levels_off_their_line(found: dict[str, float], said: str) -> None:
    line: Any = SimpleNamespace(max_deviation=0.026)
    summary: Any = SimpleNamespace(
        linearity=Straightness(line, 0.026, 0.001, **found),  # type: ignore[arg-type]
        read_noise=None,
    )
    assert said in _linearity_warnings(summary)[0]
