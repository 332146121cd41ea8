"""The figure of a comparison: pixel by pixel, by scale, by position, by column and row."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FixedLocator
from numpy.typing import NDArray

from pixcal.report.colours import BAND, BLUE, DIVERGING, GREEN, GREY, INK, RED, SEQUENTIAL
from pixcal.report.drawing import (
    WIDE,
    Unit,
    covered,
    finish,
    limits,
    new_figure,
    plain_ticks,
    unit_for,
)
from pixcal.report.text import SYMBOLS

F64 = NDArray[np.float64]

SHIFT_SPAN = 5.0  # sigma at which the colours of the map of differences end
MARKED = 200  # most disagreeing pixels that are marked
LINES = 1500  # most means of a profile that are drawn with an error each


@dataclass(frozen=True)
class ComponentView:
    """What the figure shows of one component."""

    name: str
    window: tuple[int, int]  # (y, x), px
    picture: NDArray[np.int64]  # (bin, bin) pixels by the second map (y) and the first (x)
    reach: float  # half width of the picture, px
    slope: float | None  # of the second against the first
    # `side_px`, `common`, `difference_px`, `expected_px` and so on
    scales: tuple[Mapping[str, Any], ...]
    side: int  # of the blocks, px
    # shift, scatter: (y, x) sigma of each block: of its mean difference, and of its pixels'
    # scatter
    shift: F64
    scatter: F64
    # columns, rows: (n,), (n,) float64: mean difference of each and its error, px
    columns: tuple[F64, F64]
    rows: tuple[F64, F64]
    far: tuple[tuple[int, int], ...]  # (y, x) of pixels that disagree


@dataclass(frozen=True)
class PairView:
    """Two sides, and their components."""

    numbers: tuple[int, int]
    labels: tuple[str, str]
    components: tuple[ComponentView, ...]


def compare_figure(view: PairView) -> Figure:
    """Two rows of panels for each component."""
    figure = new_figure(WIDE, 5.6 * len(view.components) + 0.4)
    first, second = view.labels
    figure.suptitle(f"1: {first}      2: {second}", fontsize=12)
    parts: Any = figure.subfigures(len(view.components), 1, squeeze=False)
    for part, component in zip(parts.ravel(), view.components, strict=True):
        top, below = part.subfigures(2, 1, height_ratios=[1.75, 1])
        left, middle, right = top.subplots(1, 3, width_ratios=[1, 1.35, 1.1])
        _against(left, component)
        _scales(middle, component)
        _places(top, right, component)
        one, two = below.subplots(1, 2)
        _profile(one, component.columns, "column x (px)", component)
        _profile(two, component.rows, "row y (px)", component)
    return figure


def _against(axes: Axes, view: ComponentView) -> None:
    """The second map against the first, and the line through them."""
    unit, symbol = unit_for([view.reach], "px"), SYMBOLS[view.name]
    end = view.reach * unit.factor
    shown, colours = np.ma.masked_equal(view.picture, 0), SEQUENTIAL.with_extremes(bad="w")
    axes.imshow(
        shown, origin="lower", extent=(-end, end, -end, end), cmap=colours,
        norm=LogNorm(1, max(2, int(view.picture.max()))), interpolation="nearest",
    )  # fmt: skip
    line = np.array([-end, end])
    axes.plot(line, line, color=GREY, ls="--", linewidth=1, label="equal")
    if view.slope is not None:
        axes.plot(
            line, view.slope * line, color=RED, linewidth=1.3, label=f"slope {view.slope:.3f}"
        )
    axes.set_xlim(-end, end)
    axes.set_ylim(-end, end)
    axes.set(
        xlabel=f"{symbol} in 1 ({unit.label})", ylabel=f"{symbol} in 2 ({unit.label})",
        title=f"{symbol}: pixels",
    )  # fmt: skip
    axes.legend(fontsize=8, loc="upper left", framealpha=0.9)


def _scales(axes: Axes, view: ComponentView) -> None:
    """Common part, difference and expected noise at each scale."""
    sizes = [s[key] for s in view.scales for key in ("difference_px", "expected_px")]
    unit = unit_for(sizes, "px")
    at = np.arange(len(view.scales), dtype=float)

    def line(values: Sequence[float]) -> F64:
        return np.array(values) * unit.factor

    expected = line([s["expected_px"] for s in view.scales])
    spread = line([s["expected_px"] * 2 * s["ratio_error"] for s in view.scales])
    axes.fill_between(
        at, np.maximum(expected - spread, 0), expected + spread, color=BAND, linewidth=0
    )
    axes.plot(at, expected, color=GREEN, linewidth=1.5, label="difference that noise gives, ±2σ")
    axes.plot(
        at, line([s["difference_px"] for s in view.scales]), "o-", color=BLUE, markersize=6,
        linewidth=1.2, label="difference",
    )  # fmt: skip
    significant = [_seen(s["common"]) for s in view.scales]
    common = line([s["common"]["px"] for s in view.scales])
    errors = line([s["common"]["error_px"] for s in view.scales])
    axes.errorbar(
        at[significant],
        common[significant],
        errors[significant],
        fmt="s",
        color=INK,
        markersize=6,
        label="common",
    )
    _limits(axes, at, view.scales, "common", INK, unit)
    _beyond(axes, at, view.scales, unit)
    axes.set_yscale("log")
    _round_off(axes, np.concatenate([expected, common[significant], line([s["difference_px"]
               for s in view.scales])]))  # fmt: skip
    names = [str(s["side_px"]) for s in view.scales]
    names[-1] = f"≥{names[-1]}"
    axes.xaxis.set_major_locator(FixedLocator(at.tolist()))
    axes.set_xticklabels(names)
    axes.set(xlabel="scale (px)", ylabel=f"rms at this scale ({unit.label})", title="by scale")
    finish(axes)
    axes.legend(fontsize=8, framealpha=0.9, loc="upper right")


def _seen(estimate: Mapping[str, float]) -> bool:
    return estimate["variance_px2"] > 2 * estimate["variance_error_px2"]


def _limits(
    axes: Axes, at: F64, scales: Sequence[Mapping[str, Any]], key: str, colour: str, unit: Unit
) -> None:
    """Upper limits as arrows, where nothing is significant."""
    for x, scale in zip(at, scales, strict=True):
        if not _seen(scale[key]):
            top = scale[key]["upper_px"] * unit.factor
            axes.plot(x, top, marker=r"$\downarrow$", color=colour, markersize=11, ls="none")


def _beyond(axes: Axes, at: F64, scales: Sequence[Mapping[str, Any]], unit: Unit) -> None:
    significant = [(x, s["beyond_noise"]) for x, s in zip(at, scales, strict=True)
             if s["significance"] > 3]  # fmt: skip
    if significant:
        places, values = zip(*significant, strict=True)
        axes.errorbar(
            places, [v["px"] * unit.factor for v in values],
            [v["error_px"] * unit.factor for v in values], fmt="D", color=RED, markersize=6,
            label="difference beyond noise",
        )  # fmt: skip


def _round_off(axes: Axes, values: F64) -> None:
    """Limits and plain numbers of a logarithmic axis that spans a decade or two."""
    good = values[np.isfinite(values) & (values > 0)]
    if len(good):
        axes.set_ylim(0.45 * good.min(), 3 * good.max() * (good.max() / good.min()) ** 0.22)
    plain_ticks(axes.yaxis, *axes.get_ylim())


def _places(figure: SubFigure, axes: Axes, view: ComponentView) -> None:
    """Blocks: by how many sigma their means differ; those whose pixels scatter are framed."""
    ny, nx = view.window
    drawn = axes.imshow(
        np.ma.masked_invalid(view.shift), origin="lower", cmap=DIVERGING, aspect="equal",
        vmin=-SHIFT_SPAN, vmax=SHIFT_SPAN, interpolation="nearest",
        extent=covered(view.shift.shape, view.side),
    )  # fmt: skip
    for y, x in np.argwhere(np.nan_to_num(view.scatter) > SHIFT_SPAN):
        corner = x * view.side - 0.5, y * view.side - 0.5
        axes.add_patch(_frame(corner, view.side))
    for y, x in view.far[:MARKED]:
        axes.plot(x, y, "o", color=INK, markersize=5, fillstyle="none", markeredgewidth=0.9)
    axes.set_xlim(-0.5, nx - 0.5)
    axes.set_ylim(-0.5, ny - 0.5)
    axes.set(xlabel="x (px)", ylabel="y (px)")
    notes = [f"blocks of {view.side} px"]
    if view.far:
        notes.append("○ pixels beyond 5σ")
    if (np.nan_to_num(view.scatter) > SHIFT_SPAN).any():
        notes.append("□ scatter beyond 5σ")
    axes.set_title("\n".join(notes), fontsize=12 if len(notes) == 1 else 9)
    bar = figure.colorbar(drawn, ax=axes, pad=0.03, shrink=0.85, extend="both")
    bar.set_label("mean difference (σ)")


def _frame(corner: tuple[float, float], side: int) -> Rectangle:
    return Rectangle(corner, side, side, fill=False, edgecolor=INK, linewidth=1.1)


def _profile(axes: Axes, profile: tuple[F64, F64], label: str, view: ComponentView) -> None:
    """Mean difference of every column or row, over what noise gives."""
    mean, error = profile
    known = error[np.isfinite(error)]
    unit = unit_for([np.median(known)] if len(known) else [], "px")
    at = np.arange(len(mean))
    band = 2 * error * unit.factor
    axes.fill_between(at, -band, band, color=BAND, linewidth=0, label="noise, ±2σ")
    width = 1.0 if len(at) <= LINES else 0.5
    axes.plot(at, mean * unit.factor, color=BLUE, linewidth=width, label="2 − 1")
    low, high = limits([mean * unit.factor, band, -band], 0.0)
    axes.set_ylim(low, high + 0.25 * (high - low))
    axes.set_xlim(-0.5, len(at) - 0.5)
    axes.set(xlabel=label, ylabel=f"mean Δ{SYMBOLS[view.name]}\n({unit.label})")
    finish(axes)
    axes.legend(fontsize=8, framealpha=0.9, loc="upper right", ncols=2)
