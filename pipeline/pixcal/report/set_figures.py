"""Figures of the fringe sets: their frames in time, residuals, and Allan deviations."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from scipy.special import gammaln, xlogy

from pixcal.model.arrays import F64
from pixcal.report.colours import BAR, BLUE, GREY, INK, LINES
from pixcal.report.contents import SetContents
from pixcal.report.drawing import (
    TITLE,
    WIDE,
    Unit,
    axes_grid,
    finish,
    limits,
    plain_ticks,
    second_axis,
    unit_for,
)
from pixcal.report.text import with_error

Facts = Mapping[str, Any]

ALLAN_COLUMNS = ("frames", "seconds", "adev_px", "adev_lo_px", "adev_hi_px", "white_expected_px")
PHASE_BINS = 24
TURN = ("0", "π", "2π")  # labels of a phase axis


def temporal(sets: Sequence[SetContents]) -> Figure:
    """Parameters of each frame, a column for each set, with histograms of the phase below."""
    moving = any(s.moving for s in sets)
    rows = 5 if moving else 3
    margins = {"left": 0.95, "top": 0.35, "beside": 0.95, "between": 0.5}
    figure, grid = axes_grid((WIDE, 1.55 * (rows + 1) + 1.2), rows + 1, len(sets), **margins)
    for column, fringes in zip(grid.T, sets, strict=True):
        step = -(-len(fringes.series["time"]) // 6000)  # every n-th frame of longer runs
        time, clock = _clock(fringes.series["time"][::step])
        for axes, (label, values) in zip(column, _parameters(fringes, moving), strict=False):
            size = float(np.clip(70 / np.sqrt(max(len(time), 1)), 1.2, 4.5))
            drawing: Any = {"ms": size, "mew": 0}
            axes.plot(time, values[::step], "o", color=BLUE, **drawing)
            finish(axes, ylabel=label, ylim=limits([values], 0.0))
        for axes in column[: rows - 1]:
            axes.tick_params(labelbottom=False)
        column[0].set_title(f"set {fringes.name}", **TITLE)
        column[2].set(ylim=(0, 2 * np.pi), yticks=[0, np.pi, 2 * np.pi], yticklabels=TURN)
        column[rows - 1].set_xlabel(
            f"time ({clock})" + (f", every {step}th frame" if step > 1 else "")
        )
        _phases(column[-1], np.mod(fringes.series["phi"], 2 * np.pi))
    return figure


def _parameters(fringes: SetContents, moving: bool) -> list[tuple[str, F64]]:
    series = fringes.series
    mean, amplitude = series["B"], series["A"]
    level = float(np.nanmean(mean)) or 1.0
    contrast = fringes.visibility.median * amplitude / np.where(mean != 0, mean, np.nan)
    rows = [
        ("B − mean (%)", 100 * (mean / level - 1)),
        ("visibility", contrast),
        ("φ (rad)", np.mod(series["phi"], 2 * np.pi)),
    ]
    if moving:
        unit = unit_for(np.concatenate([series["dkx"], series["dky"]]), "rad/px")
        rows.append((f"δkx ({unit.label})", series["dkx"] * unit.factor))
        rows.append((f"δky ({unit.label})", series["dky"] * unit.factor))
    return rows


def _phases(axes: Axes, phi: F64) -> None:
    """Histogram of the phase, with a uniform distribution for comparison."""
    finite = phi[np.isfinite(phi)]
    count, edges = np.histogram(finite, PHASE_BINS, range=(0, 2 * np.pi))
    mean = len(finite) / PHASE_BINS
    chance = 2 * np.sqrt(mean)
    axes.axhspan(mean - chance, mean + chance, color=GREY, alpha=0.25, lw=0)
    axes.stairs(count, edges, fill=True, color=BAR, ec=BLUE)
    axes.axhline(mean, color=INK, lw=1, ls="--")
    axes.set(xlim=(0, 2 * np.pi), xticks=[0, np.pi, 2 * np.pi], xticklabels=TURN)
    finish(axes, xlabel="φ (rad)", ylabel="frames\nper bin")


def _clock(time: F64) -> tuple[F64, str]:
    span = float(np.ptp(time)) if len(time) else 0.0
    for unit, length in (("h", 3600.0), ("min", 60.0)):
        if span > 3 * length:
            return time / length, unit
    return time, "s"


def chi2(sets: Sequence[SetContents]) -> Figure:
    """Histograms of the reduced chi-square against the expected distributions."""
    figure, ((axes,),) = axes_grid((WIDE, 3.8))
    ends = np.array(
        [_histogram(axes, s, LINES[n % len(LINES)]) for n, s in enumerate(sets)]
    )  # (set, 3): lowest, highest, tallest
    axes.set(xlim=(ends[:, 0].min(), ends[:, 1].max()), ylim=(0, 1.45 * ends[:, 2].max()))
    finish(axes, legend="upper right", xlabel="reduced χ² of a pixel", ylabel="pixels per bin")
    return figure


def _histogram(axes: Axes, fringes: SetContents, colour: str) -> tuple[float, float, float]:
    """Histogram of a set; ends of its axis and height of its largest bin."""
    freedom = max(int(fringes.facts["frames"]) - 3, 1)
    noise = float(fringes.facts.get("chi2_reduced") or 1.0)
    chance = float(np.sqrt(2 / freedom))
    values = fringes.chi2.sample.astype(float)
    low, high = max(0.0, min(1, noise) * (1 - 6 * chance)), max(1, noise) * (1 + 8 * chance)
    edges = np.linspace(low, high, int(np.clip(np.sqrt(max(len(values), 1)) / 1.5, 15, 100)))
    count, _ = np.histogram(values, edges)
    outside = int((values > high).sum())
    label = f"{fringes.name}: pixels" + (f", {outside} beyond {high:.2f}" if outside else "")
    axes.stairs(count, edges, color=colour, lw=1.5, label=label)
    at = np.linspace(max(low, 1e-6), high, 500)
    per_bin = len(values) * (edges[1] - edges[0])
    for scale, style, name in (
        (1.0, "--", f"χ² law, {freedom} degrees of freedom"),
        (noise, "-", f"the same × {noise:.4f}"),
    ):
        law = per_bin / scale * _reduced_chi2_density(at / scale, freedom)
        axes.plot(at, law, color=colour, lw=1.0, ls=style, label=name)
    return low, high, max(float(count.max()), 1.0)


def allan(sets: Sequence[SetContents]) -> Figure:
    """Allan deviations against averaging length, and their ratios to the square-root law."""
    return allan_figure({s.name: (s.allan or {}, s.facts) for s in sets})


def allan_figure(sets: Mapping[str, tuple[Facts, Facts]]) -> Figure:
    """Allan deviations and their ratios to the square-root law, of ``allan.json``."""
    figure, ((axes,), (below,)) = axes_grid(
        (WIDE, 6.2), 2, 1, top=0.65, between=0.2, sharex=True, height_ratios=[3, 1.1]
    )
    curves = {
        # None (no value) becomes NaN.
        name: {key: np.array(measured.get(key) or (), dtype=float) for key in ALLAN_COLUMNS}
        for name, (measured, _) in sets.items()
    }
    unit = unit_for(np.concatenate([c["adev_px"] for c in curves.values()]), "px")
    for n, (name, curve) in enumerate(curves.items()):
        aside = 1.012 ** (n - (len(sets) - 1) / 2)
        _allan_lines((axes, below), name, sets[name], curve, unit, LINES[n % len(LINES)], aside)
    below.axhline(1, color=GREY, lw=1.5)
    axes.set(xscale="log", yscale="log")
    axes.xaxis.set_minor_locator(NullLocator())
    plain_ticks(axes.yaxis, *axes.get_ylim())
    frames = np.unique(np.concatenate([c["frames"] for c in curves.values()]))
    shown = frames[:: -(-len(frames) // 9)]
    below.set_xticks(shown, [f"{v:.0f}" for v in shown])
    finish(axes, legend="upper right", ylabel=f"Allan deviation of δ ({unit.label})")
    finish(below, xlabel="averaging length (frames)", ylabel="measured / law")
    first = next(iter(curves.values()))
    _add_clock(axes, first["frames"], first["seconds"])
    return figure


def _allan_lines(
    where: tuple[Axes, Axes],
    name: str,
    of_set: tuple[Facts, Facts],
    curve: Mapping[str, F64],
    unit: Unit,
    color: str,
    aside: float,
) -> None:
    """One set: points, square-root law, bound, knee; ``aside`` shifts its points."""
    (axes, below), (measured, facts) = where, of_set
    frames, adev, white = curve["frames"], curve["adev_px"], curve["white_expected_px"]
    low, high = curve["adev_lo_px"], curve["adev_hi_px"]
    bars = np.nan_to_num(np.abs(np.stack([adev - low, high - adev])))
    drawing: Any = {"fmt": "o", "color": color, "elinewidth": 1.3, "capsize": 3, "ms": 6}
    label = f"{name}: measured"
    if (slope := measured.get("slope")) is not None:
        label += f", slope {with_error(slope, measured.get('slope_err'))}"
    at = frames * aside
    axes.errorbar(at, adev * unit.factor, bars * unit.factor, zorder=3, label=label, **drawing)
    below.errorbar(at, adev / white, bars / white, **drawing)
    law: dict[str, Any] = {"color": color, "lw": 1.5}
    first = color == LINES[0]  # the legend explains line styles once
    axes.plot(frames, white * unit.factor, label="square-root law from σ" if first else None, **law)
    if facts.get("crb_median_px"):
        bound = facts["crb_median_px"] * np.sqrt(facts["frames"] / frames)
        law |= {"ls": "--"}
        axes.plot(frames, bound * unit.factor, label="Cramér–Rao bound" if first else None, **law)
        below.plot(frames, bound / white, **law)
    if knee := measured.get("knee_frames"):
        for each in (axes, below):
            each.axvline(knee, color=color, ls=":", lw=1.4)
        style: Any = {"xycoords": ("data", "axes fraction"), "fontsize": 10, "color": color}
        axes.annotate(f" knee: {knee:.0f} frames", (knee, 0.04), **style)


def _add_clock(axes: Axes, frames: F64, seconds: F64) -> None:
    """The same axis in seconds, on top."""
    if not len(seconds) or not seconds[0] > 0:
        return
    pace = float(seconds[0] / frames[0])
    top = second_axis(axes, "top", pace)
    low, high = axes.get_xlim()
    plain_ticks(top.xaxis, pace * low, pace * high, most=9)
    top.set_xlabel("averaging time (s)")


def _reduced_chi2_density(at: F64, freedom: int) -> F64:
    """Probability density of a chi-square of many degrees of freedom over their number."""
    half = freedom / 2
    return np.asarray(half * np.exp(xlogy(half - 1, half * at) - half * at - gammaln(half)))
