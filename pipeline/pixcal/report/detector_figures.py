"""Figures of the detector: photon transfer, patterns of DSNU and PRNU (EMVA 1288), linearity."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixcal.report.colours import BLUE, GREY, INK, RED
from pixcal.report.drawing import WIDE, axes_grid, finish, plain_ticks

Curves = Mapping[str, Any]

AXES = ("rows", "columns"), ("y", "x"), (BLUE, RED)  # of profiles, their coordinate, colour


def photon_transfer(curve: Curves, saturation: float | None) -> Figure:
    """Variance against level, and both over the straight line of gain and read noise.

    ``curve``: ``level`` (ADU), ``variance`` and ``error`` (ADU²) of the points; ``gain`` (e-/ADU)
    and ``read_variance`` (ADU²) of the line. ``saturation``: level (ADU).
    """
    level, variance, error = (np.array(curve[k]) for k in ("level", "variance", "error"))
    shown = (level > 0) & (variance > 0)
    level, variance, error = level[shown], variance[shown], error[shown]
    line = level / curve["gain"] + curve["read_variance"]
    figure, ((left, right),) = axes_grid((WIDE, 3.9), 1, 2, width_ratios=[1.1, 1])
    style = {"fmt": "o", "color": BLUE, "ms": 3.5, "elinewidth": 1}
    left.errorbar(level, variance, error, **style, label="pairs of flats")
    at = np.geomspace(level.min(), level.max(), 200)
    label = f"{curve['gain']:.4g} e⁻/ADU"
    left.plot(at, at / curve["gain"] + curve["read_variance"], color=INK, lw=1.2, label=label)
    if curve["read_variance"] > 0:
        left.axhline(curve["read_variance"], color=GREY, ls=":", label="read noise")
    left.set(xscale="log", yscale="log", ylabel="variance (ADU²)")
    low, high = left.get_xlim()
    plain_ticks(left.xaxis, low, high, most=5)
    right.errorbar(level, variance / line, error / line, **style)
    right.axhline(1, color=INK, lw=1.2)
    right.set_ylabel("variance / straight line")
    right.margins(y=0.15)
    right.locator_params(axis="x", nbins=6)
    for axes in (left, right):
        if saturation is not None:
            axes.axvline(saturation, color=RED, ls="--", lw=1, label="saturation")
        finish(axes, xlabel="level (ADU)")
    # Empty space above the rising points, for the legend.
    left.set_ylim(top=4 * left.get_ylim()[1])
    left.legend(fontsize=9, frameon=False, loc="upper left")
    return figure


def nonuniformity(patterns: Mapping[str, Curves]) -> Figure:
    """Spectra along rows and columns over the noise, and the means of rows and columns.

    ``patterns``: for ``DSNU`` and ``PRNU``: ``unit``; ``rows`` and ``columns`` with ``frequency``
    (cycles/px), ``amplitude`` and ``noise`` of the spectrum, ``at`` (px) and ``profile`` of the
    means.
    """
    size, count = (WIDE, 2.6 * len(patterns) + 0.3), len(patterns)
    figure, grid = axes_grid(size, count, 3, right=0.1, beside=0.85, width_ratios=[1.3, 1, 1])
    for (spectrum, *profiles), (name, curves) in zip(grid, patterns.items(), strict=True):
        unit = str(curves["unit"]).replace("e-", "e⁻")
        _spectra(spectrum, curves)
        spectrum.set_ylabel(f"{name} ({unit})")
        for axes, along, axis, colour in zip(profiles, *AXES, strict=True):
            part = curves[along]
            axes.plot(part["at"], part["profile"], color=colour, lw=0.8)
            axes.axhline(0, color=INK, lw=0.8)
            axes.margins(x=0.01)
            axes.locator_params(nbins=5)
            finish(axes, xlabel=f"{axis} (px)", ylabel=f"mean of {along} ({unit})")
    return figure


def _spectra(axes: Axes, curves: Curves) -> None:
    """Spectra along rows and columns, the weaker one in front."""
    peaks = []
    for along, _, colour in zip(*AXES, strict=True):
        part = curves[along]
        middle = float(np.median(part["amplitude"]))
        peaks.append(max(part["amplitude"]) > 10 * middle)
        style: Any = {"color": colour, "zorder": 3 - middle / (1 + middle)}
        axes.plot(part["frequency"], part["amplitude"], lw=0.9, label=f"along {along}", **style)
        if part["noise"] > 0:
            axes.axhline(part["noise"], color=colour, ls="--", lw=1)
    axes.set(xlim=(0, 0.5), xlabel="frequency (cycles/px)")
    if any(peaks):
        axes.set_yscale("log")
        axes.minorticks_off()
    else:
        axes.set_ylim(0, 1.3 * max(max(curves[along]["amplitude"]) for along in AXES[0]))
    finish(axes)
    axes.legend(fontsize=9, frameon=False, ncols=2, loc="upper right")


def linearity(levels: Sequence[Mapping[str, Any]], error_percent: float | None) -> Figure:
    """Deviation from a straight line over the exposure-time steps of the flats.

    ``levels``: with ``level_e`` (e-) and ``deviation_percent`` (None where the step was not used).
    ``error_percent``: of each deviation, if known.
    """
    used = [v for v in levels if v.get("deviation_percent") is not None]
    left_out = [v for v in levels if v.get("deviation_percent") is None]
    figure, ((axes,),) = axes_grid((WIDE, 3.2), left=1.0)
    axes.axhline(0, color=INK, lw=1, ls="--")
    at = [v["level_e"] / 1e3 for v in used]
    deviation = [v["deviation_percent"] for v in used]
    axes.errorbar(at, deviation, error_percent, fmt="o-", color=BLUE, lw=1.2, ms=3.5, capsize=3)
    for level in left_out:
        axes.axvline(level["level_e"] / 1e3, color=INK, ls=":", lw=1)
    axes.margins(y=0.25)
    finish(axes, xlabel="level (10³ e⁻)", ylabel="deviation (%)")
    return figure
