"""Straylight: visibility falls, offsets stay; patterns are found, unequal fibres are not."""

from collections.abc import Callable

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.straylight import Straylight
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.maps.structure import flattened
from pixcal.model.bench import Bench
from pixcal.simulation.effect import FringeMaps
from pixcal.simulation.light_fit import fit_light
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


BUMP = {
    "share": 0.0,
    "slope_per_px": [0.0, 0.0],
    "bump": 0.04,
    "bump_centre_px": [40.0, 20.0],
    "bump_radius_px": 18.0,
}


@pytest.mark.quick(1)
@pytest.mark.parametrize("bump", [0.04, 0.004])
def test_a_bump_is_found(acquired: Callable[..., Evidence], bump: float) -> None:
    """But for what two beams can make: a quadratic surface in the logarithm."""
    on = BUMP | {"bump": bump}
    evidence = acquired(None, {"straylight": on})
    found = Straylight.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, Straylight)
    assert found.significance > 8
    fit = fit_light(Straylight.starts(evidence), evidence, Straylight.smooth_degree)
    assert fit is not None
    for kind in ("the mean light", "the visibility"):
        assert fit.agreed[kind] == pytest.approx(1, abs=0.3)
    rows, columns = ((0, n) for n in evidence.good.shape)
    truth = Straylight(0.0, (0.0, 0.0), bump, (40.0, 20.0), 18.0).pattern(rows, columns)
    for name in evidence.fringes:
        seen = found.effect.pattern(rows, columns, name)
        assert seen.min() >= 0
        apart = flattened(np.log1p(seen), 2) - flattened(np.log1p(truth), 2)
        # The polynomials end where the bump goes on: a twentieth of it, and the noise.
        assert apart.std() < 0.05 * flattened(np.log1p(truth), 2).std() + 1e-4


@pytest.mark.long
def test_unequal_fibres_are_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    """Beams that also point apart: a gradient of the visibility along and across the baseline."""
    unequal = {
        "optics.power_ratio": 2.0,
        "optics.pointing_a_mm": [6.0, 4.0],
        "optics.offset_mm": [10.0, 18.0],
        "optics.beam_radius_mm": 20.0,
    }
    found = Straylight.estimate(acquired(unequal))
    assert found is not None
    assert found.significance < 4


@pytest.mark.quick(1)
@pytest.mark.parametrize("other", ["flat_error", "rolling_shutter"])
def test_others_are_not_taken_for_it(acquired: Callable[..., Evidence], other: str) -> None:
    """A rolling shutter lowers the visibility by rows, and leaves the mean light."""
    found = Straylight.estimate(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4
