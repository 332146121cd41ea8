"""Figures of one fringe set: its frames in time, its residuals, its Allan deviation."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy.typing import NDArray
from scipy.special import gammaln, xlogy

from pixcal.report.colours import BAR, BLUE, GREEN, GREY, INK, RED
from pixcal.report.contents import SetContents
from pixcal.report.drawing import (
    WIDE,
    add_bar,
    axes_grid,
    block_note,
    draw_map,
    finish,
    limits,
    span_scale,
    unit_for,
)
from pixcal.report.summary import MapSummary
from pixcal.report.text import with_error

F64 = NDArray[np.float64]

POINTS = 6000  # most frames that are drawn one by one; of longer runs, every n-th


def temporal(fringes: SetContents) -> Figure:
    """Intensity, visibility, phase and (when it is free) fringe vector of each frame."""
    series = fringes.series
    step = -(-len(series.time) // POINTS)
    time, clock = _clock(series.time[::step])
    level = float(np.nanmean(series.B)) or 1.0
    contrast = fringes.visibility.median * series.A / np.where(series.B != 0, series.B, np.nan)
    rows: list[tuple[str, F64, tuple[float, float] | None]] = [
        ("B − mean (%)", 100 * (series.B / level - 1), None),
        ("visibility", contrast, None),
        ("φ (rad)", np.mod(series.phi, 2 * np.pi), (0.0, 2 * np.pi)),
    ]
    if series.moving:
        unit = unit_for(np.concatenate([series.dkx, series.dky]), "rad/px")
        rows.append((f"δkx ({unit.label})", series.dkx * unit.factor, None))
        rows.append((f"δky ({unit.label})", series.dky * unit.factor, None))
    figure, grid = axes_grid(
        (WIDE, 1.75 * len(rows) + 0.5), len(rows), 2, left=0.95, beside=0.25, between=0.25,
        width_ratios=[4, 1], sharex="col", sharey="row",
    )  # fmt: skip
    for (left, right), (label, values, bounds) in zip(grid, rows, strict=True):
        low, high = bounds or limits([values], 0.0)
        left.plot(
            time, values[::step], "o", color=BLUE, markersize=_dot(len(time)), markeredgewidth=0
        )
        left.set_ylabel(label)
        left.set_ylim(low, high)
        _coverage(right, values, (low, high), uniform=bounds is not None)
        finish(left)
        finish(right)
        if bounds:
            left.set_yticks([0, np.pi, 2 * np.pi], ["0", "π", "2π"])
    grid[-1][0].set_xlabel(f"time ({clock})" + (f", every {step}th frame" if step > 1 else ""))
    grid[-1][1].set_xlabel("frames per bin")
    return figure


def _coverage(axes: Axes, values: F64, bounds: tuple[float, float], *, uniform: bool) -> None:
    finite = values[np.isfinite(values)]
    number = 24
    count, edges = np.histogram(finite, number, range=bounds)
    axes.stairs(count, edges, fill=True, color=BAR, edgecolor=BLUE, orientation="horizontal")
    if uniform:
        mean = len(finite) / number
        axes.axvspan(
            mean - 2 * np.sqrt(mean), mean + 2 * np.sqrt(mean), color=GREY, alpha=0.25, linewidth=0
        )
        axes.axvline(mean, color=INK, linewidth=1, ls="--")


def _clock(time: F64) -> tuple[F64, str]:
    """Times in a suitable unit."""
    span = float(np.ptp(time)) if len(time) else 0.0
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if span > 3 * length:
            return time / length, unit
    return time, "s"


def _dot(frames: int) -> float:
    return float(np.clip(70 / np.sqrt(max(frames, 1)), 1.2, 4.5))


def residuals(fringes: SetContents) -> Figure:
    """Map of the reduced chi-square, and its histogram against the expected distribution."""
    figure, ((left, right),) = axes_grid((WIDE, 4.4), 1, 2, beside=1.95, width_ratios=[1, 1.15])
    summary = fringes.chi2
    scale = span_scale(summary.image)
    drawn = draw_map(left, summary, scale)
    ny, nx = summary.shape
    if max(ny, nx) <= 6 * min(ny, nx):
        left.set_aspect("equal")
    left.set(xlabel="x (px)", ylabel="y (px)")
    note = block_note(summary)
    label = f"reduced χ²\n{note}" if note else "reduced χ²"
    add_bar(figure, left, drawn, label, scale.beyond)
    _chi2_histogram(right, summary, fringes.facts)
    return figure


def _chi2_histogram(axes: Axes, summary: MapSummary, facts: dict[str, Any]) -> None:
    freedom = max(int(facts["frames"]) - 3, 1)
    noise = float(facts.get("chi2_reduced") or 1.0)
    chance = float(np.sqrt(2 / freedom))
    values = summary.sample.astype(float)
    low = max(0.0, min(1, noise) * (1 - 6 * chance))
    high = max(1, noise) * (1 + 8 * chance)
    edges = np.linspace(low, high, int(np.clip(np.sqrt(max(len(values), 1)) / 1.5, 15, 100)))
    count, _ = np.histogram(values, edges)
    axes.stairs(count, edges, fill=True, color=BAR, edgecolor=BLUE, label="pixels")
    at = np.linspace(max(low, 1e-6), high, 500)
    per_bin = len(values) * (edges[1] - edges[0])
    axes.plot(
        at, per_bin * _reduced_chi2_density(at, freedom), color=INK, linewidth=1.3,
        ls="--", label=f"χ² law, {freedom} degrees of freedom",
    )  # fmt: skip
    scaled = per_bin / noise * _reduced_chi2_density(at / noise, freedom)
    axes.plot(at, scaled, color=RED, linewidth=1.5, label=f"the same × {noise:.4f}")
    outside = int((values > high).sum())
    if outside:
        axes.annotate(
            f"{outside} beyond →", (0.99, 0.55), xycoords="axes fraction", ha="right", fontsize=9.5
        )
    axes.set_xlim(low, high)
    axes.set_ylim(0, 1.45 * max(float(count.max()), 1.0))
    axes.set(xlabel="reduced χ² of a pixel", ylabel="pixels per bin")
    finish(axes)
    axes.legend(fontsize=9, loc="upper right", framealpha=0.9)


def allan(name: str, measured: dict[str, Any], facts: dict[str, Any] | None) -> Figure:
    """Allan deviation against averaging length, and its ratio to the square-root law.

    Parameters
    ----------
    name : str
        Of the set.
    measured : dict
        Its entry in ``allan.json``.
    facts : dict, optional
        Its entry in ``fit.json``, for the Cramér-Rao bound.
    """
    frames, adev, low, high, white, seconds = (
        _floats(measured.get(key))
        for key in (
            "frames", "adev_px", "adev_lo_px", "adev_hi_px", "white_expected_px", "seconds",
        )
    )  # fmt: skip
    unit = unit_for(adev, "px")
    bars = np.nan_to_num(np.abs(np.stack([adev - low, high - adev])))
    figure, ((axes,), (below,)) = axes_grid(
        (WIDE, 6.2), 2, 1, top=0.65, between=0.2, sharex=True, height_ratios=[3, 1.1]
    )
    look = {"fmt": "o", "color": BLUE, "elinewidth": 1.3, "capsize": 3, "markersize": 6}
    axes.errorbar(
        frames, adev * unit.factor, bars * unit.factor, zorder=3, **look,
        label="measured" + _slope_label(measured),
    )  # fmt: skip
    axes.plot(
        frames, white * unit.factor, color=GREEN, linewidth=1.5, label="square-root law from σ"
    )
    below.axhline(1, color=GREEN, linewidth=1.5)
    if facts and facts.get("crb_median_px"):
        bound = facts["crb_median_px"] * np.sqrt(facts["frames"] / frames)
        style = {"color": RED, "ls": "--", "linewidth": 1.5}
        axes.plot(frames, bound * unit.factor, label="Cramér–Rao bound", **style)
        below.plot(frames, bound / white, **style)
    below.errorbar(frames, adev / white, bars / white, **look)
    if measured.get("knee_frames"):
        for each in (axes, below):
            each.axvline(measured["knee_frames"], color=INK, ls=":", linewidth=1.4)
        axes.annotate(
            f" knee: {measured['knee_frames']:.0f} frames", (measured["knee_frames"], 0.04),
            xycoords=("data", "axes fraction"), fontsize=10,
        )  # fmt: skip
    _log_axes(axes, below)
    shown = frames[:: -(-len(frames) // 9)]
    below.set_xticks(shown, [f"{v:.0f}" for v in shown])
    axes.set_ylabel(f"Allan deviation of δ ({unit.label})")
    below.set(xlabel="averaging length (frames)", ylabel="measured / law")
    _add_clock(axes, frames, seconds)
    axes.legend(fontsize=10, framealpha=0.9, title=f"set {name}")
    return figure


def _slope_label(measured: dict[str, Any]) -> str:
    slope, error = measured.get("slope"), measured.get("slope_err")
    return "" if slope is None else f", slope {with_error(slope, error)}"


def _log_axes(axes: Axes, below: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    _plain_ticks(axes.yaxis)
    axes.xaxis.set_minor_locator(NullLocator())
    finish(axes)
    finish(below)


def _plain_ticks(axis: Axis) -> None:
    """Ticks at 1, 2 and 5 of each decade, written as plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
    axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    axis.set_minor_formatter(NullFormatter())


def _add_clock(axes: Axes, frames: F64, seconds: F64) -> None:
    """The same axis in seconds, on top."""
    if not len(seconds) or not seconds[0] > 0:
        return
    pace = float(seconds[0] / frames[0])
    clock = (lambda f: np.asarray(f) * pace, lambda s: np.asarray(s) / pace)
    top = axes.secondary_xaxis("top", functions=clock)
    _plain_ticks(top.xaxis)
    top.set_xlabel("averaging time (s)")


def _floats(values: Any) -> F64:
    return np.array([np.nan if v is None else v for v in values or ()], dtype=float)


def _reduced_chi2_density(at: NDArray[np.float64], freedom: int) -> NDArray[np.float64]:
    """Probability density of a chi-square of many degrees of freedom over their number."""
    half = freedom / 2
    return np.asarray(half * np.exp(xlogy(half - 1, half * at) - half * at - gammaln(half)))
