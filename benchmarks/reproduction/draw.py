"""Panels that several figures share."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from pixcal.report.drawing import ColourScale, add_bar
from pixcal.report.text import number

F64 = NDArray[np.float64]

THOUSANDTHS = "10⁻³ px"


def image(figure: Figure, axes: Axes, values: NDArray[Any], scale: ColourScale, unit: str) -> None:
    """A map (y, x) with its colour bar, square pixels, y upwards."""
    ny, nx = values.shape
    drawn = axes.imshow(
        np.ma.masked_invalid(values), norm=scale.norm, cmap=scale.colours, origin="lower",
        interpolation="nearest", extent=(-0.5, nx - 0.5, -0.5, ny - 0.5),
    )  # fmt: skip
    add_bar(figure, axes, drawn, unit, scale.beyond)
    axes.tick_params(labelsize=8)


def logarithmic(axes: Axes) -> None:
    """Both axes logarithmic, with ticks that can be read."""
    axes.set_xscale("log")
    axes.set_yscale("log")
    plain_ticks(axes.xaxis)
    plain_ticks(axes.yaxis)


def plain_ticks(axis: Axis) -> None:
    """Ticks of a logarithmic axis at 1, 2 and 5 of each decade where there are few decades."""
    low, high = axis.get_view_interval()
    few = high / max(low, 1e-300) < 300
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if few else (1,), numticks=12))
    axis.set_major_formatter(FuncFormatter(lambda value, _: number(value, 1)))
    axis.set_minor_formatter(NullFormatter())
