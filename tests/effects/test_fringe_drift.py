"""Fringe drift: ramps, settlings and walks, told apart and from their like."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pixcal.effects.fringe_drift import FringeDrift
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.exposure import states_of
from pixcal.simulation.recording import recordings

Benches = Callable[..., Bench]
Acquired = Callable[..., Evidence]
OFF: dict[str, Any] = {"ramp": [0, 0], "settle": [0, 0], "walk": [0, 0]}
NONE = FringeDrift().scaled(0.0)


def changes(bench: Bench, **parameters: object) -> tuple[np.ndarray, np.ndarray]:
    """Time (s) and change of the vector (t, 2) of the first fringe set."""
    frames = next(r for r in recordings(bench) if r.kind == "fringes")
    states = states_of(frames, (FringeDrift(**(OFF_FIELDS | parameters)),))  # type: ignore[arg-type]
    return np.arange(frames.count) * frames.period_s, np.stack([states.dkx, states.dky], axis=1)


OFF_FIELDS = dict.fromkeys(OFF, (0.0, 0.0))


def test_each_part_does_what_it_says(make_effect_bench: Benches) -> None:
    bench = make_effect_bench({"frames.fringes.0.count": 20_000})
    time, ramp = changes(bench, ramp=(2e-5, -1e-5))
    np.testing.assert_allclose(ramp, np.outer(time / 3600, [2e-5, -1e-5]), atol=1e-18)
    _, settled = changes(bench, settle=(3e-5, 1e-5), settle_s=100.0)
    assert settled[0] == pytest.approx([0.0, 0.0])
    assert settled[-1] == pytest.approx([-3e-5, -1e-5], rel=1e-6)
    at = int(np.argmin(np.abs(time - 100)))
    assert settled[at, 0] == pytest.approx(-3e-5 * (1 - np.exp(-time[at] / 100)))
    _, walk = changes(bench, walk=(1e-5, 3e-5))
    hourly = np.diff(walk, axis=0).std(axis=0) * np.sqrt(3600 / 0.14)
    assert hourly == pytest.approx([1e-5, 3e-5], rel=0.02)


def test_what_is_not_random_is_told_for_a_fit_that_holds_the_vector(
    make_effect_bench: Benches,
) -> None:
    bench = make_effect_bench()
    steady = {"ramp": (2e-5, -1e-5), "settle": (3e-5, 1e-5), "settle_s": 7.0}
    time, change = changes(bench, **steady)
    effect = FringeDrift(**(OFF_FIELDS | steady))  # type: ignore[arg-type]
    np.testing.assert_allclose(effect.vector_change(time), change, atol=1e-18)


@pytest.mark.long
@pytest.mark.parametrize(
    "parameters",
    [
        {"ramp": [1e-3, -5e-4]},
        {"ramp": [1e-2, -5e-3]},
        {"walk": [3e-4, 2e-4]},
        {"settle": [1e-4, 0.0], "settle_s": 5.0},
    ],
)
def test_its_parameters_are_found(acquired: Acquired, parameters: dict[str, Any]) -> None:
    evidence = acquired(None, {"fringe_drift": OFF | parameters})
    found = FringeDrift.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, FringeDrift)
    assert found.significance > 6
    assert FringeDrift.detect(evidence) == pytest.approx(found.significance, rel=0.01)
    for name, truth in (OFF | parameters).items():
        for axis, value in enumerate(truth if isinstance(truth, list) else [truth]):
            key = f"{name}[{axis}]" if isinstance(truth, list) else name
            if key not in found.errors:
                assert value == 0
                continue
            got = getattr(found.effect, name)
            got = got[axis] if isinstance(truth, list) else got
            assert abs(got - value) < 4 * found.errors[key]
    # No part is named that is not there.
    assert (found.effect.settle != (0.0, 0.0)) == ("settle" in parameters)


@pytest.mark.long
def test_errors_mean_something(acquired: Acquired) -> None:
    found = FringeDrift.estimate(acquired(None, {"fringe_drift": OFF | {"ramp": [1e-2, -5e-3]}}))
    assert found is not None
    # 0.7e-5 rad/px a frame, 300 frames in 42 s: 0.3e-5 rad/px from end to end of two sets.
    assert 5e-5 < found.errors["ramp[0]"] < 3e-4


@pytest.mark.long
@pytest.mark.parametrize(
    "alike",
    [
        {"fringe_jitter": {"rms": [2.5e-5, 2.5e-5]}},
        {"fringe_jitter": {"rms": [0.0, 0.0], "vibration": [3e-5, 1e-5]}},
        {"wavelength_drift": {"ramp": 1e-2, "walk": 0.0, "hop": 0.0}},
        {"wavelength_drift": {"ramp": 0.0, "walk": 3e-4, "hop": 0.0}},
        {"wavelength_drift": {"ramp": 0.0, "walk": 0.0, "hop": 3e-4, "hops_per_h": 250.0}},
        {"bias_drift": {}},
    ],
)
def test_what_looks_like_it_is_not_taken_for_it(acquired: Acquired, alike: dict[str, Any]) -> None:
    found = FringeDrift.estimate(acquired(None, alike))
    assert found is not None
    assert found.significance < 4


def test_with_one_direction_of_fringes_it_says_what_it_cannot_tell(acquired: Acquired) -> None:
    one = [{"name": "only", "baseline_mm": [11.5, 0.0], "count": 300, "peak_e": 45000}]
    found = FringeDrift.estimate(
        acquired({"frames.fringes": one}, {"fringe_drift": OFF | {"ramp": [3e-3, 0.0]}})
    )
    assert found is not None
    assert isinstance(found.effect, FringeDrift)
    assert abs(found.effect.ramp[0] - 3e-3) < 4 * found.errors["ramp[0]"]
    assert found.significance > 6
    assert "wavelength" in found.why


def test_what_frames_did_is_replayed(acquired: Callable[..., Evidence]) -> None:
    """The slow vectors of the frames, whatever their law; what is white is left out."""
    on = {"ramp": [0.02, 0.0], "settle": [0.0, 0.0], "walk": [0.0, 0.0]}
    evidence = acquired(None, {"fringe_drift": on})
    again = FringeDrift().replayed(evidence)
    assert again is not None
    assert {t.set for t in again.along_x} == set(evidence.fringes)
    for track in again.along_x:
        time, value = np.array(track.time_s), np.array(track.value)
        slope = np.polyfit(time / 3600, value, 1)[0]
        assert slope == pytest.approx(0.02, rel=0.15)
    for track in again.along_y:
        assert np.ptp(track.value) < 0.2 * np.ptp(again.along_x[0].value)
    assert not again.is_null
    assert again.scaled(0.0).is_null
