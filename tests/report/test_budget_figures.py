"""The picture of a budget: true to its numbers, whatever the bench."""

import io
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from pixcal.report.budget_figures import budget_figure
from pixcal.report.drawing import png


def line(median: float, worst: float, frames: int, **more: Any) -> dict[str, Any]:
    return {"frame_px": {"median": median, "worst": worst}, "planned": {"frames": frames}} | more


def a_budget(period_s: float = 0.14, **changes: Any) -> dict[str, Any]:
    levers = (("finer", 1e-5), ("as planned", 4e-5), ("worse", 6e-5))
    components = {"delta_x": line(0.015, 0.03, 500), "delta_y": line(0.016, 0.03, 500)}
    return {
        "sets": {
            "a": line(0.01, 0.02, 400, interfringe_px=9.6),
            "b": line(0.005, 0.005, 100, interfringe_px=5.0),
        },
        "joined": {"components": components},
        "precision_px": 1e-4,
        "frames": None,
        "levers": [{"name": n, "variance": v, "period_s": period_s} for n, v in levers],
    } | changes


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for axes in figure.get_axes() for text in axes.texts]


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    "budget",
    [
        a_budget(),
        a_budget(precision_px=None, frames=3000),
        a_budget(sets={"a": line(1e-3, 5.0, 1)}, frames=1),
        a_budget(period_s=1e-4),
        a_budget(sets={f"s{n}": line(0.01, 0.01, 10 + n) for n in range(9)}),
    ],
)
def test_any_budget_becomes_a_picture(budget: dict[str, Any]) -> None:
    picture = Image.open(io.BytesIO(png(budget_figure(budget))))
    assert min(picture.size) > 500


def test_lines_are_one_over_the_root_and_meet_the_wanted_line() -> None:
    axes = budget_figure(a_budget()).get_axes()[0]
    lines = {line.get_label(): line for line in axes.lines}
    for label, one in (("a (9.6 px)", 0.01), ("b (5 px)", 0.005)):
        frames, precision = (np.asarray(v) for v in lines[label].get_data())
        np.testing.assert_allclose(precision, one / np.sqrt(frames))
    marks = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "s"]
    np.testing.assert_allclose(marks, [1e4, 2500, 22500, 25600])
    planned = [list(line.get_xdata()) for line in axes.lines if line.get_marker() == "o"]
    assert planned[:2] == [[400], [100]]


def test_bars_are_the_time_over_the_planned() -> None:
    figure = budget_figure(a_budget())
    bars = [bar.get_width() for bar in figure.get_axes()[1].patches]
    assert bars == pytest.approx([1.5, 1.0, 0.25])
    # 4e-5 px² a frame for 1e-4 px: 4000 frames of 0.14 s.
    assert any("100 %   9.33 min" in text for text in texts(figure))
    assert any("wanted 1.00 × 10⁻⁴ px" in text for text in texts(figure))
    assert any(
        "3\u202f000 frames of each set" in t for t in texts(budget_figure(a_budget(frames=3000)))
    )
