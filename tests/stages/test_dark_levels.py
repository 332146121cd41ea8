"""Frames without light whose level departs from that of the others are named."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_ends_of_the_converter import Frames

from pixcal.model.arrays import F64
from pixcal.stages.reduce.dark_levels import level_warnings
from pixcal.stages.reduce.exposures import Group

NOISE, GAIN = 5.0, 2.0  # ADU, e-/ADU


def warned(times: F64 | None = None, **levels: Any) -> list[str]:
    """Warnings on frames of given levels, ADU; ``times``: of the darks, s."""
    times = np.full(len(levels["dark"]), 60.0) if times is None else times
    rng = np.random.default_rng(4)
    frames = {
        k: np.rint(rng.normal(300, NOISE, (len(v), 40, 60)) + frames_of(v))
        for k, v in levels.items()
    }
    frames["dark"][:, 3, :9] += 4000
    source: Any = SimpleNamespace(
        arrays={name: Frames(samples) for name, samples in frames.items()},
        exposures=SimpleNamespace(
            dark=[
                Group("bias", 0.0, tuple(range(len(levels["bias"])))),
                *(Group("dark", t, tuple(np.flatnonzero(times == t))) for t in np.unique(times)),
            ]
        ),
        quantum=1.0,
        names=lambda array, numbers: [f"{array}{n}" for n in numbers],
    )
    return level_warnings(source, GAIN, GAIN * NOISE)


def number_in(sentence: str, after: str) -> float:
    return float(sentence.split(after)[1].split()[0].replace("−", "-"))


def frames_of(levels: NDArray[Any]) -> F64:
    return np.asarray(levels, float)[:, None, None]


@pytest.mark.parametrize("wander", [0.0, 1.0, 20.0])
def test_levels_that_wander_are_not_named(wander: float) -> None:
    rng = np.random.default_rng(3)
    assert warned(bias=wander * rng.standard_normal(12), dark=wander * rng.standard_normal(5)) == []


@pytest.mark.parametrize(("off", "named"), [([2], "dark2"), ([3, 4], "dark3, dark4")])
def test_a_jump_and_a_step_are_named_with_their_size(off: list[int], named: str) -> None:
    levels = np.zeros(5)
    levels[off] = -12
    (sentence,) = warned(bias=np.zeros(12), dark=levels)
    assert named + " differs" in sentence
    size = number_in(sentence, "by ")
    assert size == pytest.approx(-12 * GAIN, abs=1.0)


@pytest.mark.parametrize("off", [0.0, 15.0])
def test_bias_frames_that_are_not_those_of_the_darks_are_named(off: float) -> None:
    times = np.repeat([30.0, 60.0], 5)
    sentences = warned(times, bias=np.zeros(12), dark=off + 0.3 * times)
    assert len(sentences) == (off > 0)
    for sentence in sentences:
        size = number_in(sentence, "level ")
        assert size == pytest.approx(off * GAIN, abs=1.5)
