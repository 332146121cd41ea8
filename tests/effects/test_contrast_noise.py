"""Contrast noise: one-sided and slow parts, told from the laser's power and from offsets."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import skew

from pixcal.effects.contrast_noise import ContrastNoise
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.exposure import states_of
from pixcal.simulation.frame_changes import FrameChanges
from pixcal.simulation.recording import recordings

Benches = Callable[..., Bench]
Acquired = Callable[..., Evidence]


def contrast(**parameters: float) -> dict[str, Any]:
    return {"contrast_noise": {"vibration_rad": 0.0, "polarisation": 0.0} | parameters}


def factor(bench: Bench, **parameters: float) -> np.ndarray:
    """Contrast of the frames of the first set over that without the effect."""
    frames = next(r for r in recordings(bench) if r.kind == "fringes")
    effect = ContrastNoise(**({"vibration_rad": 0.0, "polarisation": 0.0} | parameters))
    plain, noisy = states_of(frames, ()), states_of(frames, (effect,))
    np.testing.assert_array_equal(noisy.level, plain.level)
    return noisy.amplitude / plain.amplitude


def test_a_vibration_only_takes_contrast_by_an_exponential_of_its_energy(
    make_effect_bench: Benches,
) -> None:
    found = -np.log(
        factor(make_effect_bench({"frames.fringes.0.count": 20_000}), vibration_rad=0.3)
    )
    assert found.min() >= 0
    assert found.mean() == pytest.approx(0.3**2 / 2, rel=0.03)
    assert found.std() == pytest.approx(0.3**2 / 2, rel=0.05)
    assert skew(found) == pytest.approx(2.0, abs=0.3)


def test_the_smear_is_that_of_a_gaussian_phase_within_the_exposure(
    make_effect_bench: Benches,
) -> None:
    # Fringes averaged over a phase of rms s fall to exp(-s²/2), by direct averaging.
    s = 0.4
    phases = s * np.random.default_rng(1).standard_normal(400_000)
    assert np.abs(np.exp(1j * phases).mean()) == pytest.approx(np.exp(-(s**2) / 2), rel=2e-3)


def test_polarisation_goes_either_way_slowly_and_never_beyond_all_the_light(
    make_effect_bench: Benches,
) -> None:
    bench = make_effect_bench({"frames.fringes.0.count": 20_000})
    found = factor(bench, polarisation=0.01, polarisation_s=7.0)
    keep = np.exp(-0.14 / 7.0)
    assert found.std() == pytest.approx(0.01, rel=0.3)
    assert np.corrcoef(found[1:], found[:-1])[0, 1] == pytest.approx(keep, abs=0.01)
    clipped = factor(bench, polarisation=0.2, polarisation_s=0.0)
    assert clipped.max() == pytest.approx(1 / 0.95)


@pytest.mark.long
@pytest.mark.parametrize("vibration", [0.05, 0.015, 0.2])
def test_a_vibration_is_found(acquired: Acquired, vibration: float) -> None:
    found = ContrastNoise.estimate(acquired(None, contrast(vibration_rad=vibration)))
    assert found is not None
    assert isinstance(found.effect, ContrastNoise)
    assert abs(found.effect.vibration_rad - vibration) < 4 * found.errors["vibration_rad"]
    assert found.errors["vibration_rad"] < 0.06 * vibration
    assert found.significance > 6
    assert found.effect.polarisation == 0


@pytest.mark.long
def test_a_slow_change_is_found_beside_a_vibration(acquired: Acquired) -> None:
    truth = {"vibration_rad": 0.05, "polarisation": 0.004, "polarisation_s": 1.5}
    found = ContrastNoise.estimate(acquired(None, contrast(**truth)))
    assert found is not None
    for name, value in truth.items():
        assert abs(getattr(found.effect, name) - value) < 4 * found.errors[name]
    assert found.errors["polarisation"] < 0.002


@pytest.mark.long
def test_it_is_found_beside_a_laser_that_changes(acquired: Acquired) -> None:
    found = ContrastNoise.estimate(
        acquired(None, contrast(vibration_rad=0.1) | {"intensity_noise": {"rms": 0.02}})
    )
    assert found is not None
    assert isinstance(found.effect, ContrastNoise)
    assert abs(found.effect.vibration_rad - 0.1) < 4 * found.errors["vibration_rad"] < 0.03


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "alike",
    [
        {"intensity_noise": {"rms": 0.02}},
        {"intensity_noise": {"rms": 0.01, "correlation_s": 1.4}},
        {"bias_drift": {}},
        {"lag": {"share": 0.01}},
        {"nonlinearity": {}},
        {"rolling_shutter": {}},
    ],
)
def test_what_looks_like_it_is_not_taken_for_it(acquired: Acquired, alike: dict[str, Any]) -> None:
    found = ContrastNoise.estimate(acquired(None, alike))
    assert found is not None
    assert found.significance < 4


@pytest.mark.long
def test_random_changes_are_drawn_once_for_all_acquisitions_of_the_same_frames(
    acquired: Acquired,
) -> None:
    one, other = acquired(), acquired({"seed": 72, "optics.visibility": 0.949})
    for evidence in (one, other):
        watched = FrameChanges(evidence).series(ContrastNoise())
        found = [w.part(ContrastNoise()) for w in watched]
    again = [w.part(ContrastNoise()) for w in FrameChanges(one).series(ContrastNoise())]
    assert all(a is b for a, b in zip(found, again, strict=True))
    slower = FrameChanges(acquired({"frames.period_s": 0.2})).series(ContrastNoise())[0]
    assert slower.part(ContrastNoise()) is not found[0]
