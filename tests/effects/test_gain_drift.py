"""Gain drift: shot noise goes with the gain, and with the root of the light."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pixcal.effects._level_change import LevelChange
from pixcal.effects.gain_drift import GainDrift
from pixcal.effects.intensity_noise import IntensityNoise
from pixcal.estimators.diagnosis.evidence import Evidence


@pytest.mark.parametrize("kind", [GainDrift, IntensityNoise])
def test_its_noise_tells_a_gain_from_light(
    acquired: Callable[..., Evidence], kind: type[LevelChange]
) -> None:
    """Either scales mean and fringes of a frame alike."""
    law: dict[str, Any] = {"rms": 0.02, "correlation_s": 0.0}
    evidence = acquired(None, {kind.name: law})
    found = {one: one.estimate(evidence) for one in (GainDrift, IntensityNoise)}
    for one, estimate in found.items():
        assert estimate is not None
        assert bool(estimate.refused) == (one is not kind)
        assert isinstance(estimate.effect, one)
        assert estimate.effect.rms == pytest.approx(0.02, abs=4 * estimate.errors["rms"])
        assert "cannot tell" not in estimate.refused
    noise = np.nanstd(evidence.fringes["vertical"].residual, axis=(1, 2))
    level = evidence.fringes["vertical"].free[:, 0]
    slope = np.polyfit(np.log(level), np.log(noise), 1)[0]
    assert slope == pytest.approx(1.0 if kind is GainDrift else 0.5, abs=0.15)


def test_where_noise_cannot_tell_the_light_is_named(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired(None, {"gain_drift": {"rms": 5e-4, "correlation_s": 0.0}})
    light, gain = IntensityNoise.estimate(evidence), GainDrift.estimate(evidence)
    assert light is not None
    assert gain is not None
    assert light.significance > 4
    assert not light.refused
    assert "cannot tell" in gain.refused
