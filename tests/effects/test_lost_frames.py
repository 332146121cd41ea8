"""Frames that the camera lost: those after them keep their times, and what was measured of each."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pixcal.effects.contrast_noise import ContrastNoise
from pixcal.effects.fringe_jitter import FringeJitter
from pixcal.effects.intensity_noise import IntensityNoise
from pixcal.kernels.scene import FrameStates
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import Recording, recordings
from pixcal.simulation.track import Track
from pixcal.stages.diagnose.description import recordings_of

TIMES = np.delete(np.arange(13) * 0.14, [3, 7])


def recorded(times: F64) -> Recording:
    table = {"time_s": times, "exptime_s": [0.02] * len(times), "mjd": 60000 + times / 86400}
    acquisition: Any = SimpleNamespace(frames=SimpleNamespace(fringes=[SimpleNamespace(name="a")]))
    bench: Any = None
    ((found,), _, _) = recordings_of(bench, acquisition, {"fringes/a": table}, [], [])
    return found


def test_frames_after_a_lost_one_are_as_late_as_they_were() -> None:
    np.testing.assert_allclose(recorded(TIMES).times_s, TIMES)
    assert recorded(TIMES).period_s == pytest.approx(0.14)
    even = recorded(np.arange(11) * 0.14)
    assert not even.stamps_s
    np.testing.assert_allclose(even.times_s, np.arange(11) * 0.14)
    unknown = recorded(np.where(np.arange(11) == 5, np.nan, np.arange(11) * 0.14))
    assert not unknown.stamps_s


@pytest.mark.parametrize(
    ("name", "replayed"),
    [
        ("amplitude", lambda track: ContrastNoise(0.0, 0.0, tracks=(track,))),
        ("level", lambda track: replace(IntensityNoise().scaled(0.0), tracks=(track,))),
        ("dkx", lambda track: FringeJitter((0.0, 0.0), (0.0, 0.0), along_x=(track,))),
    ],
)
def test_what_frames_did_is_replayed_in_the_same_frames(
    make_effect_bench: Callable[..., Bench], name: str, replayed: Callable[[Track], Effect]
) -> None:
    bench = make_effect_bench()
    one = next(r for r in recordings(bench) if r.kind == "fringes")
    own = replace(one, count=len(TIMES), stamps_s=tuple(TIMES))
    changes = np.random.default_rng(1).uniform(-0.01, 0.01, len(TIMES))
    one_each, none = np.ones(len(TIMES)), np.zeros(len(TIMES))
    states = FrameStates(none, one_each, 0.5 * one_each, none, none)
    effect = replayed(Track.of(bench.frames.fringes[0].name, TIMES, changes))
    found = getattr(effect.states(states, own), name)
    before = getattr(states, name)
    np.testing.assert_allclose(found, before + changes if name == "dkx" else before * (1 + changes))
