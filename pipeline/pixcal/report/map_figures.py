"""Figures of maps: offsets with their profiles, histograms, power spectra."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pixcal.model.arrays import F64
from pixcal.report.colours import BAND, BAR, BLUE, GREY, INK, LINES
from pixcal.report.contents import MapContents
from pixcal.report.drawing import (
    DPI,
    WIDE,
    Unit,
    axes_grid,
    block_note,
    draw_blocks,
    finish,
    fit_box,
    limits,
    place,
    symmetric_scale,
    unit_for,
)
from pixcal.report.map_panels import folded
from pixcal.report.map_summary import MapSummary, Profile, Spectrum
from pixcal.report.text import SYMBOLS

MEANS_DRAWN = 800  # most means of a profile that are drawn one by one


def offsets(
    name: str, delta: MapSummary, sigma: MapSummary, start: tuple[int, int] = (0, 0)
) -> Figure:
    """A map of offsets (px), or a part from ``start``, with means of columns and rows beside it."""
    width, height = fit_box(delta.shape, 5.7, 5.4)
    total = height + 3.45
    figure = Figure(figsize=(WIDE, total), dpi=DPI)
    left, bottom = 0.95, 2.55
    symbol, unit = SYMBOLS[name], unit_for([delta.robust_std], "px")
    scale = symmetric_scale(delta.image * unit.factor)

    main = place(figure, left, bottom, width, height)
    style: Any = {"cmap": scale.colours, "vmin": scale.low, "vmax": scale.high, "aspect": "auto"}
    drawn = draw_blocks(main, delta.image * unit.factor, delta.block, start, **style)
    x = start[1] + np.arange(delta.shape[1], dtype=float)
    y = start[0] + np.arange(delta.shape[0], dtype=float)
    main.set(xlim=(x[0] - 0.5, x[-1] + 0.5), ylim=(y[0] - 0.5, y[-1] + 0.5), ylabel="y (px)")
    main.locator_params(nbins=5)
    main.tick_params(labelbottom=False)
    bar = place(figure, left, bottom + height + 0.15, width, 0.17)
    figure.colorbar(drawn, cax=bar, orientation="horizontal", extend=scale.beyond)
    bar.xaxis.set_ticks_position("top")
    note = block_note(delta)
    bar.set_title(f"{symbol} ({unit.label})" + (f", {note}" if note else ""), fontsize=11)

    below = place(figure, left, 0.6, width, 1.75)
    beside = place(figure, left + width + 0.25, bottom, WIDE - left - width - 0.6, height)
    _profile(below, x, delta.columns, sigma.columns, unit, upright=False)
    _profile(beside, y, delta.rows, sigma.rows, unit, upright=True)
    below.set_xlim(main.get_xlim())
    beside.set_ylim(main.get_ylim())
    below.set(xlabel="x (px)", ylabel=f"column mean\n({unit.label})")
    beside.set(xlabel=f"row mean ({unit.label})")
    beside.tick_params(labelleft=False)
    corner = (left + width + 0.2) / WIDE, 1.85 / total
    style = {"frameon": False, "fontsize": 9.5, "title": "Means", "alignment": "left"}
    handles, labels = below.get_legend_handles_labels()
    figure.legend(handles, labels, loc="upper left", bbox_to_anchor=corner, **style)
    numbers = (
        f"rms {delta.std * unit.factor:.3g}, robust {delta.robust_std * unit.factor:.3g}\n"
        f"median error {sigma.median * unit.factor:.3g}  ({unit.label})"
    )
    figure.text((left + width + 0.3) / WIDE, 0.12 / total, numbers, fontsize=10, linespacing=1.5)
    return figure


def _profile(
    axes: Axes, at: F64, means: Profile, errors: Profile, unit: Unit, *, upright: bool
) -> None:
    """Means along an axis with their errors, beside the ±2σ band of independent offsets."""
    mean = means.mean * unit.factor
    noise = errors.mean * unit.factor / np.sqrt(np.maximum(means.count, 1))
    # The scatter of one line is itself uncertain: the band uses that of all lines.
    there = np.isfinite(means.scatter)
    spread = float(np.sqrt(np.sum(means.scatter[there] ** 2) / max(there.sum(), 1))) * unit.factor
    chance = np.where(means.count > 0, 2 * spread, np.nan) / np.sqrt(np.maximum(means.count, 1))
    fill = axes.fill_betweenx if upright else axes.fill_between

    def line(values: F64, **drawing: Any) -> None:
        axes.plot(*((values, at) if upright else (at, values)), **drawing)

    if len(at) <= MEANS_DRAWN:
        fill(at, -chance, chance, color=BAND, lw=0, label="independent offsets, ±2σ")
        ends, label = (mean - noise, mean + noise), "error, ±1σ"
        fill(at, *ends, color=BLUE, alpha=0.35, lw=0, label=label)
        line(mean, color=BLUE, lw=1.1 if len(at) <= 400 else 0.6, label="mean")
    else:
        low, middle, high = _nearby(mean)
        fill(at, low, high, color=BAR, lw=0, label="lowest to highest nearby")
        line(middle, color=BLUE, lw=1.0, label="mean of those nearby")
        drawing = {"color": INK, "lw": 1.0, "ls": "--"}
        line(-chance, **drawing, label="independent offsets, ±2σ")
        line(chance, **drawing)
    (axes.set_xlim if upright else axes.set_ylim)(*limits([mean, -chance, chance]))
    finish(axes)


def _nearby(values: F64) -> tuple[F64, F64, F64]:
    """Minimum, mean and maximum of groups of neighbouring values; NaN are ignored."""
    size = -(-len(values) // (MEANS_DRAWN // 2))
    groups = np.arange(len(values)) // size
    starts = np.arange(0, len(values), size)
    there = np.isfinite(values)
    count = np.add.reduceat(there, starts, dtype=float)
    total = np.add.reduceat(np.where(there, values, 0.0), starts)
    mean = np.divide(total, count, out=np.full(len(starts), np.nan), where=count > 0)
    low = np.fmin.reduceat(values, starts)
    high = np.fmax.reduceat(values, starts)
    return low[groups], mean[groups], high[groups]


def histogram(maps: Sequence[MapContents]) -> Figure:
    """Histograms of the offsets, beside normal distributions and the widths of the noise."""
    figure, ((axes,),) = axes_grid((WIDE, 3.8))
    unit = unit_for([offset.delta.robust_std for offset in maps], "px")
    for n, (offset, colour) in enumerate(zip(maps, LINES, strict=False)):
        _histogram(axes, offset, unit, colour, (n / len(maps), (n + 1) / len(maps)))
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.5)
    legend = "upper right" if axes.get_legend_handles_labels()[0] else ""
    finish(axes, legend=legend, xlabel=f"offset ({unit.label})", ylabel="pixels per bin")
    return figure


def _histogram(
    axes: Axes, offset: MapContents, unit: Unit, colour: str, part: tuple[float, float]
) -> None:
    """A histogram; the band of the noise covers a ``part`` of the height, to hide no other."""
    delta, symbol = offset.delta, SYMBOLS[offset.name]
    values = delta.sample.astype(float) * unit.factor
    spread, middle = delta.robust_std * unit.factor, delta.median * unit.factor
    noise = offset.sigma.median * unit.factor
    if not (len(values) and spread > 0):
        return
    bins = int(np.clip(np.sqrt(len(values)) / 1.5, 15, 120))
    edges = np.linspace(middle - 6 * spread, middle + 6 * spread, bins + 1)
    count, _ = np.histogram(values, edges)
    axes.stairs(count, edges, color=colour, lw=1.5, label=f"{symbol}, pixels")
    at = np.linspace(edges[0], edges[-1], 400)
    top = len(values) * (edges[1] - edges[0]) / (np.sqrt(2 * np.pi) * spread)
    normal = top * np.exp(-(((at - middle) / spread) ** 2) / 2)
    label = f"normal, robust σ = {spread:.3g} {unit.label}"
    axes.plot(at, np.maximum(normal, 0.1), color=colour, lw=1.0, ls="--", label=label)
    if np.isfinite(noise) and noise > 0:
        label = f"noise, ±1σ = ±{noise:.3g} {unit.label}"
        ends = middle - noise, middle + noise
        axes.axvspan(*ends, *part, color=colour, alpha=0.35, lw=0, label=label)


def power(maps: Sequence[MapContents], vectors: Mapping[str, tuple[float, float]]) -> Figure:
    """Power spectra of maps: means over rings, cuts, and the fringe vectors (rad/px) by set."""
    figure, ((axes,),) = axes_grid((WIDE, 4.0), left=1.0)
    for offset, colour in zip(maps, LINES, strict=False):
        assert offset.spectrum is not None
        _spectrum_lines(axes, SYMBOLS[offset.name], offset.spectrum, colour)
    for vector in vectors.values():
        for order in (1, 2):
            f = folded(np.array([order * v / (2 * np.pi) for v in vector]))
            axes.axvline(float(np.hypot(*f)), color=GREY, ls=":", lw=1)
    axes.set_yscale("log")
    axes.set_ylim(top=30 * axes.get_ylim()[1])  # room for the legend
    axes.set_xlim(0, 0.5)
    axes.set(xlabel="spatial frequency (cycles/px)", ylabel="power (px² per (cycle/px)²)")
    finish(axes)
    axes.legend(fontsize=8.5, framealpha=0.9, ncols=len(maps), loc="upper right")
    return figure


def _spectrum_lines(axes: Axes, symbol: str, spectrum: Spectrum, colour: str) -> None:
    fy, fx = spectrum.frequencies
    my, mx = len(fy), len(fx)
    for f, cut, style, label in (
        (fx, spectrum.power[my // 2], "-", "along fx (means of columns)"),
        (fy, spectrum.power[:, mx // 2], "--", "along fy (means of rows)"),
    ):
        drawing: Any = {"color": colour, "lw": 0.8, "alpha": 0.7, "ls": style}
        axes.plot(f[f > 0], cut[f > 0], label=f"{symbol} {label}", **drawing)
    axes.plot(*spectrum.radial(), color=colour, lw=2, label=f"{symbol}, mean over rings")
    if spectrum.white > 0:
        label = f"{symbol}, white noise of σ"
        axes.axhline(spectrum.white, color=colour, ls=(0, (6, 3)), lw=1.6, label=label)
