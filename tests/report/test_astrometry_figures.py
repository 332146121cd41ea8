"""The picture of what maps bring for stars: of any result, and true to its numbers."""

import io
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from PIL import Image

from pixcal.report.astrometry_figures import AstrometryView, astrometry_figure
from pixcal.report.colours import BLUE, RED
from pixcal.report.drawing import png

SCALE = 6981.0


def number(px: float | None) -> dict[str, float | None]:
    return {
        "px": px,
        "err_px": None if px is None else 0.02 * px,
        "uas": None if px is None else SCALE * px,
        "err_uas": None,
    }


def an_axis(perfect: float | None, measured: float) -> dict[str, Any]:
    pair = {"perfect": number(perfect), "measured": number(measured)}
    return {
        "floor": pair,
        "photons": pair,
        "photon_bound": number(1.1e-4),
        "averaging": {
            "positions": [1, 2, 4, 5],
            "perfect_px": [None if perfect is None else perfect / n for n in (1, 1.4, 2, 2.2)],
            "perfect_err_px": [None if perfect is None else 1e-5] * 4,
            "measured_px": [measured / n for n in (1, 1.4, 2, 2.2)],
            "measured_err_px": [1e-6, 1e-6, None, 1e-6],
        },
    }


def a_view(perfect: float | None = 3e-3, **changes: Any) -> AstrometryView:
    rng = np.random.default_rng(1)
    detail = rng.normal(0, 1, (2, 50, 70)) * np.array([3e-3, 2e-4])[:, None, None]
    detail[:, :11] = np.nan
    electrons = np.geomspace(1e4, 1e12, 9)
    settings: dict[str, Any] = {
        "result": {
            "axes": {"x": an_axis(perfect, 2e-4), "y": an_axis(perfect, 2e-4)},
            "telescope": {
                "diameter_m": 7.0,
                "focal_length_m": 130.0,
                "wavelength_nm": 600.0,
                "uas_per_px": SCALE,
                "px_per_lambda_over_d": 2.53,
            },
            "stars": {"number": 100, "positions": 5, "electrons": 1e8, "window_px": 23},
            "detector": {"pixels": "the maps plus random errors of size SIGMA", "shape": [50, 70]},
        },
        "target_px": 5e-5,
        "table": (("no photon noise", "x", "3e-3 px, 21 µas", "2e-4 px, 1.4 µas", "15 ± 1"),) * 8,
        "photons": np.stack([electrons, 1.1 / np.sqrt(electrons)]),
        "weights": rng.normal(0, 0.01, (23, 23)),
        "detail": detail,
        "detail_at": (3, 9),
        "rms": np.abs(detail[:, ::8, ::8]),
        "block": 8,
    }
    return AstrometryView(**(settings | changes))


def axes_titled(figure: Figure, word: str) -> list[Any]:
    return [axes for axes in figure.axes if word in axes.get_title()]


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "view",
    [
        a_view(),
        a_view(None),
        a_view(rms=np.full((2, 7, 9), np.nan), detail=np.full((2, 50, 70), np.nan)),
        a_view(detail=np.zeros((2, 50, 70)), rms=np.zeros((2, 7, 9))),
    ],
)
def test_any_result_becomes_a_picture(view: AstrometryView) -> None:
    with Image.open(io.BytesIO(png(astrometry_figure(view)))) as drawn:
        assert min(drawn.size) > 1000
        assert len(drawn.convert("RGB").getcolors(1 << 24) or ()) > 50


def test_the_picture_of_a_result_is_the_same_every_time() -> None:
    assert len({png(astrometry_figure(a_view())) for _ in range(5)}) == 1


def test_the_curves_are_floor_and_photons() -> None:
    view = a_view()
    figure = astrometry_figure(view)
    (axes,) = [a for a in figure.axes if "photo-electrons" in a.get_xlabel()]
    lines = {line.get_label(): line for line in axes.get_lines()}
    for label, floor, colour in (("perfect grid", 3e-3, RED), ("measured maps", 2e-4, BLUE)):
        np.testing.assert_allclose(
            lines[label].get_ydata(), np.hypot(floor, view.photons[1]), rtol=1e-12
        )
        assert to_hex(lines[label].get_color()) == to_hex(colour)
    np.testing.assert_array_equal(lines["photon noise alone"].get_ydata(), view.photons[1])
    bottom, top = axes.get_ylim()
    assert bottom < view.target_px < 3e-3 < top


def test_the_maps_of_errors_share_their_colours_and_lie_in_their_place() -> None:
    view = a_view()
    figure = astrometry_figure(view)
    panels = axes_titled(figure, "error of a star at each place")
    assert len(panels) == 2
    limits = {panel.images[0].get_clim() for panel in panels}
    assert len(limits) == 1
    for panel, image in zip(panels, view.detail, strict=True):
        shown = panel.images[0]
        assert shown.get_extent() == [8.5, 78.5, 2.5, 52.5]
        unit = np.nanmax(shown.get_array()) / np.nanmax(image)
        np.testing.assert_allclose(shown.get_array().filled(np.nan), unit * image)


def test_the_table_is_all_there() -> None:
    figure = astrometry_figure(a_view())
    texts = [
        cell.get_text().get_text()
        for a in figure.axes
        for t in a.tables
        for cell in t.get_celld().values()
    ]
    assert texts.count("3e-3 px, 21 µas") == 8
    assert {"perfect grid", "measured maps", "gain"} <= set(texts)


def test_blocks_of_the_whole_detector() -> None:
    (one, two) = axes_titled(astrometry_figure(a_view()), "rms of 8 × 8 px")
    assert one.get_xlim() == two.get_xlim() == (-0.5, 69.5)
    assert one.get_ylim() == (-0.5, 49.5)
