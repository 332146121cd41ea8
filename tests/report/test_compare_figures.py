"""The picture of a comparison: true to its numbers, whatever is compared."""

import io
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from pixcal.report.compare_figures import ComponentView, compare_figure
from pixcal.report.drawing import png

NOTHING = np.full(120, np.nan)


def amount(px: float, error: float) -> dict[str, float]:
    return {
        "px": px,
        "error_px": error,
        "upper_px": px + 2 * error,
        "variance_px2": px**2,
        "variance_error_px2": 2 * px * error if px else error**2,
    }


def a_scale(side: int, beyond: float = 0.0) -> dict[str, Any]:
    noise = 1e-3 / side
    return {
        "side_px": side,
        "common": amount(2e-3 / side, 1e-5),
        "expected_px": noise,
        "difference_px": np.hypot(noise, beyond),
        "ratio_error": 0.02 * side**0.5,
        "significance": 9.0 if beyond else 0.5,
        "beyond_noise": amount(beyond, 1e-5),
    }


def a_component(shape: tuple[int, int] = (90, 120), **changes: Any) -> ComponentView:
    rng = np.random.default_rng(0)
    ny, nx = shape
    blocks = (-(-ny // 8), -(-nx // 8))
    facts = {
        "slope": changes.pop("slope", 1.02),
        "scales": changes.pop("scales", (a_scale(1), a_scale(2, 4e-4), a_scale(4))),
        "blocks": {"side_px": 8},
    }
    settings: dict[str, Any] = {
        "name": "delta_x",
        "window": shape,
        "facts": facts,
        "reach": 0.01,
        "picture": rng.poisson(2.0, (96, 96)),
        "far": (),
        "shift": rng.normal(size=blocks),
        "scatter": rng.normal(size=blocks),
        "profiles": {
            name: (rng.normal(0, 1e-4, n), np.full(n, 1e-4))
            for name, n in (("columns", nx), ("rows", ny))
        },
    }
    return ComponentView(**(settings | changes))


def drawn(*components: ComponentView) -> Figure:
    return compare_figure(("monday", "tuesday"), components or (a_component(),))


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "view",
    [
        (),
        (a_component(), a_component(name="delta_y", slope=None)),
        (a_component((7, 200), name="delta_fringe", far=((3, 100),)),),
        (a_component(scales=(a_scale(1),), shift=np.full((12, 15), np.nan)),),
        (a_component(profiles=dict.fromkeys(("columns", "rows"), (NOTHING, NOTHING))),),
        (a_component(picture=np.zeros((96, 96), int), reach=1.0),),
    ],
)
def test_any_comparison_becomes_a_picture(view: tuple[ComponentView, ...]) -> None:
    picture = Image.open(io.BytesIO(png(drawn(*view))))
    assert min(picture.size) > 600


def test_the_sizes_are_where_they_are() -> None:
    figure = drawn()
    axes = next(a for a in figure.get_axes() if a.get_title() == "by scale")
    lines = {line.get_label(): line for line in axes.lines}
    difference = np.asarray(lines["difference"].get_ydata())
    np.testing.assert_allclose(difference, [1.0, np.hypot(0.5, 0.4), 0.25])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1", "2", "≥4"]
    beyond = [c for c in axes.containers if c.get_label() == "difference beyond noise"]
    assert np.asarray(beyond[0].lines[0].get_ydata()) == pytest.approx([0.4])
    assert "δx" in figure.get_axes()[0].get_title()


def test_pixels_and_blocks_that_disagree_are_marked() -> None:
    scatter = np.zeros((12, 15))
    scatter[3, 4] = 8.0
    figure = drawn(a_component(far=((10, 20), (30, 40)), scatter=scatter))
    axes = next(a for a in figure.get_axes() if a.get_title().startswith("blocks of 8 px"))
    (frame,) = axes.patches
    assert frame.get_xy() == (31.5, 23.5)
    marks = {(line.get_xdata()[0], line.get_ydata()[0]) for line in axes.lines}
    assert marks == {(20, 10), (40, 30)}
    assert "○ pixels" in axes.get_title()
    assert "□ scatter" in axes.get_title()
