"""Common parts of all figures: axes, colour scales, units, and the PNG.

Figures are made without pyplot: no state is global, so threads do not interfere.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator
from numpy.typing import NDArray
from PIL import Image

from pixcal.kernels.medians import median_and_sigma
from pixcal.report.colours import DIVERGING, INK, PALETTE, SEQUENTIAL
from pixcal.report.map_summary import MapSummary
from pixcal.report.text import exact

WIDE = 10.4  # width of a figure that takes the whole page, inches
DPI = 130
# style of titles at a fixed height, so that labels around them need not be measured
TITLE: dict[str, Any] = {"fontsize": 11, "y": 1.0}


@dataclass(frozen=True)
class Unit:
    """A unit with its power of ten, for axes whose numbers stay short."""

    factor: float  # factor on values
    label: str  # E.g. `10⁻³ px`


def unit_for(values: Any, name: str) -> Unit:
    """The unit, its thousandths or its millionths, by the largest value."""
    finite = np.abs(np.asarray(values, dtype=float))
    top = float(np.max(finite[np.isfinite(finite)], initial=0.0))
    if top == 0 or top >= 0.1:
        return Unit(1.0, name)
    factor, power = (1e3, "10⁻³") if top >= 1e-4 else (1e6, "10⁻⁶")
    return Unit(factor, f"{power} {name}".rstrip())


@dataclass(frozen=True)
class ColourScale:
    """Limits and colour map, and at which ends values exceed them."""

    low: float
    high: float
    colours: Colormap
    beyond: str


def symmetric_scale(image: NDArray[Any]) -> ColourScale:
    """Colours for three robust standard deviations on both sides of zero."""
    reach = 3 * median_and_sigma(image)[1]
    if not reach > 0:
        finite = image[np.isfinite(image)]
        reach = float(np.max(np.abs(finite), initial=0.0)) or 1.0
    return _scale(image, -reach, reach, DIVERGING)


def span_scale(image: NDArray[Any]) -> ColourScale:
    """Colours from the 0.5th to the 99.5th percentile, a little wider."""
    finite = image[np.isfinite(image)]
    low, high = np.percentile(finite, [0.5, 99.5]) if len(finite) else (0.0, 1.0)
    # A constant map still gets a scale with readable numbers.
    pad = 0.03 * (high - low) or 0.01 * abs(high) or 1.0
    return _scale(image, float(low - pad), float(high + pad), SEQUENTIAL)


def _scale(image: NDArray[Any], low: float, high: float, colours: Colormap) -> ColourScale:
    finite = image[np.isfinite(image)]
    below, above = bool(np.any(finite < low)), bool(np.any(finite > high))
    words = {(True, True): "both", (True, False): "min", (False, True): "max"}
    return ColourScale(low, high, colours, words.get((below, above), "neither"))


def new_figure(width: float, height: float) -> Figure:
    """A figure of a given size (inches) with a computed layout."""
    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
    return Figure(figsize=(width, height), dpi=DPI, layout=layout)


def axes_grid(
    size: tuple[float, float],
    rows: int = 1,
    columns: int = 1,
    *,
    left: float = 0.85,
    right: float = 0.2,
    bottom: float = 0.6,
    top: float = 0.2,
    beside: float = 1.0,
    between: float = 0.75,
    **drawing: Any,
) -> tuple[Figure, NDArray[Any]]:
    """A figure and its grid of axes (rows, columns) at fixed places.

    A computed layout would take half of the drawing. ``size``: width and height; the margins, and
    the gaps ``beside`` and ``between``, have to fit labels; all in inches. ``drawing``: for
    ``Figure.subplots``.
    """
    figure, (width, height) = Figure(figsize=size, dpi=DPI), size
    # Gaps are shares of the mean width and height of the axes.
    wide = (width - left - right - (columns - 1) * beside) / columns
    high = (height - bottom - top - (rows - 1) * between) / rows
    figure.subplots_adjust(
        left / width,
        bottom / height,
        1 - right / width,
        1 - top / height,
        beside / wide,
        between / high,
    )
    return figure, figure.subplots(rows, columns, squeeze=False, **drawing)


def place(figure: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    """Axes at a place given in inches from the lower left corner."""
    w, h = figure.get_size_inches()
    return figure.add_axes((left / w, bottom / h, width / w, height / h))


def draw_blocks(
    axes: Axes, image: NDArray[Any], side: int = 1, start: tuple[int, int] = (0, 0), **drawing: Any
) -> ScalarMappable:
    """An image of blocks of pixels at its place, y upwards; the first is at ``start`` (y, x)."""
    return axes.imshow(
        np.ma.masked_invalid(image),
        origin="lower",
        interpolation="nearest",
        extent=covered(image.shape, side, start),
        **drawing,
    )


def note(
    axes: Axes, text: str, at: tuple[float, float], aside: tuple[float, float], **style: Any
) -> None:
    """A text at a distance (right, up) from a place, in points."""
    axes.annotate(text, at, aside, textcoords="offset points", **style)


def second_axis(axes: Axes, side: Literal["top", "right"], factor: float) -> Any:
    """A second axis with the numbers times a factor."""
    functions = (lambda v: np.asarray(v) * factor, lambda v: np.asarray(v) / factor)
    if side == "top":
        return axes.secondary_xaxis("top", functions=functions)
    return axes.secondary_yaxis("right", functions=functions)


def covered(
    blocks: tuple[int, ...], side: int, start: tuple[int, int] = (0, 0)
) -> tuple[float, float, float, float]:
    """Outer edges (left, right, bottom, top), in pixels, of an image of blocks."""
    (y0, x0), (ny, nx) = start, blocks
    return x0 - 0.5, x0 + nx * side - 0.5, y0 - 0.5, y0 + ny * side - 0.5


def block_note(summary: MapSummary) -> str:
    """Note on the averaging of pixels for the figure; empty without averaging."""
    n = summary.block
    return f"mean of {n} × {n} px" if n > 1 else ""


def fit_box(shape: tuple[int, int], width: float, height: float, least: float = 1.4) -> Any:
    """Width and height (inches) of a map inside a box, pixels square unless it is very long."""
    ny, nx = shape
    scale = min(width / nx, height / ny)
    return max(nx * scale, least), max(ny * scale, least)


def finish(axes: Axes, *, grid: bool = True, legend: str = "", **settings: Any) -> None:
    """Style of axes with lines or points, where the legend is, and settings of ``Axes.set``."""
    axes.set(**settings)
    if legend:
        axes.legend(fontsize=9, framealpha=0.9, loc=legend)
    axes.spines[["top", "right"]].set_visible(False)
    if grid:
        axes.grid(True, color="#d9dee5", lw=0.7)
        axes.set_axisbelow(True)
    axes.tick_params(colors=INK)


def plain_ticks(axis: Axis, low: float, high: float, most: int = 6) -> None:
    """Plain numbers on a logarithmic axis from ``low`` to ``high``, no more than ``most``."""
    fine = (1, 1.2, 1.4, 1.6, 1.8, 2, 2.5, 3, 3.5, 4, 5, 6, 7, 8, 9)
    for steps in (fine, (1, 1.5, 2, 3, 4, 5, 7), (1, 2, 5), (1, 3), (1,)):
        ticks = [m * 10.0**e for e in range(-12, 16) for m in steps]
        shown = [t for t in ticks if low <= t <= high]
        if len(shown) <= most:
            break
    axis.set_major_locator(FixedLocator(shown[:: -(-len(shown) // most) or 1]))
    axis.set_major_formatter(FuncFormatter(lambda v, _: exact(v)))
    axis.set_minor_locator(NullLocator())


def limits(values: Sequence[Any], share: float = 0.002) -> tuple[float, float]:
    """Axis limits that contain all but a small share of the values, with a margin."""
    finite = np.concatenate([np.ravel(np.asarray(v, dtype=float)) for v in values])
    finite = finite[np.isfinite(finite)]
    if not len(finite):
        return -1.0, 1.0
    low, high = np.quantile(finite, [share, 1 - share])
    margin = 0.12 * (high - low) or max(abs(high), 1e-12) * 0.1
    return float(low - margin), float(high + margin)


def png(figure: Figure) -> bytes:
    """The figure as a PNG of 256 colours (a third of the bytes), the same every time."""
    canvas = FigureCanvasAgg(figure)
    if engine := figure.get_layout_engine():
        engine.execute(figure)
        figure.set_layout_engine("none")
        for axes in figure.axes:
            # The layout's last digits differ from time to time, and with them single pixels.
            axes.set_position(np.round(axes.get_position(original=True).bounds, 6).tolist())
    canvas.draw()
    picture = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    palette = Image.new("P", (1, 1))
    palette.putpalette(PALETTE)
    reduced = picture.quantize(palette=palette, dither=Image.Dither.NONE)
    out = io.BytesIO()
    # Level 9 takes four times as long for 7 % fewer bytes.
    reduced.save(out, "PNG", compress_level=7)
    return out.getvalue()
