"""Figures of what the reduction measured."""

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from pixcal.report.colours import BLUE, INK
from pixcal.report.drawing import WIDE, axes_grid, finish


def linearity(levels: Sequence[Mapping[str, Any]]) -> Figure:
    """Departure from the straight line over the ladder of flats.

    Parameters
    ----------
    levels : sequence of mapping
        With ``level_e`` (e-) and ``deviation_percent`` (None where the rung was not used).
    """
    used = [v for v in levels if v.get("deviation_percent") is not None]
    left_out = [v for v in levels if v.get("deviation_percent") is None]
    figure, ((axes,),) = axes_grid((WIDE, 3.2), left=1.0)
    axes.axhline(0, color=INK, linewidth=1, ls="--")
    axes.plot(
        [v["level_e"] / 1e3 for v in used],
        [v["deviation_percent"] for v in used],
        "o-", color=BLUE, linewidth=1.2, markersize=6,
    )  # fmt: skip
    for level in left_out:
        axes.axvline(level["level_e"] / 1e3, color=INK, ls=":", linewidth=1)
    axes.set(xlabel="level (10³ e⁻)", ylabel="departure (%)")
    axes.margins(y=0.25)
    finish(axes)
    return figure
