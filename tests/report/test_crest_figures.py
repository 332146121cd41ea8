"""The figure of crests and valleys: a picture for any set, and true to its numbers."""

import io
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_hex
from PIL import Image

from pixcal.report.colours import BLUE, INK, RED
from pixcal.report.crest_figures import CrestView, crest_figure, outermost
from pixcal.report.drawing import png


def a_view(angle: float = 0.0, paths: int = 9, points: int = 7, **changes: Any) -> CrestView:
    """Points on straight paths 25 px apart; the model lies 0.02 px beyond each of them."""
    k, along = (a.ravel() for a in np.mgrid[0:paths, 0:points])
    across = 25.0 * k
    along = 20.0 * along
    distance = np.linspace(384, 416, 5)
    bowl = 1 + (distance[:, None] - 400) ** 2 + np.linspace(-3, 3, 5) ** 2
    arrays: dict[str, Any] = {
        "x": across * np.cos(angle) - along * np.sin(angle),
        "y": across * np.sin(angle) + along * np.cos(angle),
        "k": 5 * k - 20,
        "used": np.ones(len(k), bool),
        "distance": distance,
        "baseline": distance * 0.015,
        "ratio": 0.015 * (1 + np.linspace(-1e-5, 1e-5, 5)),
        "cost_baseline": bowl,
        "cost_ratio": bowl,
        "valley_ratio": np.full(5, 0.015),
        "valley_cost": bowl[:, 2],
    }
    arrays |= {name: changes.pop(name) for name in arrays.keys() & changes.keys()}
    settings: dict[str, Any] = {
        "name": "vertical",
        "frame": (140, 230),
        "direction": (np.cos(angle), np.sin(angle)),
        "arrays": arrays,
        "sigma_px": np.full(len(k), 0.01),
        "residual_px": np.full(len(k), -0.02),
        "fibres": (np.array([-500.0, 40.0]), np.array([800.0, 40.0])),
        "extracts": ((np.ones((40, 30)), (0, 0)), (np.ones((40, 30)), (90, 200))),
        "best": (400.0, 6.0),
        "distance_sigma": 0.25,
        "distance_from_prior": False,
    }
    return CrestView(**(settings | changes))


def picture(view: CrestView) -> Image.Image:
    opened = Image.open(io.BytesIO(png(crest_figure(view))))
    opened.load()
    return opened.convert("RGB")


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "view",
    [
        a_view(),
        a_view(2.3),
        a_view(paths=3, points=1),
        a_view(paths=2),
        a_view(residual_px=np.zeros(63), sigma_px=np.full(63, 1e-9)),
        a_view(cost_ratio=np.full((5, 5), 3.0), valley_cost=np.full(5, 3.0), distance_sigma=0.0),
    ],
)
def test_any_set_becomes_a_picture(view: CrestView) -> None:
    drawn = picture(view)
    assert min(drawn.size) > 1000
    assert len(drawn.getcolors(1 << 24) or ()) > 50


def test_crests_are_red_and_valleys_blue_where_they_are() -> None:
    figure = crest_figure(a_view())
    whole = next(a for a in figure.get_axes() if "outermost" in a.get_title())
    lines = {to_hex(line.get_color()): line for line in whole.lines if len(line.get_xdata()) == 7}
    assert set(lines) == {RED, BLUE}
    shown = {float(line.get_xdata()[0]) for line in whole.lines if len(line.get_xdata()) == 7}
    assert shown == {0.0, 25.0, 50.0, 75.0, 125.0, 150.0, 175.0, 200.0}


def test_the_fit_is_drawn_on_its_side_of_the_points() -> None:
    """A phase short of k pi: the model's crest is farther along the fringe vector."""
    figure = crest_figure(a_view())
    axes = next(a for a in figure.get_axes() if a.get_title() == "first paths")
    model = [line for line in axes.lines if to_hex(line.get_color()) == INK]
    points = [line for line in axes.lines if line.get_marker() == "o"]
    lines = [line for line in model if len(line.get_xdata()) == 7]
    for line, at in zip(lines, points, strict=True):
        assert np.asarray(line.get_xdata()) - at.get_xdata() == pytest.approx(0.02)


def test_the_maps_show_the_minimum_and_say_what_is_held() -> None:
    titles = {a.get_title(): a for a in crest_figure(a_view()).get_axes()}
    for title, y in (("cost per point, others held", 6.0), ("cost per point, others refitted", 0)):
        (cross,) = (line for line in titles[title].lines if line.get_marker() == "x")
        assert (cross.get_xdata()[0], cross.get_ydata()[0]) == (400.0, y)
    assert "400.00 ± 0.25 mm" in titles
    prior = crest_figure(a_view(distance_from_prior=True))
    assert "400.00 ± 0.25 mm, nominal" in {a.get_title() for a in prior.get_axes()}


def test_short_paths_in_corners_are_not_the_outermost() -> None:
    k = np.repeat([-9, -4, 1, 6, 11, 16], [1, 6, 8, 8, 7, 2])
    first, last = outermost(k)
    assert first.tolist() == [-4, 1]
    assert last.tolist() == [6, 11]
