"""Straylight: visibility falls, offsets stay; slopes are found, fibres of unequal light are not."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pixcal.effects.straylight import Straylight
from pixcal.estimators.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.effect import FringeMaps
from pixcal.simulation.exposure import frames_of
from pixcal.simulation.recording import recordings


def test_it_adds_its_share_to_the_mean_light_of_fringes_only(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench({"detector.shape": [30, 34], "optics.visibility": 1e-3})
    stray = Straylight(0.1, (1e-3, 0.0))
    for r in recordings(bench):
        plain, on = (frames_of(bench, r, e) for e in ((), (stray,)))
        if r.kind != "fringes":
            np.testing.assert_array_equal(plain, on)
            continue
        more = (on.mean(axis=0) - plain.mean(axis=0)) / (plain.mean(axis=0) - 500.0)
        expected = 0.1 + 1e-3 * np.arange(34)
        np.testing.assert_allclose(more.mean(axis=0), expected, atol=2e-3)


def test_maps_lose_visibility_and_keep_their_phase() -> None:
    y, x = np.mgrid[:20, :30]
    theta = 2e4 * np.stack([np.ones(x.shape), 0.9 * np.sin(1.1 * x), 0.9 * np.cos(1.1 * x)])
    seen = Straylight(0.2, (-0.02, 0.01)).predict(FringeMaps(theta, (1.1, 0.0), (5, 7)))
    pattern = np.maximum(0.2 - 0.02 * (x + 7) + 0.01 * (y + 5), 0)
    assert pattern.min() == 0
    np.testing.assert_allclose(seen.theta[0], 2e4 * (1 + pattern))
    np.testing.assert_array_equal(seen.theta[1:], theta[1:])


@pytest.mark.parametrize("factor", [1.0, 0.1])
def test_its_slopes_are_found(acquired: Callable[..., Evidence], factor: float) -> None:
    truth = Straylight().scaled(factor)
    on = {"share": truth.share, "slope_per_px": list(truth.slope_per_px)}
    found = Straylight.estimate(acquired(None, {"straylight": on}))
    assert found is not None
    assert isinstance(found.effect, Straylight)
    for n in (0, 1):
        error = found.errors[f"slope_per_px[{n}]"]
        assert abs(found.effect.slope_per_px[n] - truth.slope_per_px[n]) < 4 * error < 4e-6
    assert abs(found.effect.share - truth.share) < 4 * found.errors["share"]
    assert found.effect.share <= truth.share <= found.details["share_at_most"]
    assert found.significance > 10


def test_unequal_fibres_are_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    """Beams that also point apart: a gradient of the visibility along and across the baseline."""
    unequal = {
        "optics.power_ratio": 2.0, "optics.pointing_a_mm": [6.0, 4.0],
        "optics.offset_mm": [10.0, 18.0], "optics.beam_radius_mm": 20.0,
    }  # fmt: skip
    found = Straylight.estimate(acquired(unequal))
    assert found is not None
    assert found.significance < 4


def test_a_rolling_shutter_is_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    """It lowers the visibility by rows, in all sets alike."""
    found = Straylight.estimate(acquired(None, {"rolling_shutter": {}}))
    assert found is not None
    assert found.significance < 4


def test_with_one_set_only_the_slope_across_is_told(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired(None, {"straylight": {}})
    one = {"vertical": evidence.fringes["vertical"]}
    found = Straylight.estimate(replace(evidence, fringes=one))
    assert found is not None
    assert isinstance(found.effect, Straylight)
    assert abs(found.effect.slope_per_px[1] - -2e-5) < 4 * found.errors["slope_per_px[1]"]
    assert abs(found.effect.slope_per_px[0]) < 1e-6
