"""Effects on light alone, measured by their forward models: unbiased, errors as they scatter."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pixcal.effects.hyperbolic_fringes import HyperbolicFringes
from pixcal.effects.straylight import Straylight, StrayPattern
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.beams import Light
from pixcal.kernels.scene import DetectorMaps
from pixcal.simulation.effect import Effect
from pixcal.simulation.forward import field_of, numbers, set_of, with_numbers
from pixcal.simulation.light_fit import LightStart
from pixcal.simulation.replica import set_recordings

DRAWS = 24
NOISE = 3e-3
"""Of light and fringes of a pixel, relative."""


def drawn(evidence: Evidence, effect: Effect, seed: int) -> Evidence:
    """Maps of even light with an effect, and noise."""
    rng = np.random.default_rng(seed)
    shape = evidence.good.shape
    y, x = np.indices(shape, float)
    nothing, one = np.zeros(shape, np.float32), np.ones(shape, np.float32)
    maps = DetectorMaps(nothing, nothing, one, nothing, nothing, nothing, one, one.astype(np.uint8))
    fringes = {}
    for name, f in evidence.fringes.items():
        psi = f.k[0] * x + f.k[1] * y
        plain = Light.of_fringes(2e4 * one, 1.8e4 * np.exp(1j * psi))
        recording = set_recordings(evidence)[name]
        seen = effect.light(plain, recording, (0, shape[0]), maps)
        theta = np.stack([seen.mean, seen.phasor.imag, seen.phasor.real])
        theta += 2e4 * NOISE * rng.standard_normal(theta.shape)
        fringes[name] = replace(f, theta=theta)
    return replace(evidence, fringes=fringes)


def stray(evidence: Evidence) -> Straylight:
    """A smooth pattern in each set, of some per cent, never negative."""
    start = Straylight.starts(evidence)[0].model
    rng = np.random.default_rng(5)
    keys = [key for key in numbers(start) if field_of(key) == "patterns"]
    return with_numbers(start, {key: 2e-3 * rng.standard_normal() for key in keys})


@pytest.mark.long
@pytest.mark.parametrize("case", ["straylight", "hyperbolic_fringes"])
def test_they_are_right_on_average_and_scatter_by_their_errors(
    acquired: Callable[..., Evidence], case: str
) -> None:
    evidence = acquired()
    effect = stray(evidence) if case == "straylight" else HyperbolicFringes((24.0, -18.0))
    truth, pulls = numbers(effect), []
    for seed in range(DRAWS):
        found = type(effect).estimate(drawn(evidence, effect, seed))
        assert found is not None
        assert found.significance > 5
        values = numbers(found.effect)
        pulls.append([(values[k] - truth[k]) / e for k, e in sorted(found.errors.items())])
    each = np.array(pulls)
    assert np.abs(each.mean(axis=0)).max() < 4 / np.sqrt(DRAWS)
    assert (each**2).mean() == pytest.approx(1, abs=4 * np.sqrt(2 / each.size) + 0.1)


@pytest.mark.long
@pytest.mark.parametrize("kind", [Straylight, HyperbolicFringes])
def test_of_nothing_they_say_what_chance_says(
    acquired: Callable[..., Evidence], kind: type[Effect]
) -> None:
    nothing = kind().scaled(0.0)
    draws = [kind.estimate(drawn(acquired(), nothing, seed)) for seed in range(DRAWS)]
    sigmas = np.array([found.significance for found in draws if found is not None])
    assert len(sigmas) == DRAWS
    assert abs(sigmas.mean()) < 4 / np.sqrt(DRAWS)
    assert sigmas.max() < 4


def test_numbers_are_found_by_the_keys_of_errors_and_stay_in_range(
    acquired: Callable[..., Evidence],
) -> None:
    start = Straylight.starts(acquired())[0]
    assert isinstance(start, LightStart)
    key = "patterns[1].coefficients[7]"
    assert numbers(start.model)[key] == 0
    moved = with_numbers(start.model, {key: 99.0, "share": -1.0})
    assert numbers(moved)[key] == 20
    assert moved.share == 0
    assert {k for k, v in numbers(moved).items() if v != numbers(start.model)[k]} == {key}


def test_a_loss_of_contrast_that_the_mean_light_does_not_have_is_no_straylight(
    acquired: Callable[..., Evidence],
) -> None:
    evidence = acquired()
    effect = stray(evidence)
    seen, plain = (drawn(evidence, e, 1) for e in (effect, effect.scaled(0.0)))
    fringes = {}
    for name, f in seen.fringes.items():
        iota = f.theta[0]
        theta = np.stack([plain.fringes[name].theta[0], *(f.theta[1:] * 2e4 / iota)])
        fringes[name] = replace(f, theta=theta)
    found = Straylight.estimate(replace(evidence, fringes=fringes))
    assert found is not None
    assert found.significance == 0


def test_a_number_of_one_set_changes_the_maps_of_no_other() -> None:
    parts = tuple(StrayPattern(name, (0, 9), (0, 9), (0.1, 0.2)) for name in ("a", "b"))
    model = Straylight(0.0, (0.0, 0.0), patterns=parts)
    keys = [key for key in numbers(model) if "coefficients" in key]
    assert [set_of(model, key) for key in keys] == ["a", "a", "b", "b"]
    assert set_of(model, "share") == set_of(model, "slope_per_px[1]") == ""
    before = [model.pattern((0, 9), (0, 9), part.set) for part in parts]
    for key in keys:
        moved = with_numbers(model, {key: 0.5})
        for part, was in zip(parts, before, strict=True):
            if part.set != set_of(model, key):
                np.testing.assert_array_equal(moved.pattern((0, 9), (0, 9), part.set), was)
