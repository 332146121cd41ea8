"""Errors of the phase modulator: what recurs with every turn, from ramps and from bunches."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pixcal.effects.phase_modulator_error import PhaseModulatorError
from pixcal.estimators.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.exposure import states_of
from pixcal.simulation.recording import recordings

Benches = Callable[..., Bench]
Acquired = Callable[..., Evidence]
RAMPS = {
    "frames.fringes.0.phase_law": "ramp", "frames.fringes.0.phase_step_rad": 0.7,
    "frames.fringes.1.phase_law": "ramp", "frames.fringes.1.phase_step_rad": 2.1,
}  # fmt: skip


def test_a_span_that_misses_a_turn_is_first_of_twice_and_second_of_once_the_share() -> None:
    phase = np.linspace(-np.pi, np.pi, 1001)[:-1]
    share = 0.02
    # The drive's saw: e (phase - its middle), whose first two terms of the Fourier series.
    saw = -share * phase
    first = 2 * np.mean(saw * np.sin(phase + np.pi))
    second = 2 * np.mean(saw * np.sin(2 * (phase + np.pi)))
    assert first == pytest.approx(2 * share, rel=0.01)
    assert abs(second) == pytest.approx(share, rel=0.01)


def test_the_command_is_the_inverse() -> None:
    effect = PhaseModulatorError(0.4, 0.2)
    phase = np.linspace(-9, 9, 1001)
    np.testing.assert_allclose(effect.commanded(effect.actual(phase)), phase, atol=1e-10)
    assert np.all(np.diff(effect.actual(phase)) > 0)


def test_phases_bunch_as_bessel_functions_say(make_effect_bench: Benches) -> None:
    bench = make_effect_bench({"frames.fringes.0.count": 40_000})
    frames = next(r for r in recordings(bench) if r.kind == "fringes")
    phi = states_of(frames, (PhaseModulatorError(0.5, 0.0),)).phi
    # J1(0.5) and J2(1.0).
    assert np.exp(1j * phi).mean() == pytest.approx(-0.2423, abs=0.01)
    assert np.exp(2j * phi).mean() == pytest.approx(0.1149, abs=0.01)


def test_a_phase_that_would_turn_back_is_refused() -> None:
    with pytest.raises(InputError, match="first_rad"):
        PhaseModulatorError(0.6, 0.2)


@pytest.mark.parametrize(("first", "second"), [(0.04, 0.02), (1e-3, 0.0), (0.0, 2e-3)])
def test_it_is_found_in_ramps(acquired: Acquired, first: float, second: float) -> None:
    on = {"phase_modulator_error": {"first_rad": first, "second_rad": second}}
    found = PhaseModulatorError.estimate(acquired(RAMPS, on))
    assert found is not None
    assert isinstance(found.effect, PhaseModulatorError)
    assert abs(found.effect.first_rad - first) < 4 * found.errors["first_rad"] < 4e-4
    assert abs(found.effect.second_rad - second) < 4 * found.errors["second_rad"] < 4e-4
    assert found.significance > 6


def test_it_is_found_in_random_phases_where_it_is_large(acquired: Acquired) -> None:
    on = {"phase_modulator_error": {"first_rad": 0.5, "second_rad": 0.0}}
    found = PhaseModulatorError.estimate(acquired(None, on))
    assert found is not None
    assert isinstance(found.effect, PhaseModulatorError)
    assert abs(found.effect.first_rad - 0.5) < 4 * found.errors["first_rad"] < 0.4
    assert abs(found.effect.second_rad) < 4 * found.errors["second_rad"]
    assert found.significance > 5


@pytest.mark.parametrize(
    "alike",
    [None, {"nonlinearity": {}}, {"ipc": {}}, {"flat_error": {}}, {"lag": {"share": 0.01}}],
)
def test_what_shifts_the_gauge_of_the_maps_is_not_taken_for_it(
    acquired: Acquired, alike: dict[str, Any] | None
) -> None:
    found = PhaseModulatorError.estimate(acquired(RAMPS, alike))
    assert found is not None
    assert found.significance < 4


def test_a_phase_that_walks_beside_the_ramp_costs_only_precision() -> None:
    from pixcal.effects.phase_modulator_error import _of_ramp

    rng = np.random.default_rng(3)
    command = 0.7 * np.arange(400) + 1.0
    walk = 0.05 * np.cumsum(rng.standard_normal(400))
    phase = PhaseModulatorError(0.04, 0.02).actual(command) + walk
    found = _of_ramp(np.angle(np.exp(1j * phase)), np.zeros(2))
    assert np.all(np.abs(np.abs(found.size) - [0.04, 0.02]) < 4 * found.error)
    assert np.all(found.error < 0.02)
