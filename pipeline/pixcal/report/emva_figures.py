"""Figures after EMVA 1288: photon transfer, and spectra and profiles of DSNU and PRNU."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixcal.report.colours import BLUE, GREY, INK, RED
from pixcal.report.drawing import WIDE, axes_grid, finish

Curves = Mapping[str, Any]


def photon_transfer(curve: Curves, saturation: float | None) -> Figure:
    """Variance against level, and both over the straight line of gain and read noise.

    Parameters
    ----------
    curve : mapping
        ``level`` (ADU), ``variance`` and ``error`` (ADU²) of the points; ``gain`` (e-/ADU) and
        ``read_variance`` (ADU²) of the line.
    saturation : float, optional
        Level (ADU) where the detector saturates.
    """
    level, variance, error = (np.array(curve[k]) for k in ("level", "variance", "error"))
    shown = (level > 0) & (variance > 0)
    level, variance, error = level[shown], variance[shown], error[shown]
    line = level / curve["gain"] + curve["read_variance"]
    figure, ((left, right),) = axes_grid((WIDE, 3.9), 1, 2, width_ratios=[1.1, 1])
    look = {"fmt": "o", "color": BLUE, "markersize": 3.5, "elinewidth": 1}
    left.errorbar(level, variance, error, **look, label="pairs of flats")
    at = np.geomspace(level.min(), level.max(), 200)
    left.plot(
        at, at / curve["gain"] + curve["read_variance"], color=INK, linewidth=1.2,
        label=f"{curve['gain']:.4g} e⁻/ADU",
    )  # fmt: skip
    if curve["read_variance"] > 0:
        left.axhline(curve["read_variance"], color=GREY, ls=":", label="read noise")
    left.set(xscale="log", yscale="log", xlabel="level (ADU)", ylabel="variance (ADU²)")
    right.errorbar(level, variance / line, error / line, **look)
    right.axhline(1, color=INK, linewidth=1.2)
    right.set(xlabel="level (ADU)", ylabel="variance over the line")
    right.margins(y=0.15)
    right.locator_params(axis="x", nbins=6)
    for axes in (left, right):
        if saturation is not None:
            axes.axvline(saturation, color=RED, ls="--", linewidth=1, label="saturation")
        finish(axes)
    left.legend(fontsize=9, frameon=False)
    return figure


def nonuniformity(curves: Curves, name: str) -> Figure:
    """Spectra along rows and columns over the noise, and the means of rows and columns.

    Parameters
    ----------
    curves : mapping
        ``unit``; ``rows`` and ``columns`` with ``frequency`` (cycles/px), ``amplitude`` and
        ``noise`` of the spectrum, ``at`` (px) and ``profile`` of the means.
    name : str
        ``DSNU`` or ``PRNU``.
    """
    figure, grid = axes_grid((WIDE, 5.4), 2, 2, beside=1.2, width_ratios=[1, 1.3])
    unit = str(curves["unit"]).replace("e-", "e⁻")
    for (left, right), along, across in zip(
        grid, ("rows", "columns"), ("row", "column"), strict=True
    ):
        part = curves[along]
        _spectrum(left, part)
        left.set(xlabel=f"frequency along {along} (cycles/px)", ylabel=f"{name} ({unit})")
        right.plot(part["at"], part["profile"], color=BLUE, linewidth=0.8)
        right.axhline(0, color=INK, linewidth=0.8)
        axis = "y" if along == "rows" else "x"
        right.set(xlabel=f"{axis} (px)", ylabel=f"mean of each {across}\n({unit})")
        right.margins(x=0.01)
        finish(right)
    grid[0, 0].legend(fontsize=9, frameon=False)
    return figure


def _spectrum(axes: Axes, part: Curves) -> None:
    axes.plot(part["frequency"], part["amplitude"], color=BLUE, linewidth=0.9, label="measured")
    if part["noise"] > 0:
        axes.axhline(part["noise"], color=RED, ls="--", linewidth=1, label="noise in the map")
    axes.set_xlim(0, 0.5)
    if max(part["amplitude"]) > 10 * float(np.median(part["amplitude"])):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    finish(axes)
