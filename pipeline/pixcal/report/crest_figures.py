"""Crests and valleys of one fringe set, and the cost of the fit to them (paper, figures 16, 17)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm, Normalize
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from pixcal.model.arrays import F64, I64, Indices, Mask
from pixcal.report.colours import BLUE, GREY, INK, RED, SEQUENTIAL
from pixcal.report.drawing import WIDE, draw_blocks, finish, new_figure, note

LONG_TITLE = 10  # points, so that long numbers stay within their panel
CREST, VALLEY = RED, BLUE

# a part of a frame: electrons (y, x), NaN where bad, and (y, x) of its first pixel
Extract = tuple[NDArray[Any], tuple[int, int]]


@dataclass(frozen=True)
class CrestView:
    """Contents of the figure for one fringe set."""

    name: str
    frame: tuple[int, int]  # (y, x) size, px
    direction: tuple[float, float]  # along the fringe vector (x, y), any length
    # of ``crests.zarr``: the points (`x`, `y`, px, path `k`, `used`) and the maps of the cost
    arrays: Mapping[str, NDArray[Any]]
    # sigma_px, residual_px: (point,) errors, and fit minus path, across the fringes, px
    sigma_px: F64
    residual_px: F64
    fibres: tuple[F64, F64]  # (x, y) of fibres A and B projected on the detector, px
    extracts: tuple[Extract, ...]  # about the first and the last path
    best: tuple[float, float]  # distance and baseline of the minimum, mm
    distance_sigma: float  # mm
    distance_from_prior: bool  # whether the prior dominates this error

    @property
    def used(self) -> Mask:
        """Points (point,) that are not outliers."""
        return self.arrays["used"] > 0

    @cached_property
    def rotated(self) -> tuple[F64, F64]:
        """Coordinates (point,) across and along the fringes, px."""
        ux, uy = np.array(self.direction) / np.hypot(*self.direction)
        x, y = self.arrays["x"], self.arrays["y"]
        return ux * x + uy * y, ux * y - uy * x

    def on(self, k: int) -> Indices:
        """Numbers of the points on a path, in their order along it."""
        points = np.flatnonzero(self.arrays["k"] == k)
        return points[np.argsort(self.rotated[1][points])]


def crest_figure(view: CrestView) -> Figure:
    """Paths over the frame and stretched at its ends; the fit's cost about its minimum."""
    figure = new_figure(WIDE, 11.2)
    rows: Any = figure.subfigures(3, 1, height_ratios=[1.15, 1, 1])
    left, middle, right = rows[0].subplots(1, 3, width_ratios=[1, 1.7, 1])
    first, last = outermost(view.arrays["k"])
    _stretched(left, view, first, "first paths")
    _whole(middle, view, np.concatenate([first, last]))
    _stretched(right, view, last, "last paths")
    left, middle, right = rows[1].subplots(1, 3)
    for axes, extract, title in zip((left, middle), view.extracts, ("first", "last"), strict=True):
        _extract(axes, view, extract, f"frame about the {title} path")
    _pulls(right, view)
    left, middle, right = rows[2].subplots(1, 3)
    _map(rows[2], left, view, by_ratio=False)
    _map(rows[2], middle, view, by_ratio=True)
    _valley(right, view)
    return figure


def outermost(k: I64) -> tuple[I64, I64]:
    """Numbers of the paths to show, of the first and of the last."""
    # Paths through a corner of a rotated frame are too short to show their shape.
    paths, number = np.unique(k, return_counts=True)
    long = paths[number >= 0.5 * number.max()]
    shown = min(4, max(1, len(long) // 2))  # paper, figure 16
    return long[:shown], long[-shown:]


def _colour(k: int) -> str:
    return VALLEY if k % 2 else CREST


def _stretched(axes: Axes, view: CrestView, paths: I64, title: str) -> None:
    """Shapes of given paths side by side: position across the fringes less its mean."""
    across, along = view.rotated
    chosen = {int(k): (on := view.on(k))[view.used[on]] for k in paths}
    reach = max([float(np.ptp(across[on])) for on in chosen.values() if len(on)], default=0.0)
    noise = float(np.median(view.sigma_px)) or 1e-6
    spacing = max(1.3 * reach, 12 * noise)
    for number, (k, on) in enumerate(chosen.items()):
        at = across[on] - (across[on].mean() if len(on) else 0.0) + number * spacing
        axes.errorbar(
            at, along[on], xerr=view.sigma_px[on], fmt="o", color=_colour(k), ms=3, lw=0.8
        )
        axes.plot(at - view.residual_px[on], along[on], color=INK, lw=0.8)
    axes.set_xticks([n * spacing for n in range(len(chosen))], [str(k) for k in chosen])
    axes.set(xlabel="k", ylabel="along (px)", title=title)
    length = 10.0 ** np.floor(np.log10(max(0.6 * spacing, 1e-9)))
    low, high = axes.get_ylim()
    bar_y = low - 0.09 * (high - low)
    left = axes.get_xlim()[0]
    axes.plot([left, left + length], [bar_y, bar_y], color=INK, lw=3, solid_capstyle="butt")
    note(axes, f"{length:.3g} px", (left + length, bar_y), (5, 0), va="center", fontsize=8)
    finish(axes, grid=False)


def _whole(axes: Axes, view: CrestView, paths: I64) -> None:
    """The outermost paths over the whole frame, and the fibres before it."""
    ny, nx = view.frame
    axes.add_patch(Rectangle((-0.5, -0.5), nx, ny, fill=False, ec=GREY, lw=1))
    x, y = view.arrays["x"], view.arrays["y"]
    for k in paths:
        on = view.on(k)
        axes.plot(x[on], y[on], ".-", color=_colour(int(k)), ms=3, lw=0.7)
    for (x, y), label in zip(view.fibres, ("A", "B"), strict=True):
        axes.plot(x, y, "+", color=INK, ms=9)
        note(axes, f"$s_{label}$", (x, y), (4, 4), color=INK)
    title = f"{view.name}: outermost paths, fibres"
    finish(
        axes, grid=False, xlabel="x (px)", ylabel="y (px)", aspect="equal", title=title, anchor="C"
    )


def _extract(axes: Axes, view: CrestView, extract: Extract, title: str) -> None:
    image, (y0, x0) = extract
    ny, nx = image.shape
    draw_blocks(axes, image / 1e3, 1, (y0, x0), cmap="gray")
    x, y, every = (view.arrays[name] for name in ("x", "y", "k"))
    for k in np.unique(every):
        axes.plot(x[view.on(k)], y[view.on(k)], color=_colour(int(k)), lw=1.2)
    for parity, label in ((0, "crest"), (1, "valley")):
        on = every % 2 == parity
        axes.plot(x[on], y[on], "o", color=_colour(parity), ms=6, mec="white", mew=0.8, label=label)
    axes.set(xlim=(x0 - 0.5, x0 + nx - 0.5), ylim=(y0 - 0.5, y0 + ny - 0.5))
    axes.set(xlabel="x (px)", ylabel="y (px)", title=title)
    axes.legend(loc="upper right", fontsize=8, framealpha=0.9)


def _pulls(axes: Axes, view: CrestView) -> None:
    """Residuals in units of their errors, against a Gaussian."""
    pull = (view.residual_px / view.sigma_px)[view.used]
    edges = np.linspace(-5, 5, int(np.clip(np.sqrt(len(pull)), 10, 60)) + 1)
    axes.hist(pull, edges.tolist(), density=True, color=BLUE, alpha=0.35)
    at = np.linspace(-5, 5, 201)
    axes.plot(at, np.exp(-(at**2) / 2) / np.sqrt(2 * np.pi), color=INK, lw=1)
    title = f"{view.used.sum()} points, error {np.median(view.sigma_px):.1e} px"
    finish(axes, xlabel="residual / error", ylabel="density", title=title)
    axes.title.set_fontsize(LONG_TITLE)


def _map(figure: SubFigure, axes: Axes, view: CrestView, *, by_ratio: bool) -> None:
    arrays, (distance, baseline) = view.arrays, view.best
    middle = baseline / distance
    if by_ratio:
        values, cost = 1e6 * (arrays["ratio"] / middle - 1), arrays["cost_ratio"]
        label, at = "B/D − best (10⁻⁶)", 0.0
    else:
        values, cost, label, at = arrays["baseline"], arrays["cost_baseline"], "B (mm)", baseline
    reduced = np.maximum(cost, 1e-300) / max(int(view.used.sum()), 1)
    norm = LogNorm() if reduced.max() > 10 * reduced.min() else Normalize()
    drawn = axes.pcolormesh(
        arrays["distance"], values, reduced.T, norm=norm, cmap=SEQUENTIAL, shading="nearest"
    )
    if by_ratio:
        trace = 1e6 * (arrays["valley_ratio"] / middle - 1)
        axes.plot(arrays["distance"], trace, color="white", lw=1, ls="--")
    axes.plot(distance, at, "x", color=RED, ms=9, mew=2)
    title = f"cost per point, others {'refitted' if by_ratio else 'held'}"
    axes.set(xlabel="D (mm)", ylabel=label, ylim=(values[0], values[-1]), title=title)
    figure.colorbar(drawn, ax=axes, pad=0.02).minorticks_off()


def _valley(axes: Axes, view: CrestView) -> None:
    """Cost along the bottom of the valley, above its least."""
    above = view.arrays["valley_cost"] - view.arrays["valley_cost"].min()
    axes.plot(view.arrays["distance"], above, ".-", color=BLUE, lw=1)
    axes.axvline(view.best[0], color=RED, lw=1)
    axes.set_yscale("symlog", linthresh=1.0)
    axes.set_ylim(0, 1.3 * max(1.0, float(above.max())))
    error = view.distance_sigma
    decimals = max(0, 1 - int(np.floor(np.log10(error)))) if error > 0 else 3
    origin = ", nominal" if view.distance_from_prior else ""
    title = f"{view.best[0]:.{decimals}f} ± {error:.{decimals}f} mm{origin}"
    finish(axes, xlabel="D (mm)", ylabel="cost above minimum", title=title)
    axes.title.set_fontsize(LONG_TITLE)
