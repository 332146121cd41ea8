"""The picture of a budget: true to its numbers, whatever the bench."""

import io
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from pixcal.report.budget_figures import BudgetView, budget_figure
from pixcal.report.budget_figures import PrecisionLine as Line
from pixcal.report.drawing import png


def a_view(**changes: Any) -> BudgetView:
    settings: dict[str, Any] = {
        "name": "bench.yaml",
        "sets": (Line("a (9.6 px)", 0.01, 0.02, 400), Line("b (5 px)", 0.005, 0.005, 100)),
        "joined": (Line("delta_x", 0.015, 0.03, 500), Line("delta_y", 0.016, 0.03, 500)),
        "precision": 1e-4, "frames": None, "period_s": 0.14,
        "levers": (("finer", 1e-5, 0.14), ("as planned", 4e-5, 0.14), ("worse", 6e-5, 0.14)),
    }  # fmt: skip
    return BudgetView(**(settings | changes))


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for axes in figure.get_axes() for text in axes.texts]


@pytest.mark.parametrize(
    "view",
    [
        a_view(),
        a_view(precision=None, frames=3000),
        a_view(sets=(Line("a", 1e-3, 5.0, 1),), joined=(), frames=1),
        a_view(period_s=1e-4),
        a_view(sets=tuple(Line(f"s{n}", 0.01, 0.01, 10 + n) for n in range(9))),
    ],
)
def test_any_budget_becomes_a_picture(view: BudgetView) -> None:
    picture = Image.open(io.BytesIO(png(budget_figure(view))))
    assert min(picture.size) > 500


def test_lines_are_one_over_the_root_and_meet_the_wanted_line() -> None:
    axes = budget_figure(a_view()).get_axes()[0]
    lines = {line.get_label(): line for line in axes.lines}
    for label, one in (("a (9.6 px)", 0.01), ("b (5 px)", 0.005)):
        frames, precision = (np.asarray(v) for v in lines[label].get_data())
        np.testing.assert_allclose(precision, one / np.sqrt(frames))
    marks = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "s"]
    np.testing.assert_allclose(marks, [1e4, 2500, 22500, 25600])
    planned = [list(line.get_xdata()) for line in axes.lines if line.get_marker() == "o"]
    assert planned[:2] == [[400], [100]]


def test_bars_are_the_time_over_the_planned() -> None:
    figure = budget_figure(a_view())
    bars = [bar.get_width() for bar in figure.get_axes()[1].patches]
    assert bars == pytest.approx([1.5, 1.0, 0.25])
    # 4e-5 px² a frame for 1e-4 px: 4000 frames of 0.14 s.
    assert any("100 %   9.33 min" in text for text in texts(figure))
    assert any("wanted 1.00 × 10⁻⁴ px" in text for text in texts(figure))
    assert any(
        "3\u202f000 frames of each set" in t for t in texts(budget_figure(a_view(frames=3000)))
    )
