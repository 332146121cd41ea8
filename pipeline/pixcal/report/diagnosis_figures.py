"""Figures of a diagnosis: gap by domain, share closed by each cause, curves of statistics."""

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixcal.model.arrays import F64
from pixcal.report.colours import BAND, BLUE, GREY, INK, RED
from pixcal.report.contents import DiagnosisContents
from pixcal.report.diagnosis_words import DETECTOR, axis_label, effect_title, percent, places
from pixcal.report.drawing import TITLE, WIDE, Unit, axes_grid, finish, note, plain_ticks, unit_for
from pixcal.report.text import unit

ROOM = 50  # letters that fit below a panel; longer tick labels are rotated
LABEL, NAME = 34, 20  # most letters of an axis label, and of a tick label
SPAN = 12.0  # ratio of values above which an axis is logarithmic
QUIET = 5.0  # least half height of the axis of deviations, sigma
ORDER = ("measured", "nominal simulation", "with the causes")
BESIDE = 0.2  # offset of simulations from the data, if abscissae are names


@dataclass(frozen=True)
class Bar:
    """A share of the gap, before and after, and the interval of the residual if known."""

    name: str
    before: float
    after: float
    interval: tuple[float, float] | None = None


def gap(result: DiagnosisContents) -> Figure:
    """The gap by domain, differences that appear only with the causes, and share of each cause."""
    facts, causes = result.facts["gap"], result.facts["causes"]
    low, high = facts["interval"]
    whole = Bar("all", facts["total"], facts["after"], (low, high))
    parts = [Bar(d, before, after) for d, (before, after) in facts.get("domains", {}).items()]
    rest = facts["after"] - sum(b.after for b in parts)
    if causes and parts and rest > 0.001:
        parts.append(Bar("new differences due to the causes", 0.0, rest))
    titles = {effect_title(result, cause["effect"]): cause for cause in causes}
    return gap_figure([whole, *sorted(parts, key=lambda b: -b.before)], titles)


def gap_figure(bars: Sequence[Bar], causes: Mapping[str, Mapping[str, Any]]) -> Figure:
    """The gap by domain, before and after, and beside it the share closed by each cause."""
    size = WIDE, 1.6 + 0.5 * max(len(bars), len(causes))
    margin = _room(_domain_names(bars))
    if not causes:
        figure, ((axes,),) = axes_grid(size, left=margin, top=0.35)
        _bars(axes, bars, with_after=False)
        return figure
    margins = {"left": margin, "bottom": 0.85, "top": 0.35, "beside": _room(_cause_names(causes))}
    figure, ((left, right),) = axes_grid(size, 1, 2, **margins, width_ratios=[1.25, 1])
    _bars(left, bars, with_after=True)
    _causes(right, causes)
    figure.legend(loc="lower center", ncols=4, fontsize=9.5, frameon=False)
    return figure


def _bars(axes: Axes, bars: Sequence[Bar], *, with_after: bool) -> None:
    at = np.arange(len(bars), dtype=float)
    thick = 0.34 if with_after else 0.5
    shift = thick / 2 if with_after else 0.0
    axes.barh(
        at - shift, [100 * b.before for b in bars], thick, color=RED, alpha=0.45, label=ORDER[1]
    )
    for y, bar in zip(at, bars, strict=True):
        _share(axes, bar.before, y - shift, bar.before)
    if with_after:
        axes.barh(at + shift, [100 * b.after for b in bars], thick, color=BLUE, label=ORDER[2])
        for y, bar in zip(at, bars, strict=True):
            low, high = bar.interval or (0.0, bar.after)
            if bar.interval:
                axes.plot([100 * low, 100 * high], [y + shift] * 2, color=INK, lw=1.6)
            _share(axes, max(bar.after, high), y + shift, bar.after)
    end = 118 * max([1e-9, *(max(b.before, b.after) for b in bars)])
    _share_axes(axes, _domain_names(bars), "the gap by domain", (0, end))


def _share(axes: Axes, end: float, y: float, value: float) -> None:
    """Write a share beside its bar, which ends at ``end``."""
    note(axes, percent(value), (100 * end, y), (5, 0), va="center", fontsize=9)


def _share_axes(axes: Axes, names: Sequence[str], title: str, ends: tuple[float, float]) -> None:
    axes.set_yticks(range(len(names)), names)
    axes.set_title(title, **TITLE)
    finish(axes, xlabel="share of the gap (%)", xlim=ends, ylim=(len(names) - 0.4, -0.6))
    axes.grid(visible=False, axis="y")


def _causes(axes: Axes, causes: Mapping[str, Mapping[str, Any]]) -> None:
    keys = ("gap_closed", "gain_over_rest")
    facts = [(*c["gap_closed_interval"], *(c[key] for key in keys)) for c in causes.values()]
    low, high, alone, unique = shares = 100 * np.array(facts).T
    rows = range(len(causes))
    axes.plot([low, high], [rows, rows], color=BLUE, lw=3, solid_capstyle="butt")
    axes.plot(alone, rows, "o", color=BLUE, ms=8, label="gap closed")
    axes.plot(unique, rows, "D", color=INK, ms=7, fillstyle="none", label="unique share")
    ends = (min(-3.0, shares.min()) - 2, max(103.0, shares.max()) + 2)
    _share_axes(axes, _cause_names(causes), "gap closed by each cause", ends)


def _domain_names(bars: Sequence[Bar]) -> list[str]:
    return ["\n".join(textwrap.wrap(_plain(b.name, 40), 24)) for b in bars]


def _cause_names(titles: Iterable[str]) -> list[str]:
    return ["\n".join(textwrap.wrap(_plain(title, 60), 22)[:3]) for title in titles]


def _room(names: Sequence[str]) -> float:
    """Width of the names beside an axis, inches."""
    return 0.4 + 0.085 * max(len(line) for name in names for line in name.splitlines() or [""])


# Curves


def curves_figure(curves: Sequence[Mapping[str, Any]], *, with_effects: bool = True) -> Figure:
    """Statistics side by side (up to three): above the values, below their deviations."""
    named = [places(c) for c in curves if _is_named(c)]
    # space for the longest rotated label, inches
    label_height = max(
        [0.075 * min(len(n), NAME) for names in named if _rotated(names) for n in names] or [0]
    )
    lines = max(_title(c).count("\n") + 1 for c in curves)
    size = WIDE * (1 + len(curves)) / 4, 5.0 + label_height
    margins = {"left": 0.9, "right": 0.35, "bottom": 0.6 + label_height, "top": 0.45 + 0.2 * lines}
    drawing: Any = {"beside": 0.9, "between": 0.2, "sharex": "col", "height_ratios": [2.1, 1]}
    figure, axes = axes_grid(size, 2, len(curves), **margins, **drawing)
    for n, (top, below, curve) in enumerate(zip(axes[0], axes[1], curves, strict=True)):
        _panel(top, below, curve, with_effects)
        if n == 0:
            below.set_ylabel("deviation (σ)")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    shown = dict(sorted(zip(labels, handles, strict=True), key=lambda pair: ORDER.index(pair[0])))
    figure.legend(shown.values(), shown, loc="upper center", ncols=3, fontsize=10, frameon=False)
    return figure


def _panel(top: Axes, below: Axes, curve: Mapping[str, Any], with_effects: bool) -> None:
    named = _is_named(curve)
    x = np.arange(len(curve["x"]), dtype=float) if named else _numbers(curve["x"])
    measured = _numbers(curve["measured"])
    simulated = {"nominal": RED} | ({"with_effects": BLUE} if with_effects else {})
    bands = {key: {k: _numbers(v) for k, v in curve[key].items()} for key in simulated}
    drawn = np.concatenate([measured, *(b["value"] for b in bands.values())])
    scale = unit_for(drawn, unit(str(curve["unit"])))
    for side, (key, colour) in zip((-1, 1), simulated.items(), strict=False):
        band = {k: v * scale.factor for k, v in bands[key].items()}
        label = ORDER[1 if key == "nominal" else 2]
        _simulated(top, x + side * BESIDE * named, band, colour, label, named)
        sigmas = _numbers(curve["z" if key == "nominal" else "z_after"])
        _deviations(below, x + side * BESIDE * named, sigmas, colour, named)
    style: Any = {"color": INK, "ms": 5, "lw": 1, "label": ORDER[0], "zorder": 5}
    top.plot(x, measured * scale.factor, "o" if named else "o-", **style)
    _value_axis(top, curve, drawn * scale.factor, scale)
    _sigma_axis(below, [_numbers(curve[k]) for k in ("z", "z_after")])
    _place_axis(below, curve, x, named)
    top.set_title(_title(curve), **TITLE)
    top.tick_params(labelbottom=False)


def _title(curve: Mapping[str, Any]) -> str:
    of = "" if curve["set"] == DETECTOR else f"set {curve['set']}"
    title = _plain(str(curve["title"]), 70)
    width = 36 if len(title) <= 36 else len(title) // 2 + 6
    return "\n".join([*textwrap.wrap(title, width)[:2], _plain(of, 30)]).strip()


def _simulated(
    axes: Axes, x: F64, band: Mapping[str, F64], colour: str, label: str, named: bool
) -> None:
    """A simulation's curve with its limits of one sigma."""
    low, high = np.fmin(band["low"], band["value"]), np.fmax(band["high"], band["value"])
    if named:
        errors = [band["value"] - low, high - band["value"]]
        style: Any = {"fmt": "s", "color": colour, "ms": 5, "elinewidth": 2.4, "alpha": 0.8}
        axes.errorbar(x, band["value"], errors, label=label, **style)
        return
    axes.fill_between(x, low, high, color=colour, alpha=0.25, lw=0)
    # The nominal curve stays visible below one that coincides with it.
    width = 3.0 if colour == RED else 1.4
    axes.plot(x, band["value"], color=colour, lw=width, label=label)


def _deviations(axes: Axes, x: F64, sigmas: F64, colour: str, named: bool) -> None:
    if named:
        axes.bar(x, sigmas, 0.32, color=colour, alpha=0.75)
    else:
        size = 6 if colour == RED else 3.5
        axes.plot(x, sigmas, "o-", color=colour, ms=size, lw=size / 3)


def _value_axis(axes: Axes, curve: Mapping[str, Any], values: F64, scale: Unit) -> None:
    good = values[np.isfinite(values)]
    if curve["kind"] == "power" and len(good) and good.min() > 0:
        if good.max() > SPAN * good.min():
            axes.set_yscale("log")
            axes.set_ylim(good.min() / 2, good.max() * 2)
            plain_ticks(axes.yaxis, good.min() / 2, good.max() * 2)
    else:
        axes.axhline(0, color=GREY, lw=0.8)
    quantity = str(curve["quantity"])
    label = f"{quantity} ({scale.label})" if scale.label else quantity
    axes.margins(x=0.06)
    finish(axes, ylabel=_plain(label, 40))


def _sigma_axis(axes: Axes, sigmas: Sequence[F64]) -> None:
    finite = np.concatenate(sigmas)
    top = 1.15 * max(QUIET, float(np.max(np.abs(finite[np.isfinite(finite)]), initial=0.0)))
    axes.axhspan(-2, 2, color=BAND, lw=0, zorder=0)
    axes.axhline(0, color=GREY, lw=0.8)
    finish(axes, ylim=(-top, top))


def _place_axis(axes: Axes, curve: Mapping[str, Any], x: F64, named: bool) -> None:
    axes.set_xlabel(_plain(axis_label(curve), LABEL))
    if named:
        names = places(curve)
        step = -(-len(names) // 16)
        rotation = 90 if _rotated(names[::step]) else 0
        axes.set_xticks(x[::step], [_plain(n, NAME) for n in names[::step]], rotation=rotation)
        axes.set_xlim(-0.6, len(x) - 0.4)
        axes.tick_params(axis="x", labelsize=9)
        return
    axes.set_xscale("log")
    low, high = float(x.min()) / 1.3, float(x.max()) * 1.3
    axes.set_xlim(low, high)
    plain_ticks(axes.xaxis, low, high)


def _rotated(names: Sequence[str]) -> bool:
    return sum(len(n) + 2 for n in names) > ROOM


def _is_named(curve: Mapping[str, Any]) -> bool:
    """Whether abscissae are names or counts; otherwise they are frequencies."""
    x = _numbers(curve["x"])
    return not (str(curve["x_label"]).startswith("cycles a ") and len(x) > 1 and x.min() > 0)


def _numbers(values: Sequence[Any]) -> F64:
    numbers = np.asarray(values, dtype=float)
    return np.where(np.isfinite(numbers), numbers, np.nan)


def _plain(text: str, most: int) -> str:
    """External text for a figure: one short line, no formulas, available letters."""
    line = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    short = line if len(line) <= most else line[: most - 1] + "…"
    return short.replace("$", r"\$")
