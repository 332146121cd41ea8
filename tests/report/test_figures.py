"""Figures: valid pictures at any size, true colours, nothing global."""

import base64
import io
import threading
from typing import Any

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from PIL import Image

from pixcal.report import detector_figures, map_figures, map_panels, set_figures
from pixcal.report.colours import DIVERGING, MASKED, PALETTE, SEQUENTIAL
from pixcal.report.contents import MapContents, SetContents
from pixcal.report.drawing import png, span_scale, symmetric_scale, unit_for
from pixcal.report.map_summary import (
    ArraySource,
    MapSummary,
    Spectrum,
    spectrum,
    summarise,
    summarise_flags,
)

SIZES = [(67, 131), (1, 1), (131, 67), (2, 300), (900, 7), (450, 500), (3, 1700)]


def a_map(shape: tuple[int, int], level: float = 0.0, spread: float = 4e-3) -> MapSummary:
    values = level + spread * np.random.default_rng(1).normal(size=shape)
    if values.size > 100:
        values[1, 1] = np.nan
    return summarise(ArraySource(values.astype(np.float32)))


def open_png(data: bytes) -> Image.Image:
    assert data.startswith(b"\x89PNG\r\n\x1a\n")
    picture = Image.open(io.BytesIO(data))
    picture.load()
    return picture.convert("RGB")


def picture_of(panel: map_panels.Panel) -> Image.Image:
    return open_png(base64.b64decode(panel.src.removeprefix("data:image/png;base64,")))


def colours_of(panel: map_panels.Panel) -> set[Any]:
    return {c for _, c in picture_of(panel).getcolors(1 << 24) or ()}


@pytest.mark.quick(1)
@pytest.mark.parametrize("shape", SIZES)
def test_maps_of_any_size_become_pictures(shape: tuple[int, int]) -> None:
    delta, sigma = a_map(shape), a_map(shape, 4e-4, 1e-5)
    for figure in (
        map_figures.offsets("delta_x", delta, sigma),
        map_figures.histogram([MapContents("delta_x", delta, sigma, None)]),
        map_figures.histogram([MapContents("delta_x", delta, sigma, None)] * 3),
    ):
        assert min(open_png(png(figure)).size) > 150
    panel = map_panels.map_panel("bias", "ADU", delta)
    assert picture_of(panel).size == delta.image.shape[::-1]
    assert 0 < min(panel.width, panel.height) <= max(panel.width, panel.height) == map_panels.BOX
    for at, _ in (*panel.x, *panel.y, *panel.colours):
        assert 0 <= at <= map_panels.BOX


def test_a_map_on_the_page_is_upright_and_has_the_colours_of_its_values() -> None:
    values = np.linspace(0, 1, 12).reshape(3, 4)
    values[2, 3] = np.nan
    panel = map_panels.map_panel("", "", summarise(ArraySource(values.astype(np.float32))))
    shown = np.asarray(picture_of(panel)).astype(int)
    assert (shown[0, 3] == np.rint(255 * np.array(to_rgb(MASKED)))).all()
    dark, bright = (np.rint(255 * np.array(SEQUENTIAL(n)[:3])) for n in (2, 78))
    assert np.abs(shown[2, 0] - dark).max() < 12  # the lowest value is at the bottom left
    assert np.abs(shown[0, 2] - bright).max() < 40


def test_ticks_are_where_their_numbers_say() -> None:
    for at, text in map_panels.ticks(-2.0, 6.0, 80.0, upwards=True):
        assert at == pytest.approx(80 - 10 * (float(text.replace("−", "-")) + 2))
    decades = map_panels.ticks(0.5, 2000.0, 100.0, upwards=False, log=True)
    assert np.ptp(np.diff([at for at, _ in decades])) < 1e-9


def test_long_profiles_are_drawn_as_ranges_that_hold_every_mean() -> None:
    values = np.random.default_rng(7).normal(size=1801)
    values[[0, 5, 900]] = np.nan
    values[30:36] = np.nan
    low, middle, high = map_figures._nearby(values)
    good = np.isfinite(values)
    assert (low[good] <= values[good]).all()
    assert (values[good] <= high[good]).all()
    assert len(np.unique(middle[np.isfinite(middle)])) <= map_figures.MEANS_DRAWN / 2
    assert np.nanmean(middle) == pytest.approx(np.nanmean(values), abs=0.02)


def with_spectrum(name: str, made: Spectrum) -> MapContents:
    return MapContents(name, a_map((20, 30)), a_map((20, 30)), made)


@pytest.mark.parametrize("shape", [(67, 131), (2, 300), (450, 500)])
def test_spectra_of_any_size_become_pictures(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(2).normal(size=shape)
    made = spectrum(ArraySource(values), ArraySource(np.ones(shape)))
    assert made is not None
    vectors = {name: (1.26, 0.1 * n) for n, name in enumerate("abcdef")}
    maps = [with_spectrum("delta_y", made)]
    open_png(png(map_figures.power(maps, vectors)))
    (panel,), legend = map_panels.spectra(maps, vectors)
    assert picture_of(panel).size == made.power.shape[::-1]
    assert len(panel.marks) == 4 * len(legend) == 4 * len(vectors)


def test_the_fringe_is_marked_where_its_power_is() -> None:
    k = (2 * np.pi * 0.7, 0.0)  # beyond Nyquist: shows folded at -0.3 cycles/px
    y, x = np.mgrid[:128, :128]
    made = spectrum(ArraySource(np.sin(k[0] * x + k[1] * y)), ArraySource(np.full((128, 128), 0.1)))
    assert made is not None
    (panel,), _ = map_panels.spectra([with_spectrum("delta_x", made)], {"set": k})
    marks = np.array(
        [(m.x / map_panels.BOX - 0.5, 0.5 - m.y / map_panels.BOX) for m in panel.marks if m.round]
    )
    fy, fx = made.frequencies
    i, j = np.unravel_index(made.power.argmax(), made.power.shape)
    assert np.hypot(*(marks - (fx[j], fy[i])).T).min() < 1 / 128


@pytest.mark.parametrize("shape", [(67, 131), (450, 500)])
def test_flags_keep_their_colours(shape: tuple[int, int]) -> None:
    values = np.zeros(shape, np.uint8)
    values[: shape[0] // 2] = 1
    (panel,), _ = map_panels.flags({"one": summarise_flags(ArraySource(values))})
    shown = colours_of(panel)
    red = tuple(round(255 * v) for v in to_rgb("#d7301f"))
    assert (red in shown) == (max(shape) <= 400)  # shares, not flags, where blocks are averaged


def test_equal_masks_are_drawn_once() -> None:
    flags = summarise_flags(ArraySource(np.eye(30, dtype=np.uint8)))
    other = summarise_flags(ArraySource(2 * np.eye(30, dtype=np.uint8)))
    panels, _ = map_panels.flags({"a": flags, "b": flags, "c": other})
    assert [panel.title for panel in panels] == ["a, b", "c"]


def a_set(frames: int, *, moving: bool) -> SetContents:
    rng = np.random.default_rng(3)
    time = 0.14 * np.arange(frames)
    free = 1e-6 * rng.normal(size=(2, frames)) * moving
    series = {"time": time, "B": np.ones(frames), "A": np.ones(frames)}
    series |= {"phi": rng.uniform(-3, 3, frames), "dkx": free[0], "dky": free[1]}
    level = a_map((40, 50), 2e4, 10.0)
    chi2 = a_map((40, 50), 1.0, 0.1)
    facts = {"frames": frames, "chi2_reduced": 1.01, "crb_median_px": 3e-4}
    flags = summarise_flags(ArraySource(np.zeros((40, 50), np.uint8)))
    return SetContents("name", facts, level, a_map((40, 50), 0.9, 1e-3), chi2, flags, series)


@pytest.mark.quick(2)
@pytest.mark.parametrize("frames", [1, 2, 97, 20_001])
@pytest.mark.parametrize("moving", [False, True])
def test_runs_of_any_length_become_pictures(frames: int, moving: bool) -> None:
    fringes = a_set(frames, moving=moving)
    figure = set_figures.temporal([fringes])
    assert len(figure.axes) == (6 if moving else 4)
    open_png(png(figure))
    for sets in ([fringes], [fringes] * 3):
        open_png(png(set_figures.chi2(sets)))


def test_long_runs_are_thinned_and_say_so() -> None:
    figure = set_figures.temporal([a_set(20_001, moving=False)])
    points = figure.axes[0].lines[0].get_xdata()
    assert len(np.asarray(points)) == 5001
    assert "every 4th frame" in figure.axes[-2].get_xlabel()


def allan_entry(**changes: Any) -> dict[str, Any]:
    law = [1e-3, 7.1e-4, 5e-4]
    return {
        "frames": [500, 1000, 2000],
        "seconds": [70.0, 140.0, 280.0],
        "adev_px": law,
        "adev_lo_px": [0.9 * v for v in law],
        "adev_hi_px": [1.1 * v for v in law],
        "white_expected_px": law,
        "slope": -0.5,
        "slope_err": 0.01,
        "knee_frames": None,
    } | changes


@pytest.mark.parametrize(
    "changes", [{}, {"knee_frames": 900.0}, {"slope": None}, {"seconds": [0.0, 0.0, 0.0]}]
)
def test_the_allan_plot(changes: dict[str, Any]) -> None:
    facts = {"frames": 2000, "crb_median_px": 4.5e-4}
    figure = set_figures.allan_figure({"name": (allan_entry(**changes), facts)})
    upper = figure.axes[0]
    assert upper.get_xscale() == upper.get_yscale() == "log"
    lines = {str(line.get_label()): line for line in upper.lines}
    # The bound of n frames is that of all frames times sqrt(all / n).
    bound = np.asarray(lines["Cramér–Rao bound"].get_ydata()) * 1e-3
    np.testing.assert_allclose(bound, 4.5e-4 * np.sqrt(2000 / np.array([500, 1000, 2000])))
    legend = upper.get_legend()
    assert legend is not None
    words = " ".join(t.get_text() for t in legend.get_texts())
    assert ("slope −0.500 ± 0.010" in words) == (changes.get("slope", -0.5) is not None)
    knee = [t.get_text() for t in upper.texts]
    assert knee == ([" knee: 900 frames"] if changes.get("knee_frames") else [])
    open_png(png(figure))


def test_the_linearity_plot_leaves_out_unused_steps() -> None:
    levels = [
        {"level_e": 1e4 * n, "deviation_percent": 0.1 * n if n < 3 else None} for n in (1, 2, 3)
    ]
    axes = detector_figures.linearity(levels, 0.05).axes[0]
    assert len(axes.containers) == 1
    assert [len(np.asarray(line.get_xdata())) for line in axes.lines][1] == 2


def test_a_picture_has_exact_map_colours_and_is_the_same_every_time() -> None:
    delta, sigma = a_map((50, 60)), a_map((50, 60), 4e-4, 1e-5)
    first = png(map_figures.offsets("delta_x", delta, sigma))
    assert png(map_figures.offsets("delta_x", delta, sigma)) == first
    shown = {c for _, c in open_png(first).getcolors(1 << 24) or ()}
    wanted = {tuple(int(v) for v in np.rint(255 * np.array(DIVERGING(n)[:3]))) for n in range(81)}
    assert len(wanted & shown) > 75
    assert tuple(round(255 * v) for v in to_rgb(MASKED)) in shown
    assert len(PALETTE) <= 3 * 256


def test_the_diverging_colours_are_symmetric_and_even() -> None:
    colours = DIVERGING(np.arange(81))[:, :3]
    assert colours[40].min() > 0.93
    grey = colours @ (0.2126, 0.7152, 0.0722)
    assert (np.diff(grey[:41]) > 0).all()
    assert (np.diff(grey[40:]) < 0).all()
    assert abs(grey[0] - grey[-1]) < 0.12
    assert to_rgb(MASKED) not in [tuple(c) for c in SEQUENTIAL(np.arange(81))[:, :3]]


def test_scales_hold_what_they_should() -> None:
    values = np.random.default_rng(4).normal(0, 2.0, (300, 300))
    values[0, 0] = 1e9
    scale = symmetric_scale(values)
    assert scale.low == -scale.high
    assert scale.high == pytest.approx(6.0, rel=0.02)
    assert scale.beyond == "both"
    for constant in (0.0, 5.0, -3.0):
        flat = np.full((4, 4), constant)
        for made in (symmetric_scale(flat), span_scale(flat)):
            assert made.low < made.high
    assert span_scale(np.full((4, 4), np.nan)).low < 1


@pytest.mark.parametrize(
    ("values", "label"),
    [([4e-3], "10⁻³ px"), ([3e-5], "10⁻⁶ px"), ([2.0], "px"), ([np.nan], "px"), ([], "px")],
)
def test_units_keep_numbers_short(values: list[float], label: str) -> None:
    assert unit_for(values, "px").label == label


def test_figures_are_drawn_in_threads_and_leave_no_state() -> None:
    before = dict(matplotlib.rcParams)
    delta, sigma = a_map((50, 60)), a_map((50, 60), 4e-4, 1e-5)
    alone = png(map_figures.offsets("delta_x", delta, sigma))
    drawn: list[bytes] = []
    threads = [
        threading.Thread(
            target=lambda: drawn.append(png(map_figures.offsets("delta_x", delta, sigma)))
        )
        for _ in range(3)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert drawn == [alone] * 3
    assert dict(matplotlib.rcParams) == before
