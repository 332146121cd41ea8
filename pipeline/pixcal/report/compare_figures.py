"""The figure of a comparison: pixel by pixel, by scale, by position, by column and row."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure, SubFigure
from matplotlib.patches import Rectangle

from pixcal.model.arrays import F64, I64
from pixcal.report.colours import BAND, BLUE, DIVERGING, GREEN, GREY, INK, RED, SEQUENTIAL
from pixcal.report.drawing import (
    WIDE,
    draw_blocks,
    finish,
    limits,
    new_figure,
    plain_ticks,
    unit_for,
)
from pixcal.report.text import SYMBOLS

SHIFT_SPAN = 5.0  # sigma at which the colours of the map of differences end
MARKED = 200  # most disagreeing pixels that are marked
LINES = 1500  # most means of a profile that are drawn with an error each


@dataclass(frozen=True)
class ComponentView:
    """Contents of the figure for one component."""

    name: str
    window: tuple[int, int]  # (y, x), px
    facts: Mapping[str, Any]  # of ``compare.json``
    picture: I64  # (bin, bin) pixels by the second map (y) and the first (x)
    reach: float  # half width of the picture, px
    shift: F64  # (y, x) sigma of each block: of its mean difference, and of its pixels' scatter
    scatter: F64
    # (n,), (n,) float64 of `columns` and `rows`: mean difference of each and its error, px
    profiles: Mapping[str, tuple[F64, F64]]
    far: Sequence[tuple[int, int]]  # (y, x) of pixels that disagree


def compare_figure(labels: tuple[str, str], components: Sequence[ComponentView]) -> Figure:
    """Two rows of panels for each component of two sides."""
    figure = new_figure(WIDE, 5.6 * len(components) + 0.4)
    figure.suptitle(f"1: {labels[0]}      2: {labels[1]}", fontsize=12)
    parts: Any = figure.subfigures(len(components), 1, squeeze=False)
    for part, component in zip(parts.ravel(), components, strict=True):
        top, below = part.subfigures(2, 1, height_ratios=[1.75, 1])
        left, middle, right = top.subplots(1, 3, width_ratios=[1, 1.35, 1.1])
        _against(left, component)
        _scales(middle, component)
        _places(top, right, component)
        places = {"columns": "column x (px)", "rows": "row y (px)"}
        for axes, (name, label) in zip(below.subplots(1, 2), places.items(), strict=True):
            _profile(axes, component.profiles[name], label, component)
    return figure


def _against(axes: Axes, view: ComponentView) -> None:
    """The second map against the first, and the line through them."""
    unit, symbol = unit_for([view.reach], "px"), SYMBOLS[view.name]
    end = view.reach * unit.factor
    shown, colours = np.ma.masked_equal(view.picture, 0), SEQUENTIAL.with_extremes(bad="w")
    norm = LogNorm(1, max(2, int(view.picture.max())))
    style: Any = {"origin": "lower", "interpolation": "nearest", "cmap": colours, "norm": norm}
    axes.imshow(shown, extent=(-end, end, -end, end), **style)
    line, slope = np.array([-end, end]), view.facts["slope"]
    axes.plot(line, line, color=GREY, ls="--", lw=1, label="equal")
    if slope is not None:
        axes.plot(line, slope * line, color=RED, lw=1.3, label=f"slope {slope:.3f}")
    axes.set(xlim=(-end, end), ylim=(-end, end), title=f"{symbol}: pixels")
    axes.set(xlabel=f"{symbol} in 1 ({unit.label})", ylabel=f"{symbol} in 2 ({unit.label})")
    axes.legend(fontsize=8, loc="upper left", framealpha=0.9)


def _scales(axes: Axes, view: ComponentView) -> None:
    """Common part, difference and expected noise at each scale."""
    scales = view.facts["scales"]
    unit = unit_for([s[key] for s in scales for key in ("difference_px", "expected_px")], "px")

    def line(key: str, of: str | None = None) -> F64:
        return np.array([(s[of] if of else s)[key] for s in scales], float) * unit.factor

    at = np.arange(len(scales), dtype=float)
    expected, difference = line("expected_px"), line("difference_px")
    spread = expected * 2 * np.array([s["ratio_error"] for s in scales])
    low, high = np.maximum(expected - spread, 0), expected + spread
    axes.fill_between(at, low, high, color=BAND, lw=0)
    axes.plot(at, expected, color=GREEN, lw=1.5, label="difference expected from noise, ±2σ")
    axes.plot(at, difference, "o-", color=BLUE, ms=6, lw=1.2, label="difference")
    common = line("px", "common")
    seen = np.array(
        [s["common"]["variance_px2"] > 2 * s["common"]["variance_error_px2"] for s in scales], bool
    )
    beyond = np.array([s["significance"] > 3 for s in scales], bool)
    # Upper limits as arrows, if not significant.
    top = line("upper_px", "common")[~seen]
    axes.plot(at[~seen], top, marker=r"$\downarrow$", color=INK, ms=11, ls="none")
    for which, key, marker, colour, label in (
        (seen, "common", "s", INK, "common"),
        (beyond, "beyond_noise", "D", RED, "difference beyond noise"),
    ):
        if which.any():
            style: Any = {"fmt": marker, "color": colour, "ms": 6, "label": label}
            axes.errorbar(at[which], line("px", key)[which], line("error_px", key)[which], **style)
    axes.set_yscale("log")
    # Limits and plain numbers of a logarithmic axis that spans a decade or two.
    values = np.concatenate([expected, common[seen], difference])
    good = values[np.isfinite(values) & (values > 0)]
    if len(good):
        axes.set_ylim(0.45 * good.min(), 3 * good.max() * (good.max() / good.min()) ** 0.22)
    plain_ticks(axes.yaxis, *axes.get_ylim())
    names = [str(s["side_px"]) for s in scales]
    axes.set_xticks(at, [*names[:-1], f"≥{names[-1]}"])
    axes.set(xlabel="scale (px)", ylabel=f"rms at this scale ({unit.label})", title="by scale")
    finish(axes, legend="upper right")


def _places(figure: SubFigure, axes: Axes, view: ComponentView) -> None:
    """Significance of the mean difference of each block; blocks with excess scatter are framed."""
    (ny, nx), side = view.window, view.facts["blocks"]["side_px"]
    scattered = np.argwhere(np.nan_to_num(view.scatter) > SHIFT_SPAN)
    drawn = draw_blocks(
        axes, view.shift, side, cmap=DIVERGING, vmin=-SHIFT_SPAN, vmax=SHIFT_SPAN, aspect="equal"
    )
    for y, x in scattered:
        corner = x * side - 0.5, y * side - 0.5
        axes.add_patch(Rectangle(corner, side, side, fill=False, ec=INK, lw=1.1))
    for y, x in view.far[:MARKED]:
        axes.plot(x, y, "o", color=INK, ms=5, fillstyle="none", mew=0.9)
    axes.set(xlabel="x (px)", ylabel="y (px)", xlim=(-0.5, nx - 0.5), ylim=(-0.5, ny - 0.5))
    notes = [f"blocks of {side} px"]
    if view.far:
        notes.append("○ pixels beyond 5σ")
    if len(scattered):
        notes.append("□ scatter beyond 5σ")
    axes.set_title("\n".join(notes), fontsize=12 if len(notes) == 1 else 9)
    bar = figure.colorbar(drawn, ax=axes, pad=0.03, shrink=0.85, extend="both")
    bar.set_label("mean difference (σ)")


def _profile(axes: Axes, profile: tuple[F64, F64], label: str, view: ComponentView) -> None:
    """Mean difference of every column or row, over that expected from noise."""
    mean, error = profile
    known = error[np.isfinite(error)]
    unit = unit_for([np.median(known)] if len(known) else [], "px")
    at = np.arange(len(mean))
    band = 2 * error * unit.factor
    axes.fill_between(at, -band, band, color=BAND, lw=0, label="noise, ±2σ")
    width = 1.0 if len(at) <= LINES else 0.5
    axes.plot(at, mean * unit.factor, color=BLUE, lw=width, label="2 − 1")
    low, high = limits([mean * unit.factor, band, -band], 0.0)
    axes.set(xlim=(-0.5, len(at) - 0.5), ylim=(low, high + 0.25 * (high - low)))
    finish(axes, xlabel=label, ylabel=f"mean Δ{SYMBOLS[view.name]}\n({unit.label})")
    axes.legend(fontsize=8, framealpha=0.9, loc="upper right", ncols=2)
