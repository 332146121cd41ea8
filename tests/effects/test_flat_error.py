"""Flat error: as large as given, in iota and alpha alike, nothing in delta; found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.flat_error import FlatError
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.maps.map_fit import polynomial, without
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.recording import recordings


def test_its_parts_have_the_size_given_and_belong_to_the_chip(
    make_effect_bench: Callable[..., Bench],
) -> None:
    detector = make_effect_bench({"detector.shape": [300, 500]}).detector
    pixels = FlatError(0.01, 0.0).ratio(detector, (0, 300)) - 1
    smooth = FlatError(0.0, 0.01).ratio(detector, (0, 300)) - 1
    assert pixels.std() == pytest.approx(0.01, rel=4 / np.sqrt(2 * pixels.size))
    assert smooth.std() == pytest.approx(0.01, rel=0.1)
    assert np.diff(smooth, axis=0).std() < 0.01 / 8
    both = FlatError(0.01, 0.01).ratio(detector, (0, 300)) - 1
    np.testing.assert_allclose(both, pixels + smooth, atol=1e-6)
    changes = {
        "detector.shape": [40, 50],
        "detector.chip": [300, 500],
        "detector.origin_px": [7, 9],
    }
    window = make_effect_bench(changes).detector
    np.testing.assert_allclose(
        FlatError().ratio(window, (0, 40)), FlatError().ratio(detector, (7, 47))[:, 9:59], atol=1e-6
    )


def test_fringes_have_it_and_flats_do_not(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({"detector.shape": [30, 34]})
    for r in recordings(bench):
        plain, on = (frames_of(bench, r, e) for e in ((), (FlatError(0.02),)))
        if r.kind != "fringes":
            np.testing.assert_array_equal(plain, on)
            continue
        seen = (on.mean(axis=0) - 500.0) / (plain.mean(axis=0) - 500.0)
        wanted = FlatError(0.02).ratio(bench.detector, (0, 30))
        assert np.corrcoef(seen.ravel(), wanted.ravel())[0, 1] > 0.99


def test_offsets_do_not_move(acquired: Callable[..., Evidence]) -> None:
    plain, on = acquired(), acquired(None, {"flat_error": {}})
    for name, fringes in on.fringes.items():
        good = fringes.good & plain.fringes[name].good
        moved = (fringes.delta - plain.fringes[name].delta)[good]
        noise = (fringes.sigma / np.hypot(*fringes.k))[good]
        # The same random numbers: the noise nearly cancels.
        assert moved.std() < 0.5 * np.median(noise)


@pytest.mark.quick(1)
@pytest.mark.parametrize("pixel_rms", [5e-4, 2e-3])
def test_its_size_is_found(acquired: Callable[..., Evidence], pixel_rms: float) -> None:
    on = {"pixel_rms": pixel_rms, "smooth_rms": 2.5 * pixel_rms, "scale_px": 4.0}
    evidence = acquired(None, {"flat_error": on})
    found = FlatError.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, FlatError)
    error = found.errors["pixel_rms"]
    assert abs(found.effect.pixel_rms - pixel_rms) < 4 * error < 0.5 * pixel_rms
    # Of the smooth part, what this window holds beyond a parabola.
    error = found.errors["smooth_rms"]
    assert abs(found.effect.smooth_rms - 2.5 * pixel_rms) < 4 * error < 2.5 * pixel_rms
    assert abs(found.effect.scale_px - 4.0) < 4 * found.errors["scale_px"] < 2.0
    assert found.significance > 6


@pytest.mark.quick(1)
def test_a_pattern_of_any_form_is_measured_mode_by_mode(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    # Three lengths, and no whole number of waves on the window: its modes are others.
    x, y = (0.31, 0.83, 0.12), (0.23, -0.41, 1.37)
    cos, sin = (0.004, 0.0, -0.003), (0.0, 0.004, 0.002)
    waves = {"wave_x_rad_px": x, "wave_y_rad_px": y, "wave_cos": cos, "wave_sin": sin}
    true = FlatError(0.0, 0.0, 8.0, x, y, cos, sin)
    on = {name: list(values) for name, values in waves.items()}
    evidence = acquired(None, {"flat_error": on | {"pixel_rms": 0.0, "smooth_rms": 0.0}})
    found = FlatError.estimate(evidence)
    assert found is not None
    assert isinstance(found.in_full, FlatError)
    (ny, nx), (y0, x0) = evidence.good.shape, evidence.origin
    at = {"detector.shape": [ny, nx], "detector.chip": None, "detector.origin_px": [y0, x0]}
    detector = make_effect_bench(at).detector
    wanted, measured = (e.ratio(detector, (0, ny)) - 1 for e in (true, found.in_full.scaled(1.0)))
    smooth = replace(found.in_full, pixel_rms=0.0).ratio(detector, (0, ny)) - 1
    left = (smooth - wanted)[evidence.good]
    assert left.std() < 0.35 * wanted[evidence.good].std()
    # Of its size in all: what stands out in no mode counts as white.
    assert measured.std() == pytest.approx(wanted.std(), rel=0.1)


def test_a_wave_has_four_numbers() -> None:
    with pytest.raises(InputError, match="wave_cos, wave_sin: give the same number of values"):
        FlatError(wave_x_rad_px=(0.1,), wave_y_rad_px=(0.2,), wave_cos=(0.01,))


CROSSED = {"parent": "crossed"}
"""Other ghosts move mean light and fringes alike, as a flat does; their phase tells."""


@pytest.mark.quick(1)
@pytest.mark.parametrize("other", ["ipc", "nonlinearity", "ghost_fringes", "straylight"])
def test_others_are_not_taken_for_it(acquired: Callable[..., Evidence], other: str) -> None:
    found = FlatError.estimate(acquired(None, {other: CROSSED if other == "ghost_fringes" else {}}))
    assert found is not None
    assert found.significance < 4


def test_without_flats_nothing_is_said(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired()
    bare = replace(evidence, stacks=evidence.of_kind("bias"))
    assert FlatError.estimate(bare) is None


def test_free_terms_are_taken_off_whatever_their_size() -> None:
    free = polynomial((9, 11), 2).reshape(6, -1).T * np.array([1, 1e6, 1e-6, 1, 1, 0])
    columns = free @ np.arange(12.0).reshape(6, 2)
    np.testing.assert_allclose(without(columns, free), 0, atol=1e-6 * np.abs(columns).max())
