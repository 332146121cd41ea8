"""Fringe jitter: its size is the one given, whatever the window, and is told from drifts."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.fringe_jitter import FringeJitter
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.exposure import states_of
from pixcal.simulation.recording import recordings

Benches = Callable[..., Bench]
Acquired = Callable[..., Evidence]
OFF: dict[str, Any] = {"ramp": [0, 0], "settle": [0, 0], "walk": [0, 0]}


def test_the_vector_has_the_size_given_and_no_memory_whatever_the_window(
    make_effect_bench: Benches,
) -> None:
    counts = {"frames.fringes.0.count": 20_000}
    large = make_effect_bench({"detector.shape": [31, 200], **counts})
    small = make_effect_bench({"detector.shape": [40, 50], **counts})
    found = []
    for bench in (large, small):
        frames = next(r for r in recordings(bench) if r.kind == "fringes")
        plain, moved = states_of(frames, ()), states_of(frames, (FringeJitter((3e-5, 1e-5)),))
        np.testing.assert_array_equal(moved.phi, plain.phi)
        found.append(np.stack([moved.dkx, moved.dky]))
    np.testing.assert_array_equal(found[0], found[1])
    assert found[0].std(axis=1) == pytest.approx([3e-5, 1e-5], rel=0.03)
    assert abs(np.corrcoef(found[0])[0, 1]) < 0.03
    assert abs(np.corrcoef(found[0][0, 1:], found[0][0, :-1])[0, 1]) < 0.03


def test_a_vibration_is_the_mean_over_the_exposure(make_effect_bench: Benches) -> None:
    bench = make_effect_bench({"frames.fringes.0.count": 20_000})
    frames = next(r for r in recordings(bench) if r.kind == "fringes")
    states = states_of(frames, (FringeJitter((0.0, 0.0), (1e-5, 2e-5), 11.0),))
    swung = np.array([states.dkx, states.dky])
    assert swung.std(axis=1) * np.sqrt(2) == pytest.approx(
        np.array([1e-5, 2e-5]) * np.sinc(11.0 * 0.02), rel=0.01
    )


def test_frames_turn_about_the_middle_of_the_window(make_effect_bench: Benches) -> None:
    bench = make_effect_bench(
        {
            "shot_noise": False,
            "detector.read_noise_e": 0.0,
            "detector.delta_rms_px": 0.0,
            "detector.hot_fraction": 0.0,
            "frames.fringes.0.count": 3,
        }
    )
    recording = next(r for r in recordings(bench) if r.kind == "fringes")
    jitter = FringeJitter((1e-3, 0.0))
    change = states_of(recording, (jitter,)).dkx
    difference = frames_of(bench, recording, [jitter]).astype(float) - frames_of(bench, recording)
    column = np.abs(difference).mean(axis=1)
    assert np.all(column[:, 33] < 0.6)
    # Where the fringes are steep, the light changes by the amplitude times the turn.
    edge = np.abs(difference[:, :, [0, 1, 2, 3, 4]]).max(axis=(1, 2))
    np.testing.assert_allclose(edge, 0.95 * 45_000 / 1.95 * np.abs(change) * 33, rtol=0.15)


@pytest.mark.long
@pytest.mark.parametrize("rms", [(6e-6, 4e-6), (2.5e-5, 2.5e-5), (3e-4, 1e-4)])
def test_its_size_is_found(acquired: Acquired, rms: tuple[float, float]) -> None:
    found = FringeJitter.estimate(acquired(None, {"fringe_jitter": {"rms": list(rms)}}))
    assert found is not None
    assert isinstance(found.effect, FringeJitter)
    for axis in range(2):
        error = found.errors[f"rms[{axis}]"]
        assert abs(found.effect.rms[axis] - rms[axis]) < 4 * error
        assert error < max(0.06 * rms[axis], 1.2e-6)
    assert found.significance > 4


@pytest.mark.long
@pytest.mark.parametrize(
    ("size", "hz", "folded"), [((6e-6, 8e-6), 1.7, 1.7), ((3e-5, 1e-5), 20.3, abs(20.3 - 3 / 0.14))]
)
def test_a_vibration_is_found_folded_below_half_the_frame_rate(
    acquired: Acquired, size: tuple[float, float], hz: float, folded: float
) -> None:
    on = {"rms": [0.0, 0.0], "vibration": list(size), "vibration_hz": hz}
    found = FringeJitter.estimate(acquired(None, {"fringe_jitter": on}))
    assert found is not None
    assert found.significance > 6
    assert isinstance(found.effect, FringeJitter)
    assert found.effect.vibration_hz == pytest.approx(folded, abs=4 * found.errors["vibration_hz"])
    smeared = np.array(size) * np.sinc(hz * 0.02) / np.sinc(folded * 0.02)
    for axis in range(2):
        error = found.errors[f"vibration[{axis}]"]
        assert abs(found.effect.vibration[axis] - smeared[axis]) < 4 * error
        assert abs(found.effect.rms[axis]) < 4 * found.errors[f"rms[{axis}]"]


@pytest.mark.long
@pytest.mark.parametrize(
    "alike",
    [
        {"fringe_drift": OFF | {"ramp": [1e-2, -5e-3]}},
        {"fringe_drift": OFF | {"walk": [3e-4, 2e-4]}},
        {"wavelength_drift": {"ramp": 0.0, "walk": 0.0, "hop": 3e-4, "hops_per_h": 250.0}},
        {"rolling_shutter": {}},
        {"lag": {"share": 0.01}},
    ],
)
def test_what_looks_like_it_is_not_taken_for_it(acquired: Acquired, alike: dict[str, Any]) -> None:
    found = FringeJitter.estimate(acquired(None, alike))
    assert found is not None
    assert found.significance < 4


@pytest.mark.long
def test_it_is_found_beside_a_drift(acquired: Acquired) -> None:
    found = FringeJitter.estimate(
        acquired(
            None,
            {
                "fringe_jitter": {"rms": [2e-5, 2e-5]},
                "fringe_drift": OFF | {"walk": [3e-4, 1e-4], "ramp": [5e-3, 0]},
            },
        )
    )
    assert found is not None
    assert isinstance(found.effect, FringeJitter)
    for axis in range(2):
        assert abs(found.effect.rms[axis] - 2e-5) < 4 * found.errors[f"rms[{axis}]"] < 8e-6


def test_without_fringes_there_is_no_word(acquired: Acquired) -> None:
    assert FringeJitter.estimate(replace(acquired(), fringes={})) is None


def test_what_frames_did_is_replayed(acquired: Acquired) -> None:
    """The fast changes of the vectors, whatever their law; a drift beside them is left out."""
    on = {"rms": [2e-5, 0.0], "vibration": [0.0, 3e-5], "vibration_hz": 1.1}
    drift = {"ramp": [0.02, 0.02], "settle": [0, 0], "walk": [0, 0]}
    again = FringeJitter().replayed(acquired(None, {"fringe_jitter": on, "fringe_drift": drift}))
    assert again is not None
    for track in again.along_x:
        time = np.array(track.time_s)
        slope = np.polyfit(time / 3600, track.value, 1)[0]
        assert abs(slope) < 0.2 * 0.02
        assert np.std(track.value) == pytest.approx(2e-5, rel=0.15)
    for track in again.along_y:
        assert np.std(track.value) == pytest.approx(3e-5 / np.sqrt(2), rel=0.15)
    assert again.scaled(0.0).is_null
