"""Intra-pixel response: visibility of a box; its width and scatter are found with two baselines."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from pixcal.effects.intra_pixel_response import SHARED, IntraPixelResponse, _slopes, transfer
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.scene import detector_maps, fringe_light
from pixcal.model.bench import Bench
from pixcal.simulation.effect import FringeMaps
from pixcal.simulation.recording import recordings

FIVE = 2 * np.pi / 5


@pytest.mark.parametrize("width", [0.3, 1.0, 1.7])
def test_a_box_averages_the_fringe(width: float) -> None:
    places = (np.arange(1000) + 0.5) / 1000 * width - width / 2
    assert transfer(FIVE, width) == pytest.approx(np.cos(FIVE * places).mean(), rel=1e-5)


def test_amplitudes_fall_by_it_and_all_else_stays(make_effect_bench: Callable[..., Bench]) -> None:
    bench, rows = make_effect_bench({"detector.shape": [120, 130]}), (0, 120)
    effect = IntraPixelResponse((0.9, 0.4), 0.02)
    maps = detector_maps(bench.detector, rows)
    for r in recordings(bench):
        if r.kind != "fringes":
            continue
        plain = fringe_light(bench, r.number, rows, maps, 2e4).collected(maps.response)
        on = effect.pixels(plain, r, rows, maps)
        np.testing.assert_array_equal(on.iota, plain.iota)
        ratio = on.phasor / plain.phasor
        np.testing.assert_allclose(np.angle(ratio), 0, atol=1e-6)
        axis = r.number
        baseline = bench.frames.fringes[axis].baseline_mm[axis]
        k = 2 * np.pi / 632.8e-6 * 4.4e-3 * baseline / 400
        width = effect.width_px[axis]
        assert np.abs(ratio).mean() == pytest.approx(transfer(k, width), rel=2e-4)
        # The law's slope times the scatter of the widths.
        slope = (transfer(k, width + 1e-4) - transfer(k, width - 1e-4)) / 2e-4
        expected = abs(slope) * 0.02
        assert np.abs(ratio).std() == pytest.approx(expected, rel=0.04)


def test_maps_lose_what_the_mean_width_takes() -> None:
    theta = np.random.default_rng(1).random((3, 4, 5))
    seen = IntraPixelResponse((0.9, 0.5)).predict(FringeMaps(theta, (1.2, 0.3))).theta
    np.testing.assert_array_equal(seen[0], theta[0])
    np.testing.assert_allclose(seen[1:], theta[1:] * transfer(1.2, 0.9) * transfer(0.3, 0.5))


@pytest.mark.parametrize("width", [0.95, 2.0])
def test_the_scatter_of_visibilities_follows_the_slope_of_the_law(width: float) -> None:
    """Not its first term, whose variance is 5 % short at a period of 5 px and a width of 0.95."""
    found = SimpleNamespace(k=(FIVE, 0.3))
    draws = np.random.default_rng(2).standard_normal((2, 200_000))
    widths = width + 1e-3 * draws
    visibility = np.log(transfer(FIVE, widths[0])) + np.log(transfer(0.3, widths[1]))
    slopes = _slopes(found, width)
    assert slopes @ slopes * 1e-6 == pytest.approx(visibility.var(), rel=0.015)


@pytest.mark.quick(1)
@pytest.mark.parametrize(("width", "rms"), [(0.95, 0.005), (0.95, 0.02), (0.6, 0.01)])
def test_width_and_scatter_are_found(
    acquired: Callable[..., Evidence], width: float, rms: float
) -> None:
    on = {"intra_pixel_response": {"width_px": [width, width], "width_rms_px": rms}}
    found = IntraPixelResponse.estimate(acquired(None, on))
    assert found is not None
    assert isinstance(found.effect, IntraPixelResponse)
    assert abs(found.effect.width_px[0] - width) < 4 * found.errors["width_px[0]"] < 0.4 * width
    # The scatter goes with the width that is found.
    allowed = found.errors["width_rms_px"] + rms * found.errors["width_px[0]"] / width
    assert abs(found.effect.width_rms_px - rms) < 4 * allowed
    assert found.errors["width_rms_px"] < 0.2 * rms
    assert found.significance > 5
    assert not found.refused


@pytest.mark.quick(1)
@pytest.mark.parametrize("other", ["ipc", "ghost_fringes", "nonlinearity", "flat_error", "lag"])
def test_others_are_not_taken_for_it(acquired: Callable[..., Evidence], other: str) -> None:
    found = IntraPixelResponse.estimate(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4


def test_one_interfringe_tells_nothing(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired()
    one = {"vertical": evidence.fringes["vertical"]}
    bare = replace(evidence, fringes=one)
    assert IntraPixelResponse.estimate(bare) is None


@pytest.mark.quick(1)
def test_hot_pixels_that_no_dark_shows_are_no_scatter(acquired: Callable[..., Evidence]) -> None:
    evidence, rng = acquired(), np.random.default_rng(3)
    places = (rng.choice(n, 12, replace=False) for n in evidence.good.shape)
    share = np.zeros(evidence.good.shape)
    share[*places] = np.exp(rng.uniform(np.log(0.02), np.log(0.2), 12))
    fringes = {}
    for name, found in evidence.fringes.items():
        hot = share * np.median(found.theta[0]) * (2 if name == "vertical" else 1)
        added = np.stack([hot, np.zeros_like(hot), np.zeros_like(hot)])
        more = np.tensordot(found.g, added, 1).astype(np.float32)
        fringes[name] = replace(found, theta=found.theta + added, electrons=found.electrons + more)
    estimate = IntraPixelResponse.estimate(replace(evidence, fringes=fringes))
    assert estimate is not None
    assert abs(estimate.significance) < 4


@pytest.mark.parametrize("shared", [True, False])
def test_scatter_that_crossed_fringes_share_is_not_of_widths(
    acquired: Callable[..., Evidence], shared: bool
) -> None:
    """The same part of the amplitude of each pixel, whatever the fringes, or one for each axis."""
    evidence, rng = acquired(), np.random.default_rng(4)
    shape = evidence.good.shape
    both, fringes = rng.standard_normal(shape), {}
    for (name, found), rms in zip(evidence.fringes.items(), (6e-3, 2e-3), strict=True):
        part = rms * (both if shared else rng.standard_normal(shape))
        change = np.concatenate([np.zeros((1, *shape)), found.theta[1:] * part])
        more = np.tensordot(found.g, change, 1).astype(np.float32)
        fringes[name] = replace(found, theta=found.theta + change, electrons=found.electrons + more)
    found = IntraPixelResponse.estimate(replace(evidence, fringes=fringes))
    assert found is not None
    assert found.significance > 4
    assert bool(found.refused) == shared


SETS = [
    {"name": f"set{n}", "baseline_mm": mm, "count": 300, "peak_e": 45000}
    for n, mm in enumerate(([11.5, 0.0], [0.0, 11.0], [5.5, 0.0]))
]


@pytest.mark.long
@pytest.mark.parametrize("alike", [0.0, 0.5, 1.0])
def test_widths_that_diffusion_makes_alike_along_both_axes_are_told(
    acquired: Callable[..., Evidence], alike: float
) -> None:
    """With two periods along an axis, a width is told from a contrast common to all fringes."""
    widths = {"width_px": [0.95, 0.95], "width_rms_px": 0.02, "alike": alike}
    found = IntraPixelResponse.estimate(
        acquired({"frames.fringes": SETS}, {"intra_pixel_response": widths})
    )
    assert found is not None
    assert isinstance(found.effect, IntraPixelResponse)
    assert not found.refused
    assert found.effect.alike == pytest.approx(alike, abs=0.1)
    assert abs(found.effect.alike - alike) <= 4 * found.errors.get("alike", 0.0)
    allowed = found.errors["width_rms_px"]
    assert abs(found.effect.width_rms_px - 0.02) < 4 * allowed < 0.02


@pytest.mark.long
def test_a_contrast_that_all_fringes_share_is_not_of_widths(
    acquired: Callable[..., Evidence],
) -> None:
    """Widths that scatter as well do not hide it."""
    widths = {"width_px": [0.95, 0.95], "width_rms_px": 0.005}
    evidence = acquired({"frames.fringes": SETS}, {"intra_pixel_response": widths})
    part = 6e-3 * np.random.default_rng(5).standard_normal(evidence.good.shape)
    fringes = {}
    for name, found in evidence.fringes.items():
        change = np.concatenate([np.zeros((1, *part.shape)), found.theta[1:] * part])
        more = np.tensordot(found.g, change, 1).astype(np.float32)
        fringes[name] = replace(found, theta=found.theta + change, electrons=found.electrons + more)
    estimate = IntraPixelResponse.estimate(replace(evidence, fringes=fringes))
    assert estimate is not None
    assert estimate.refused == SHARED
