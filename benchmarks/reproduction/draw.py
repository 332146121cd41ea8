"""Panels that several figures share."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pixcal.report.drawing import ColourScale, add_bar

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
    """Both axes in powers of ten."""
    axes.set_xscale("log")
    axes.set_yscale("log")
