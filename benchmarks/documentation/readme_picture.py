"""The picture of the README: map of offsets, Allan deviation, gap before and after the causes."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import LogLocator

import pixcal

RED, BLUE, GREY = "#b3402a", "#2a5db0", "#888888"


def draw(run: pixcal.Run, file: Path) -> None:
    """Draw the picture from a run with a diagnosis, as PNG."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.1), layout="constrained")
    _map(axes[0], run)
    _allan(axes[1], run)
    _gap(axes[2], run.diagnosis)
    figure.savefig(file, dpi=110)
    plt.close(figure)


def _map(axes: Axes, run: pixcal.Run) -> None:
    offsets = 1e3 * run.delta_x.delta
    limit = float(np.nanpercentile(np.abs(offsets), 99.5))
    image = axes.imshow(offsets, cmap="RdBu_r", vmin=-limit, vmax=limit, interpolation="nearest")
    axes.invert_yaxis()
    axes.set(title="Measured offsets along x", xlabel="x (px)", ylabel="y (px)")
    plt.colorbar(image, ax=axes, label="offset (10⁻³ px)")


def _allan(axes: Axes, run: pixcal.Run) -> None:
    for (name, one), colour in zip(run.sets.items(), (BLUE, RED), strict=False):
        curve = one.allan
        frames = curve["frames"]
        axes.errorbar(
            frames, curve["adev_px"], curve["adev_err_px"], fmt="o", color=colour, ms=4, label=name
        )
        axes.plot(frames, curve["white_expected_px"], color=colour, lw=1)
    axes.set(xscale="log", yscale="log", xlabel="frames averaged", ylabel="deviation (10⁻³ px)")
    axes.set(title="Allan deviation (lines: white noise)")
    axes.set_xticks(frames, [f"{n:g}" for n in frames])
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0)))
    axes.yaxis.set_major_formatter(lambda value, _: f"{1e3 * value:g}")
    axes.minorticks_off()
    axes.legend(frameon=False)


def _gap(axes: Axes, diagnosis: dict[str, Any]) -> None:
    gap = diagnosis["gap"]
    found = " + ".join(cause["effect"] for cause in diagnosis["causes"])
    sizes = [100 * gap["total"], 100 * gap["after"]]
    bars = axes.barh(["nominal", f"with\n{found}"], sizes, color=[GREY, BLUE], height=0.55)
    axes.bar_label(bars, [f"{size:.0f} %" for size in sizes], padding=4)
    axes.invert_yaxis()
    axes.set(title="Gap to the simulation", xlabel="gap (%)", xlim=(0, 135))
    axes.set_xticks(range(0, 101, 20))
