"""Map of the deviations of the data from the simulations, by cell of a window or by window."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from pixcal.model.arrays import F64
from pixcal.report.colours import DIVERGING, GREY, INK
from pixcal.report.drawing import TITLE, WIDE, axes_grid

CELLS = "cell of 4 × 4"  # `x_label` of curves whose values are cells of the window
ASIDE = 3.0  # standard deviations below which a map is not shown
LARGEST = 12.0  # standard deviations at the end of the colour scale
# least side of a drawn window as a share of the detector: true windows would be dots
SMALLEST = 0.17


@dataclass(frozen=True)
class DeviationMap:
    """A map of one statistic or domain."""

    title: str
    # (spot, 6) parts of the detector: ends of rows, ends of columns, and deviation before and
    # after, standard deviations
    spots: F64

    @property
    def largest(self) -> float:
        """Largest deviation of any spot, before or after, in standard deviations."""
        return float(np.abs(self.spots[:, 4:]).max())


def panels(
    shape: tuple[int, int], places: Sequence[Mapping[str, Any]], curves: Sequence[Mapping[str, Any]]
) -> list[DeviationMap]:
    """Maps with a notable deviation, the largest first.

    By the windows in ``places`` of ``diagnosis.json`` (none for a small detector), else by cells of
    ``curves``. ``shape``: (y, x) of the detector's window.
    """
    maps = [_of_cells(shape, curve) for curve in curves if curve["x_label"] == CELLS and not places]
    for domain in places[0]["domains"] if places else ():
        spots = [[*np.ravel(p["window"]), *p["domains"][domain]] for p in places]
        maps.append(DeviationMap(domain, np.array(spots, float)))
    maps = [panel for panel in maps if panel.largest > ASIDE]
    return sorted(maps, key=lambda panel: -panel.largest)[:3]


def _of_cells(shape: tuple[int, int], curve: Mapping[str, Any]) -> DeviationMap:
    count = round(len(curve["z"]) ** 0.5)
    y, x = (np.linspace(0, size, count + 1) for size in shape)
    row, column = np.divmod(np.arange(count**2), count)
    spots = [y[row], y[row + 1], x[column], x[column + 1], curve["z"], curve["z_after"]]
    return DeviationMap(f"{curve['title']}\nset {curve['set']}", np.array(spots, float).T)


def where_figure(
    shape: tuple[int, int], maps: Sequence[DeviationMap], *, with_after: bool
) -> Figure:
    """Maps side by side, in the nominal simulation and, below, with the causes."""
    rows = 1 + with_after
    figure, axes = axes_grid(
        (WIDE * (1 + len(maps)) / 4, 0.9 + 3.0 * rows),
        rows,
        len(maps),
        left=0.95,
        top=0.6,
        beside=0.3,
        between=0.25,
        sharex=True,
        sharey=True,
    )
    largest = min(max(panel.largest for panel in maps), LARGEST)
    scale = Normalize(-largest, largest)
    for row, words in zip(axes, ("nominal simulation", "with the causes"), strict=False):
        for number, (ax, panel) in enumerate(zip(row, maps, strict=True)):
            after = ax in axes[-1] and with_after
            _draw(ax, shape, panel, scale, after=after)
            if not after:
                ax.set_title(panel.title.replace("$", r"\$"), **TITLE)
            if number == 0:
                ax.set_ylabel(f"{words}\ny (px)")
    for ax in axes[-1]:
        ax.set_xlabel("x (px)")
    return figure


def _draw(
    axes: Axes, shape: tuple[int, int], panel: DeviationMap, scale: Normalize, *, after: bool
) -> None:
    ny, nx = shape
    axes.add_patch(Rectangle((0, 0), nx, ny, fill=False, ec=GREY, lw=1))
    for y0, y1, x0, x1, before, later in panel.spots.tolist():
        (low, high), (left, wide) = _shown(y0, y1, ny), _shown(x0, x1, nx)
        sigma = later if after else before
        colour = DIVERGING(scale(sigma))
        axes.add_patch(Rectangle((left, low), wide, high, fc=colour, ec="white", lw=1))
        dark = abs(scale(sigma) - 0.5) > 0.33
        axes.text(
            left + wide / 2,
            low + high / 2,
            f"{sigma:.1f}".replace("-", "−"),
            ha="center",
            va="center",
            fontsize=9,
            color="white" if dark else INK,
        )
    axes.set(xlim=(-0.02 * nx, 1.02 * nx), ylim=(-0.02 * ny, 1.02 * ny), aspect="equal")


def _shown(first: float, last: float, whole: int) -> tuple[float, float]:
    """Start and size of a spot along an axis, enlarged to a visible size within the window."""
    size = max(last - first, SMALLEST * whole)
    return min(max((first + last - size) / 2, 0.0), whole - size), size
