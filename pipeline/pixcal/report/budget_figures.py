"""The figure of a budget: precision against frames, and the gain of changes of the bench."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from pixcal.model.arrays import F64
from pixcal.report.colours import BAR, BLUE, GREEN, GREY, INK, MARKS, RED
from pixcal.report.drawing import WIDE, finish, new_figure, note, plain_ticks, second_axis
from pixcal.report.text import duration, number

Facts = Mapping[str, Any]

COLOURS = (BLUE, GREEN, *MARKS)
CLOCK = {
    10.0: "10 s",
    60.0: "1 min",
    600.0: "10 min",
    3600.0: "1 h",
    36000.0: "10 h",
    8.64e4: "1 d",
    8.64e5: "10 d",
    8.64e6: "100 d",
}


def budget_figure(result: Mapping[str, Any]) -> Figure:
    """Of ``budget.json``: precision against frames, and time with each change of the bench."""
    figure = new_figure(WIDE, 4.9)
    left, right = figure.subplots(1, 2, width_ratios=[1.25, 1])
    plan = next(lever for lever in result["levers"] if lever["name"] == "as planned")
    _precision(left, result, plan["period_s"])
    _levers(right, result, plan["variance"] * plan["period_s"])
    return figure


def _span(sets: Sequence[Facts], every: Sequence[Facts], result: Facts) -> F64:
    """Range of the frame axis, with a margin around all marks."""
    precision, marks = result["precision_px"], [float(one["planned"]["frames"]) for one in every]
    if result["frames"]:
        marks.append(float(result["frames"]))
    if precision:
        bounds = [one["frame_px"]["median"] for one in every]
        bounds += [one["frame_px"]["worst"] for one in sets]
        marks += [(bound / precision) ** 2 for bound in bounds]
    low, high = np.log10(max(min(marks) / 5, 1.0)), np.log10(max(marks) * 4)
    return np.logspace(low, high, 61)


def _uneven(facts: Facts) -> bool:
    """Whether the worst pixel is noticeably worse than the median one."""
    return bool(facts["frame_px"]["worst"] > 1.01 * facts["frame_px"]["median"])


def _precision(axes: Axes, result: Mapping[str, Any], period: float) -> None:
    sets = result["sets"]
    joined = result["joined"]["components"] if len(sets) > 1 else {}
    every = [*sets.values(), *joined.values()]
    wanted, given = result["precision_px"], result["frames"]
    frames = _span([*sets.values()], every, result)
    for order, ((name, facts), colour) in enumerate(zip(sets.items(), cycle(COLOURS))):
        # Sets are often similar: later ones are thinner, so that none is hidden.
        before = len(sets) - 1 - order
        median, planned = facts["frame_px"]["median"], facts["planned"]["frames"]
        if "interfringe_px" in facts:
            name += f" ({facts['interfringe_px']:.3g} px)"
        bound = median / np.sqrt(frames)
        axes.plot(frames, bound, color=colour, lw=2.0 + 3.0 * before, label=name)
        if _uneven(facts):
            worst = facts["frame_px"]["worst"] / np.sqrt(frames)
            axes.fill_between(frames, bound, worst, color=colour, alpha=0.18, lw=0)
        axes.plot(planned, median / np.sqrt(planned), "o", color=colour, ms=8 + 3 * before)
    styles = zip(joined.items(), (INK, GREY), ("-", "--"), strict=False)
    for (name, facts), colour, style in styles:
        bound, label = facts["frame_px"]["median"] / np.sqrt(frames), f"{name}, frames of all sets"
        axes.plot(frames, bound, color=colour, ls=style, lw=1.4, label=label)
    if wanted:
        axes.axhline(wanted, color=RED, lw=1.2)
        text = f"wanted {number(wanted)} px"
        note(axes, text, (frames[0], wanted), (4, 4), color=RED, fontsize=10)
        for facts in every:
            axes.plot((facts["frame_px"]["median"] / wanted) ** 2, wanted, "s", color=RED)
    if given:
        axes.axvline(given, color=RED, lw=1.2)
        text = f"{number(given)} frames of each set"
        drawing: Any = {"xycoords": ("data", "axes fraction"), "ha": "right", "fontsize": 10}
        note(axes, text, (given, 0.02), (-5, 0), color=RED, **drawing)
    axes.set(xscale="log", yscale="log", xlim=(frames[0], frames[-1]))
    plain_ticks(axes.xaxis, *axes.get_xlim(), most=9)
    plain_ticks(axes.yaxis, *axes.get_ylim(), most=9)
    _clock(axes, period)
    axes.plot([], [], "o", color=GREY, label="planned")
    if any(map(_uneven, sets.values())):
        axes.fill_between([], [], [], color=GREY, alpha=0.25, label="median to worst pixel")
    label = "1σ bound of a pixel's offset (px)"
    finish(axes, legend="upper right", xlabel="frames", ylabel=label)


def _clock(axes: Axes, period: float) -> None:
    top = second_axis(axes, "top", period)
    low, high = (period * f for f in axes.get_xlim())
    top.xaxis.set_major_locator(FixedLocator([p for p in CLOCK if low <= p <= high]))
    top.xaxis.set_major_formatter(FuncFormatter(lambda v, _: CLOCK.get(v, "")))
    top.xaxis.set_minor_locator(NullLocator())


def _levers(axes: Axes, result: Mapping[str, Any], planned: float) -> None:
    """Time for the same precision, relative to that ``planned``, s px²."""
    precision = result["precision_px"]
    shares = {
        lever["name"]: lever["variance"] * lever["period_s"] / planned
        for lever in result["levers"][::-1]
    }
    for y, (name, share) in enumerate(shares.items()):
        colour = INK if name == "as planned" else RED if share > 1 else BAR
        axes.barh(y, share, color=colour, height=0.62)
        note(axes, name, (0, y + 0.34), (1, 0), fontsize=9, va="bottom", color=INK)
        time = f"   {duration(share * planned / precision**2)}" if precision else ""
        note(axes, f"{100 * share:.3g} %{time}", (share, y), (4, 0), fontsize=9, va="center")
    axes.set(yticks=[], xlim=(0, 1.45 * max(shares.values())), ylim=(-0.6, len(shares) - 0.1))
    label = "time for the same precision / as planned"
    finish(axes, grid=False, xlabel=label, title="Alternatives")
    axes.spines["left"].set_visible(False)
