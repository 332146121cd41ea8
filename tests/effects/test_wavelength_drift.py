"""Wavelength drift: vectors shrink and grow along themselves, each set by its own."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pixcal.effects.wavelength_drift import WavelengthDrift
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.scene import detector_maps, fringe_light
from pixcal.model.bench import Bench
from pixcal.simulation.exposure import states_of
from pixcal.simulation.recording import recordings

Benches = Callable[..., Bench]
Acquired = Callable[..., Evidence]
STILL = {"ramp": [0, 0], "settle": [0, 0], "walk": [0, 0]}


def drift(**parameters: float) -> dict[str, Any]:
    return {"wavelength_drift": {"ramp": 0.0, "walk": 0.0, "hop": 0.0} | parameters}


def test_a_frame_is_as_a_bench_of_the_new_wavelength_makes_it(make_effect_bench: Benches) -> None:
    bench = make_effect_bench({"optics.offset_mm": [3.0, -2.0], "frames.fringes.0.count": 2})
    recording = next(r for r in recordings(bench) if r.kind == "fringes")
    epsilon = 1e-3
    effect = WavelengthDrift(ramp=epsilon * 3600 / 0.14, walk=0.0, hop=0.0)
    states, plain = states_of(recording, (effect,)), states_of(recording, ())
    rows = (0, bench.detector.shape[0])
    maps = detector_maps(bench.detector, rows)
    other = replace(bench, optics=replace(bench.optics, wavelength_nm=632.8 * (1 + epsilon)))
    phase = []
    for scene in (bench, other):
        phase.append(fringe_light(scene, 0, rows, maps, 1.0).phasor)
    change = np.angle(phase[1] / phase[0])
    y, x = np.mgrid[: rows[1], : bench.detector.shape[1]]
    turned = (
        states.phi[1]
        - plain.phi[1]
        + states.dkx[1] * (x - (bench.detector.shape[1] - 1) / 2)
        + states.dky[1] * (y - (rows[1] - 1) / 2)
    )
    np.testing.assert_allclose(np.angle(np.exp(1j * (turned - change))), 0.0, atol=2e-5)


def test_ramp_walk_and_hops_do_what_they_say(make_effect_bench: Benches) -> None:
    bench = make_effect_bench({"frames.fringes.0.count": 20_000})
    frames = next(r for r in recordings(bench) if r.kind == "fringes")

    def colour(**parameters: float) -> np.ndarray:
        effect = WavelengthDrift(**({"ramp": 0.0, "walk": 0.0, "hop": 0.0} | parameters))
        states = states_of(frames, (effect,))
        np.testing.assert_array_equal(states.dky, 0.0)
        return -states.dkx / 1.25606

    time = np.arange(frames.count) * 0.14 / 3600
    np.testing.assert_allclose(colour(ramp=1e-6), 1e-6 * time, rtol=1e-4)
    steps = np.diff(colour(walk=2e-6)) * np.sqrt(3600 / 0.14)
    assert steps.std() == pytest.approx(2e-6, rel=0.02)
    hopping = colour(hop=1e-6, hops_per_h=600.0)
    assert {round(v, 2) for v in np.unique(hopping / 1e-6)} == {0.0, 1.0}
    number, expected = np.count_nonzero(np.diff(hopping)), 600 * time[-1]
    assert abs(number - expected) < 4 * np.sqrt(expected)


@pytest.mark.long
@pytest.mark.parametrize("ramp", [2e-3, 1e-2])
def test_a_ramp_is_found(acquired: Acquired, ramp: float) -> None:
    found = WavelengthDrift.estimate(acquired(None, drift(ramp=ramp)))
    assert found is not None
    assert isinstance(found.effect, WavelengthDrift)
    assert abs(found.effect.ramp - ramp) < 4 * found.errors["ramp"] < 1e-3
    assert found.significance > 5
    assert found.effect.hop == 0


def test_a_walk_is_found(acquired: Acquired) -> None:
    found = WavelengthDrift.estimate(acquired(None, drift(walk=3e-4)))
    assert found is not None
    assert isinstance(found.effect, WavelengthDrift)
    assert abs(found.effect.walk - 3e-4) < 4 * found.errors["walk"] < 3e-4
    assert found.significance > 5


@pytest.mark.parametrize("ramp", [2e-3, 1e-2])
def test_the_size_is_that_of_the_change_within_a_set(acquired: Acquired, ramp: float) -> None:
    evidence = acquired(None, drift(ramp=ramp))
    size = WavelengthDrift.estimate(evidence).size
    seconds = np.concatenate([f.time_s - f.time_s.mean() for f in evidence.fringes.values()])
    expected = ramp * seconds.std() / 3600
    assert abs(size["value"] - expected) < 4 * size["error"] < 0.3 * expected


@pytest.mark.long
@pytest.mark.parametrize(("hop", "rate"), [(3e-4, 250.0), (3e-5, 400.0), (6e-5, 250.0)])
def test_hops_are_found(acquired: Acquired, hop: float, rate: float) -> None:
    found = WavelengthDrift.estimate(acquired(None, drift(hop=hop, hops_per_h=rate)))
    assert found is not None
    assert isinstance(found.effect, WavelengthDrift)
    assert abs(found.effect.hop - hop) < 4 * found.errors["hop"] < 0.1 * hop
    assert abs(found.effect.hops_per_h - rate) < 4 * found.errors["hops_per_h"] < 3 * rate
    assert found.significance > 6


@pytest.mark.long
def test_beside_a_walk_the_error_of_hops_is_honest(acquired: Acquired) -> None:
    hop, rate, walk = 3e-4, 250.0, 3e-3
    found = WavelengthDrift.estimate(acquired(None, drift(hop=hop, hops_per_h=rate, walk=walk)))
    assert found is not None
    assert isinstance(found.effect, WavelengthDrift)
    assert abs(found.effect.walk - walk) < 4 * found.errors["walk"] < 3 * walk
    assert abs(found.effect.hop - hop) < 4 * found.errors["hop"] < 0.5 * hop
    assert abs(found.effect.hops_per_h - rate) < 4 * found.errors["hops_per_h"] < 3 * rate


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "alike",
    [
        {"fringe_drift": STILL | {"ramp": [1e-2, -5e-3]}},
        {"fringe_drift": STILL | {"walk": [3e-4, 2e-4]}},
        {"fringe_drift": STILL | {"settle": [1e-4, 0.0], "settle_s": 5.0}},
        {"fringe_jitter": {"rms": [2.5e-5, 2.5e-5]}},
    ],
)
def test_what_looks_like_it_is_not_taken_for_it(acquired: Acquired, alike: dict[str, Any]) -> None:
    found = WavelengthDrift.estimate(acquired(None, alike))
    assert found is not None
    assert found.significance < 4


def of_one_set(name: str, axis: str, end: float) -> dict[str, Any]:
    """Fringe vectors of one set that move evenly along an axis, to an end (rad/px)."""
    course = {"set": name, "time_s": [0.0, 41.86], "value": [0.0, end]}
    return {"fringe_drift": STILL | {f"along_{axis}": [course]}}


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("effects", "refused"),
    [
        # The other set moved by as much along the same axis is a motion of the fibres.
        (of_one_set("vertical", "x", 1e-4), True),
        (drift(ramp=1e-2) | {"fringe_drift": STILL | {"ramp": [1e-2, -5e-3]}}, False),
        (of_one_set("horizontal", "y", -1e-4), True),
        (drift(ramp=1e-2), False),
    ],
)
def test_sets_that_move_each_by_itself_are_no_change_of_the_wavelength(
    acquired: Acquired, effects: dict[str, Any], refused: bool
) -> None:
    found = WavelengthDrift.estimate(acquired(None, effects))
    assert found is not None
    assert ("disagree" in found.refused) == refused


@pytest.mark.long
def test_with_one_direction_of_fringes_what_exceeds_the_motion_across_counts(
    acquired: Acquired,
) -> None:
    one = [{"name": "only", "baseline_mm": [11.5, 0.0], "count": 300, "peak_e": 45000}]
    found = WavelengthDrift.estimate(acquired({"frames.fringes": one}, drift(ramp=1e-2)))
    assert found is not None
    assert isinstance(found.effect, WavelengthDrift)
    assert abs(found.effect.ramp - 1e-2) < 4 * found.errors["ramp"]
    assert found.significance > 5
    assert "fibres" in found.why
    across = WavelengthDrift.estimate(
        acquired({"frames.fringes": one}, {"fringe_drift": STILL | {"ramp": [0.0, 1e-2]}})
    )
    assert across is not None
    assert across.significance < 4
