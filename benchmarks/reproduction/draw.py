"""Panels that several figures share."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from pixcal.report.drawing import ColourScale
from pixcal.report.text import number

F64 = NDArray[np.float64]

THOUSANDTHS = "10⁻³ px"


def image(figure: Figure, axes: Axes, values: NDArray[Any], scale: ColourScale, unit: str) -> None:
    """A map (y, x) with its colour bar, square pixels, y upwards."""
    ny, nx = values.shape
    drawn = axes.imshow(
        np.ma.masked_invalid(values),
        vmin=scale.low,
        vmax=scale.high,
        cmap=scale.colours,
        origin="lower",
        interpolation="nearest",
        extent=(-0.5, nx - 0.5, -0.5, ny - 0.5),
    )
    _add_bar(figure, axes, drawn, unit, scale.beyond)
    axes.tick_params(labelsize=8)


def _add_bar(figure: Figure, axes: Axes, drawn: ScalarMappable, label: str, beyond: str) -> None:
    """A colour bar as high as the map beside it."""
    place = axes.inset_axes((1.04, 0, 0.05, 1))
    bar = figure.colorbar(drawn, cax=place, extend=beyond)
    bar.set_label(label)
    bar.minorticks_off()
    if not isinstance(drawn.norm, LogNorm):
        place.ticklabel_format(useOffset=False, style="plain")
        place.locator_params(axis="y", nbins=5)


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
