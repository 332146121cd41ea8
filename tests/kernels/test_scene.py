"""The bench as arrays: one chip for every window, Gaussian light, visibility, frames."""

from dataclasses import fields, replace
from typing import Any

import numpy as np
import pytest

from pixcal.kernels import scene
from pixcal.kernels.beams import LightMaps
from pixcal.model.bench import (
    SCHEMA,
    Bench,
    SimulatedDetector,
    SimulatedFrames,
    SimulatedOptics,
    SimulatedSet,
)
from pixcal.model.flags import PixelFlag

DETECTOR = SimulatedDetector(
    shape=(211, 307),
    chip=(500, 900),
    origin_px=(150, 333),
    pitch_um=4.4,
    gain_e_per_adu=1.0,
    read_noise_e=10.0,
    bias_adu=400.0,
    bias_pixel_rms_adu=3.0,
    bias_column_rms_adu=5.0,
    dark_e_s=20.0,
    hot_fraction=0.02,
    hot_rate_e_s=900.0,
    dead_fraction=0.01,
    prnu_rms=0.015,
    delta_rms_px=2e-3,
    stitch_rms_px=3e-2,
    stitch_px=(97, 131),
)
OPTICS = SimulatedOptics(
    wavelength_nm=632.8,
    distance_mm=400.0,
    beam_radius_mm=1.5,
    offset_mm=(0.2, -0.1),
    pointing_a_mm=(3.0, 0.1),
    pointing_b_mm=(-2.9, -0.2),
    power_ratio=0.7,
    visibility=0.8,
)
VERTICAL = SimulatedSet(name="vertical", baseline_mm=(6.0, 0.0), count=4000, peak_e=30000.0)
HORIZONTAL = SimulatedSet(
    name="horizontal", baseline_mm=(0.0, -3.0), count=7, peak_e=9000.0, offset_mm=(1.0, 2.0)
)
FRAMES = SimulatedFrames(exptime_s=0.02, period_s=0.14, fringes=(VERTICAL, HORIZONTAL))
BENCH = Bench(SCHEMA, DETECTOR, OPTICS, FRAMES, seed=3)
ALL = (0, 211)


def test_every_window_sees_the_same_chip() -> None:
    whole = scene.detector_maps(replace(DETECTOR, shape=(500, 900), origin_px=(0, 0)), (0, 500))
    window = scene.detector_maps(DETECTOR, ALL)
    part = scene.detector_maps(DETECTOR, (71, 138))
    for field in fields(window):
        seen = getattr(window, field.name)
        assert np.array_equal(seen, getattr(whole, field.name)[150:361, 333:640]), field.name
        assert np.array_equal(seen[71:138], getattr(part, field.name)), field.name
    other = scene.detector_maps(replace(DETECTOR, seed=1), ALL)
    assert not np.array_equal(other.delta_x, window.delta_x)


def test_the_window_is_in_the_middle_unless_told() -> None:
    middle = replace(DETECTOR, origin_px=None)
    assert middle.origin == ((500 - 211) // 2, (900 - 307) // 2)
    assert replace(middle, chip=None).origin == (0, 0)
    assert replace(middle, chip=None).chip_centre_px == ((307 - 1) / 2, (211 - 1) / 2)


def test_maps_have_the_spread_asked_for() -> None:
    chip = replace(DETECTOR, shape=(500, 900), origin_px=(0, 0))
    maps = scene.detector_maps(chip, (0, 500))
    n = 500 * 900
    dead, hot = maps.mask == PixelFlag.DEAD, maps.mask == PixelFlag.HOT
    assert dead.mean() == pytest.approx(0.01, abs=4 * np.sqrt(0.01 / n))
    assert hot.mean() == pytest.approx(0.02, abs=4 * np.sqrt(0.02 / n))
    assert not maps.response[dead].any()
    assert maps.response[~dead].mean() == pytest.approx(1, abs=1e-4)
    assert maps.response[~dead].std() == pytest.approx(0.015, rel=0.01)
    assert (maps.dark_rate[~hot] == 20).all()
    assert maps.dark_rate[hot].min() >= 20 + 450
    assert (maps.dark_rate[hot] - 20).mean() == pytest.approx(900, rel=0.03)
    columns = maps.bias.mean(axis=0)
    assert columns.mean() == pytest.approx(400, abs=4 * 5 / 30)
    assert columns.std() == pytest.approx(5, rel=0.1)
    assert (maps.bias - columns).std() == pytest.approx(3, rel=0.01)


def test_offsets_are_pixels_upon_stitching_blocks() -> None:
    chip = replace(DETECTOR, shape=(500, 900), origin_px=(0, 0))
    smooth = scene.detector_maps(replace(chip, delta_rms_px=0.0), (0, 500))
    full = scene.detector_maps(chip, (0, 500))
    blocks = smooth.delta_x[::97, ::131]
    assert np.array_equal(smooth.delta_x, blocks.repeat(97, 0)[:500].repeat(131, 1)[:, :900])
    assert len(np.unique(blocks)) == blocks.size
    assert not np.array_equal(smooth.delta_x, smooth.delta_y)
    assert blocks.std() == pytest.approx(3e-2, rel=0.4)
    along_x, along_y = full.delta_x - smooth.delta_x, full.delta_y - smooth.delta_y
    assert along_x.std() == pytest.approx(2e-3, rel=0.01)
    assert along_y.std() == pytest.approx(2e-3, rel=0.01)
    assert abs((along_x * along_y).mean()) < 2e-3**2 * 4 / np.sqrt(along_x.size)


def collected(maps: scene.DetectorMaps, electrons: float, rows: tuple[int, int] = ALL) -> LightMaps:
    """What pixels collect of the first fringe set."""
    return scene.fringe_light(BENCH, 0, rows, maps, electrons).collected(maps.response)


def test_each_fibre_lights_a_gaussian() -> None:
    a, b = scene.fibre_light(BENCH, 0, ALL)
    y, x = np.mgrid[:211, :307]
    # From the chip's centre, in mm; the window begins at row 150, column 333 of 500 x 900.
    mm_x, mm_y = (x + 333 - 449.5) * 4.4e-3, (y + 150 - 249.5) * 4.4e-3
    for light, peak, power in (
        (a, (0.2 - 3 + 3.0, -0.1 + 0.1), 1),
        (b, (0.2 + 3 - 2.9, -0.3), 0.7),
    ):
        radius2 = (mm_x - peak[0]) ** 2 + (mm_y - peak[1]) ** 2
        assert np.allclose(light, power * np.exp(-2 * radius2 / 1.5**2), rtol=1e-12)


def test_the_fringes_have_the_visibility_and_the_peak() -> None:
    maps = scene.detector_maps(replace(DETECTOR, prnu_rms=0.0, dead_fraction=0.0), ALL)
    electrons = scene.electrons_per_unit(BENCH, 0)
    light = collected(maps, electrons)
    a, b = scene.fibre_light(BENCH, 0, ALL)
    alpha = np.hypot(light.alpha_sin, light.alpha_cos)
    assert np.allclose(alpha / light.iota, 0.8 * 2 * np.sqrt(a * b) / (a + b), rtol=1e-6)
    assert (light.iota + alpha).max() == pytest.approx(30000, rel=1e-6)


def test_response_and_offsets_act_on_the_light() -> None:
    maps = scene.detector_maps(DETECTOR, (64, 100))
    flat = replace(maps, response=np.ones_like(maps.response))
    light, even = (collected(own, 5.0, (64, 100)) for own in (maps, flat))
    assert np.allclose(light.iota, even.iota * maps.response, rtol=1e-6)
    psi = np.arctan2(even.alpha_sin, even.alpha_cos)
    here = replace(flat, delta_x=0 * maps.delta_x, delta_y=0 * maps.delta_y)
    centred = collected(here, 5.0, (64, 100))
    shift = np.angle(np.exp(1j * (psi - np.arctan2(centred.alpha_sin, centred.alpha_cos))))
    k = 2 * np.pi / 9.588
    # Fringes along y are insensitive to delta_y, and grow with delta_x.
    assert np.allclose(shift, k * maps.delta_x, atol=2e-4 * np.abs(k * maps.delta_x).max() + 1e-6)


def test_the_geometry_is_seen_from_the_window() -> None:
    g = scene.geometry(BENCH, 0)
    assert g.centre_x == pytest.approx((449.5 - 333) * 4.4e-3 + 0.2)
    assert g.centre_y == pytest.approx((249.5 - 150) * 4.4e-3 - 0.1)
    own = scene.geometry(BENCH, 1)
    assert own.centre_x == pytest.approx((449.5 - 333) * 4.4e-3 + 1.0)
    assert (own.baseline_x, own.baseline_y) == (0.0, -3.0)


def test_a_set_may_have_optics_of_its_own() -> None:
    own: dict[str, Any] = {
        "distance_mm": 410.0,
        "beam_radius_mm": 2.5,
        "pointing_a_mm": (0.4, 0.1),
        "pointing_b_mm": (-0.2, 0.3),
        "power_ratio": 1.4,
        "visibility": 0.6,
    }
    frames = replace(FRAMES, fringes=(VERTICAL, replace(VERTICAL, name="own", **own)))
    bench = replace(BENCH, frames=frames)
    shared = replace(BENCH, optics=replace(OPTICS, **own))
    assert bench.optics_of(0) == OPTICS
    assert bench.optics_of(1) == shared.optics
    assert scene.geometry(bench, 1) == scene.geometry(shared, 0)
    for rows in ((0, 40), (100, 211)):
        found, expected = scene.fibre_light(bench, 1, rows), scene.fibre_light(shared, 0, rows)
        np.testing.assert_array_equal(found, expected)
    assert scene.electrons_per_unit(bench, 1) == scene.electrons_per_unit(shared, 0)
    maps = scene.detector_maps(DETECTOR, ALL)
    lights = (scene.fringe_light(b, n, ALL, maps, 5.0) for b, n in ((bench, 1), (shared, 0)))
    one, other = (light.phasor for light in lights)
    np.testing.assert_array_equal(one, other)


def test_frames_are_what_was_asked_for() -> None:
    states = scene.frame_states(BENCH, 0)
    assert states.phi.min() >= 0
    assert states.phi.max() < 2 * np.pi
    assert abs(np.exp(1j * states.phi).mean()) < 4 / np.sqrt(4000)
    assert (states.level == 1).all()
    assert (states.amplitude == 1).all()
    assert not states.dkx.any()
    assert not states.dky.any()
    fewer = replace(FRAMES, fringes=(replace(VERTICAL, count=50), HORIZONTAL))
    first = scene.frame_states(replace(BENCH, frames=fewer), 0)
    assert np.array_equal(first.phi, states.phi[:50])


def test_a_ramp_has_equal_steps() -> None:
    ramp = replace(VERTICAL, name="ramp", phase_law="ramp", phase_step_rad=0.7)
    frames = replace(FRAMES, fringes=(VERTICAL, ramp))
    steps = np.diff(np.unwrap(scene.frame_states(replace(BENCH, frames=frames), 1).phi))
    assert np.allclose(steps, 0.7)
