"""The figure of a budget: precision against frames, and which change of the bench helps most."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from pixcal.model.arrays import F64
from pixcal.report.colours import BAR, BLUE, GREEN, GREY, INK, MARKS, RED
from pixcal.report.drawing import WIDE, finish, new_figure, plain_ticks
from pixcal.report.text import duration, number

COLOURS = (BLUE, GREEN, *MARKS)


@dataclass(frozen=True)
class PrecisionLine:
    """Precision against frames: one over their root."""

    label: str
    median: float  # median, worst: bound of one frame, px, for the median and for the worst pixel
    worst: float
    planned: int  # frames of the bench


def budget_figure(result: Mapping[str, Any]) -> Figure:
    """Precision against frames on the left, time with each change of the bench on the right.

    Parameters
    ----------
    result : mapping
        Contents of ``budget.json``.
    """
    figure = new_figure(WIDE, 4.9)
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1])
    _precision(left, result)
    _levers(right, result)
    return figure


def _lines(entries: Mapping[str, Any]) -> list[PrecisionLine]:
    lines = []
    for name, facts in entries.items():
        period = f" ({facts['interfringe_px']:.3g} px)" if "interfringe_px" in facts else ""
        frame = facts["frame_px"]
        planned = facts["planned"]["frames"]
        lines.append(PrecisionLine(name + period, frame["median"], frame["worst"], planned))
    return lines


def _as_planned(result: Mapping[str, Any]) -> Mapping[str, Any]:
    lever: Mapping[str, Any] = next(v for v in result["levers"] if v["name"] == "as planned")
    return lever


def _span(
    sets: Sequence[PrecisionLine],
    joined: Sequence[PrecisionLine],
    precision: float | None,
    frames: int | None,
) -> F64:
    """Range of the frame axis, with a margin around all marks."""
    marks = [float(line.planned) for line in (*sets, *joined)]
    if frames:
        marks.append(float(frames))
    if precision:
        marks += [(line.median / precision) ** 2 for line in (*sets, *joined)]
        marks += [(line.worst / precision) ** 2 for line in sets]
    low, high = np.log10(max(min(marks) / 5, 1.0)), np.log10(max(marks) * 4)
    return np.logspace(low, high, 61)


def _precision(axes: Axes, result: Mapping[str, Any]) -> None:
    sets = _lines(result["sets"])
    joined = _lines(result["joined"]["components"]) if len(sets) > 1 else []
    wanted, given = result["precision_px"], result["frames"]
    frames = _span(sets, joined, wanted, given)
    for order, (line, colour) in enumerate(zip(sets, _cycle(len(sets)), strict=True)):
        # Sets are often alike: the later ones are thinner, so that none is hidden.
        width = 2.0 + 3.0 * (len(sets) - 1 - order)
        axes.plot(
            frames, line.median / np.sqrt(frames), color=colour, linewidth=width, label=line.label
        )
        if line.worst > 1.01 * line.median:
            ends = (line.median / np.sqrt(frames), line.worst / np.sqrt(frames))
            axes.fill_between(frames, *ends, color=colour, alpha=0.18, linewidth=0)
        axes.plot(
            line.planned, line.median / np.sqrt(line.planned), "o", color=colour,
            markersize=8 + 3 * (len(sets) - 1 - order),
        )  # fmt: skip
    for line, colour, style in zip(joined, (INK, GREY), ("-", "--"), strict=False):
        axes.plot(
            frames, line.median / np.sqrt(frames), color=colour, ls=style, linewidth=1.4,
            label=f"{line.label}, frames of all sets",
        )  # fmt: skip
    if wanted:
        axes.axhline(wanted, color=RED, linewidth=1.2)
        axes.annotate(
            f"wanted {number(wanted)} px", (frames[0], wanted), xytext=(4, 4),
            textcoords="offset points", color=RED, fontsize=10,
        )  # fmt: skip
        for line in (*sets, *joined):
            axes.plot((line.median / wanted) ** 2, wanted, "s", color=RED)
    if given:
        axes.axvline(given, color=RED, linewidth=1.2)
        axes.annotate(
            f"{number(given)} frames of each set", (given, 0.02),
            xycoords=("data", "axes fraction"), xytext=(-5, 0), textcoords="offset points",
            ha="right", color=RED, fontsize=10,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(frames[0], frames[-1])
    axes.set(xlabel="frames", ylabel="1σ bound of a pixel's offset (px)")
    plain_ticks(axes.xaxis, *axes.get_xlim(), most=9)
    plain_ticks(axes.yaxis, *axes.get_ylim(), most=9)
    _clock(axes, _as_planned(result)["period_s"])
    finish(axes)
    axes.plot([], [], "o", color=GREY, label="planned")
    if any(line.worst > 1.01 * line.median for line in sets):
        axes.fill_between([], [], [], color=GREY, alpha=0.25, label="median to worst pixel")
    axes.legend(fontsize=9, framealpha=0.9, loc="upper right")


def _cycle(number: int) -> list[str]:
    return [COLOURS[n % len(COLOURS)] for n in range(number)]


def _clock(axes: Axes, period: float) -> None:
    """Time on top."""

    def seconds(frames: Any) -> Any:
        return np.asarray(frames) * period

    def back(time: Any) -> Any:
        return np.asarray(time) / period

    top = axes.secondary_xaxis("top", functions=(seconds, back))
    places = [10.0, 60.0, 600.0, 3600.0, 36000.0, 8.64e4, 8.64e5, 8.64e6]
    low, high = (period * f for f in axes.get_xlim())
    top.xaxis.set_major_locator(FixedLocator([p for p in places if low <= p <= high]))
    names = ("10 s", "1 min", "10 min", "1 h", "10 h", "1 d", "10 d", "100 d")
    named = dict(zip(places, names, strict=True))
    top.xaxis.set_major_formatter(FuncFormatter(lambda v, _: named.get(v, "")))
    top.xaxis.set_minor_locator(NullLocator())


def _levers(axes: Axes, result: Mapping[str, Any]) -> None:
    """Time for the same precision, relative to the plan."""
    plan = _as_planned(result)
    planned = plan["variance"] * plan["period_s"]
    levers = result["levers"][::-1]
    names = [lever["name"] for lever in levers]
    share = np.array([lever["variance"] * lever["period_s"] / planned for lever in levers])
    colours = [INK if name == "as planned" else RED if s > 1 else BLUE
               for name, s in zip(names, share, strict=True)]  # fmt: skip
    at = np.arange(len(names))
    axes.barh(at, share, color=[BAR if c == BLUE else c for c in colours], height=0.62)
    for y, name, value in zip(at, names, share, strict=True):
        axes.annotate(
            name, (0, y + 0.34), xytext=(1, 0), textcoords="offset points", fontsize=9,
            va="bottom", color=INK,
        )  # fmt: skip
        text = f"{100 * value:.3g} %"
        if result["precision_px"]:
            text += f"   {duration(value * planned / result['precision_px'] ** 2)}"
        axes.annotate(
            text, (value, y), xytext=(4, 0), textcoords="offset points", va="center", fontsize=9
        )
    axes.set_yticks([])
    axes.set_xlim(0, 1.45 * float(share.max()))
    axes.set_ylim(-0.6, len(names) - 0.1)
    axes.set(xlabel="time for the same precision / as planned", title="What if")
    finish(axes, grid=False)
    axes.spines["left"].set_visible(False)
