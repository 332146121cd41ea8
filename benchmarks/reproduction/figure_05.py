"""Figure 5: straight and hyperbolic fringes at the edges of a large detector."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy.io import fits
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pixcal.kernels.optics import paraxial_vector
from pixcal.kernels.scene import geometry
from pixcal.model.bench import Bench
from pixcal.report.colours import BLUE, GREY, INK, RED
from pixcal.report.drawing import WIDE, finish, new_figure, png
from pixcal.report.text import number
from reproduction.lab import Lab
from reproduction.outcome import Outcome, Row

F64 = NDArray[np.float64]

SHAPES = ("straight", "exact")


@dataclass(frozen=True)
class Edge:
    """Columns at one side of the detector."""

    first: int  # the first of them on the detector
    frames: dict[str, NDArray[Any]]  # samples (y, x) of a frame by shape of the fringes
    bend: F64  # (y,) how far the exact fringes lie from the straight ones, px
    expected: F64  # (y,) the same from the leading order of the optical path, px


def row_phases(frame: NDArray[Any], k: float) -> F64:
    """Phase (y,) of fringes of a known vector along x in each row, rad, at the first column."""
    x = np.arange(frame.shape[1])
    basis = np.stack([np.ones(len(x)), np.cos(k * x), np.sin(k * x)], axis=1)
    _, c, s = np.linalg.pinv(basis) @ frame.T.astype(float)
    return np.asarray(np.arctan2(c, s))


def leading_bend(bench: Bench, x: float) -> F64:
    """``-q_x (q² + B²/4) / (2 D²)`` (y,) at a column of the chip, px: apparent shift of fringes.

    The path difference (paper, equation 3) to the order after the paraxial one (equation 4), q from
    the foot of the fibres' centre. The part with B² only makes the interfringe longer.
    """
    pitch, (ny, nx) = bench.detector.pitch_um * 1e-3, bench.detector.chip_shape
    qx, qy = (x - (nx - 1) / 2) * pitch, (np.arange(ny) - (ny - 1) / 2) * pitch
    baseline = float(np.hypot(*bench.frames.fringes[0].baseline_mm))
    square = qx**2 + qy**2 + baseline**2 / 4
    return np.asarray(-qx * square / (2 * bench.optics.distance_mm**2) / pitch)


def measure(lab: Lab, bench: Bench) -> list[Edge]:
    """Both edges of the chip."""
    found = []
    width, columns = bench.detector.shape[1], bench.detector.chip_shape[1]
    k = paraxial_vector(geometry(bench, 0))[0]
    for name, first in (("first", 0), ("last", columns - width)):
        frames = {}
        for shape in SHAPES:
            cut = replace(
                bench,
                detector=replace(bench.detector, origin_px=(0, first)),
                effects=bench.effects if shape == "exact" else {},
            )
            scene = lab.scene(f"figure-05/{name}-{shape}", cut)
            (file,) = (scene.folder / "acq" / bench.frames.fringes[0].name).glob("*.fits")
            frames[shape] = np.asarray(fits.getdata(file))
        away = row_phases(frames["exact"], k) - row_phases(frames["straight"], k)
        bend = np.angle(np.exp(1j * away)) / k
        found.append(Edge(first, frames, bend, leading_bend(bench, first + (width - 1) / 2)))
    return found


def draw(edges: list[Edge]) -> Figure:
    """Frames at both edges, and the distance between straight and hyperbolic fringes."""
    figure = new_figure(WIDE, 5.0)
    axes = figure.subplots(1, 5, width_ratios=[1, 1, 1, 1, 2.2])
    panels = [(edge, shape) for edge in edges for shape in SHAPES]
    for panel, (edge, shape) in zip(axes, panels, strict=False):
        _frame(panel, edge, shape)
    axes[0].set_ylabel("y (px)")
    for panel in axes[1:4]:
        panel.set_yticklabels([])
    last = axes[4]
    for edge, colour, name in zip(edges, (BLUE, RED), ("first", "last"), strict=True):
        rows = np.arange(len(edge.bend))
        last.plot(edge.bend, rows, color=colour, linewidth=4, alpha=0.35, label=f"{name} columns")
        last.plot(edge.expected, rows, color=INK, linewidth=1)
    last.plot([], [], color=INK, linewidth=1, label="next order")
    last.axvline(0, color=GREY, linewidth=1, ls="--")
    last.set(xlabel="hyperbolic − straight (px)", ylim=(0, len(edges[0].bend)))
    last.legend(fontsize=8.5, loc="center")
    last.yaxis.set_tick_params(labelleft=False)
    finish(last)
    return figure


def _frame(axes: Axes, edge: Edge, shape: str) -> None:
    frame = edge.frames[shape]
    ny, nx = frame.shape
    axes.imshow(
        frame,
        cmap="gray",
        aspect="auto",
        origin="lower",
        interpolation="nearest",
        extent=(edge.first - 0.5, edge.first + nx - 0.5, -0.5, ny - 0.5),
    )
    axes.set_title("hyperbolic" if shape == "exact" else "straight", fontsize=10)
    axes.set_xlabel("x (px)")
    axes.set_xticks([edge.first, edge.first + nx - 1])
    axes.tick_params(labelsize=8)


def make(lab: Lab) -> Outcome:
    """Simulate, measure and draw."""
    bench = lab.bench("figure-05")
    edges = measure(lab, bench)
    corner = max(float(np.abs(edge.bend).max()) for edge in edges)
    middle = float(np.mean([abs(edge.bend[len(edge.bend) // 2]) for edge in edges]))
    leading = float(np.abs(edges[0].expected).max())
    period = 2 * np.pi / paraxial_vector(geometry(bench, 0))[0]
    return Outcome(
        figure="5",
        title="Straight and hyperbolic fringes",
        run=f"One noise-free frame of {bench.detector.shape[1]} columns at each edge of a detector "
        f"with {number(bench.detector.chip_shape[0])} rows, with straight and with exact fringes.",
        caption="Left: the same columns with straight and with hyperbolic fringes. Right: their "
        "distance in each row, measured in the frames, over the next order of the path difference "
        "(black).",
        rows=(
            Row("fringe period of 6 mm by equation 4", f"{number(period, 4)} px", "periods"),
            Row("their distance at the edge, middle row", f"{number(middle)} px", "curved"),
            Row("distance in a corner", f"{number(corner)} px"),
            Row("the same by −qₓ (q² + B²/4) / 2D²", f"{number(leading)} px"),
            Row(
                "error of the straight model",
                f"{number(corner / period, 2)} fringes in the corners",
                "straight",
            ),
        ),
        difference="The shape agrees. The distance in pixels hardly depends on the baseline. "
        "The paper gives 7 px for the shortest period, but its equation 4 gives "
        f"{number(period, 2)} "
        "px.",
        numbers={
            "bend_edge_px": middle,
            "bend_corner_px": corner,
            "leading_order_corner_px": leading,
            "interfringe_px": period,
        },
        picture=png(draw(edges)),
    )
