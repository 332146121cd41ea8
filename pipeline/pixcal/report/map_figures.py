"""Figures of maps: offsets with their profiles, errors, power spectra, levels, flags."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from pixcal.model.flags import PixelFlag
from pixcal.report.colours import (
    BAND,
    BAR,
    BLUE,
    FLAGS,
    GREY,
    INK,
    LINES,
    MARKS,
    SEQUENTIAL,
    SEVERAL,
    UNFLAGGED,
)
from pixcal.report.contents import MapContents, SetContents
from pixcal.report.drawing import (
    DPI,
    TITLE,
    WIDE,
    Unit,
    add_bar,
    axes_grid,
    block_note,
    covered,
    draw_map,
    draw_panel,
    finish,
    fit_box,
    limits,
    map_axes,
    place,
    square,
    symmetric_scale,
    unit_for,
)
from pixcal.report.summary import FlagSummary, MapSummary, Profile, Spectrum
from pixcal.report.text import SYMBOLS, flag_name

F64 = NDArray[np.float64]

MEANS_DRAWN = 800  # most means of a profile that are drawn one by one


def offsets(
    name: str, delta: MapSummary, sigma: MapSummary, start: tuple[int, int] = (0, 0)
) -> Figure:
    """A map of offsets with the means of its columns below and of its rows beside it.

    Parameters
    ----------
    name : str
        ``delta_x`` and so on.
    delta, sigma : MapSummary
        Offsets and their errors, px.
    start : (int, int)
        First row and column, where it is a part of the map.
    """
    width, height = fit_box(delta.shape, 5.7, 5.4)
    total = height + 3.45
    figure = Figure(figsize=(WIDE, total), dpi=DPI)
    left, bottom = 0.95, 2.55
    symbol, unit = SYMBOLS[name], unit_for([delta.robust_std], "px")
    scale = symmetric_scale(delta.image * unit.factor)

    main = place(figure, left, bottom, width, height)
    drawn = draw_map(main, delta, scale, unit.factor, start)
    main.set_ylabel("y (px)")
    main.tick_params(labelbottom=False)
    bar = place(figure, left, bottom + height + 0.15, width, 0.17)
    figure.colorbar(drawn, cax=bar, orientation="horizontal", extend=scale.beyond)
    bar.xaxis.set_ticks_position("top")
    note = block_note(delta)
    bar.set_title(f"{symbol} ({unit.label})" + (f", {note}" if note else ""), fontsize=11)

    below = place(figure, left, 0.6, width, 1.75)
    beside = place(figure, left + width + 0.25, bottom, WIDE - left - width - 0.6, height)
    x = start[1] + np.arange(delta.shape[1], dtype=float)
    y = start[0] + np.arange(delta.shape[0], dtype=float)
    _profile(below, x, delta.columns, sigma.columns, unit, upright=False)
    _profile(beside, y, delta.rows, sigma.rows, unit, upright=True)
    below.set_xlim(main.get_xlim())
    beside.set_ylim(main.get_ylim())
    below.set(xlabel="x (px)", ylabel=f"column mean\n({unit.label})")
    beside.set(xlabel=f"row mean ({unit.label})")
    beside.tick_params(labelleft=False)
    handles, labels = below.get_legend_handles_labels()
    figure.legend(
        handles, labels, loc="upper left", frameon=False, fontsize=9.5, title="Means",
        alignment="left", bbox_to_anchor=((left + width + 0.2) / WIDE, 1.85 / total),
    )  # fmt: skip
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

    def line(values: F64, **look: Any) -> None:
        axes.plot(*((values, at) if upright else (at, values)), **look)

    if len(at) <= MEANS_DRAWN:
        fill(at, -chance, chance, color=BAND, linewidth=0, label="independent offsets, ±2σ")
        ends, label = (mean - noise, mean + noise), "error, ±1σ"
        fill(at, *ends, color=BLUE, alpha=0.35, linewidth=0, label=label)
        line(mean, color=BLUE, linewidth=1.1 if len(at) <= 400 else 0.6, label="mean")
    else:
        low, middle, high = _nearby(mean)
        fill(at, low, high, color=BAR, linewidth=0, label="lowest to highest nearby")
        line(middle, color=BLUE, linewidth=1.0, label="mean of those nearby")
        look = {"color": INK, "linewidth": 1.0, "ls": "--"}
        line(-chance, **look, label="independent offsets, ±2σ")
        line(chance, **look)
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
    empty = np.full(len(starts), np.nan)
    mean = np.divide(total, count, out=empty, where=count > 0)
    low = np.fmin.reduceat(values, starts)
    high = np.fmax.reduceat(values, starts)
    return low[groups], mean[groups], high[groups]


def errors_and_histogram(maps: Sequence[MapContents]) -> Figure:
    """The maps of errors, and the histograms of offsets and of errors."""
    figure, panels, axes = map_axes(len(maps), maps[0].delta.shape, curve=True)
    assert axes is not None
    for panel, offset in zip(panels, maps, strict=True):
        unit = unit_for([offset.sigma.median], "px")
        label = f"σ of {SYMBOLS[offset.name]} ({unit.label})"
        draw_panel(figure, panel, offset.sigma, label, factor=unit.factor)
    unit = unit_for([offset.delta.robust_std for offset in maps], "px")
    for offset, colour in zip(maps, LINES, strict=False):
        _histogram(axes, offset, unit, colour)
    axes.set_yscale("log")
    axes.set_ylim(bottom=0.5)
    axes.set(xlabel=f"offset ({unit.label})", ylabel="pixels per bin")
    finish(axes)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=9, loc="upper right", framealpha=0.9)
    return figure


def _histogram(axes: Axes, offset: MapContents, unit: Unit, colour: str) -> None:
    delta, symbol = offset.delta, SYMBOLS[offset.name]
    values = delta.sample.astype(float) * unit.factor
    spread, middle = delta.robust_std * unit.factor, delta.median * unit.factor
    noise = offset.sigma.median * unit.factor
    if not (len(values) and spread > 0):
        return
    bins = int(np.clip(np.sqrt(len(values)) / 1.5, 15, 120))
    edges = np.linspace(middle - 6 * spread, middle + 6 * spread, bins + 1)
    count, _ = np.histogram(values, edges)
    axes.stairs(count, edges, color=colour, linewidth=1.5, label=f"{symbol}, pixels")
    at = np.linspace(edges[0], edges[-1], 400)
    top = len(values) * (edges[1] - edges[0]) / (np.sqrt(2 * np.pi) * spread)
    normal = top * np.exp(-(((at - middle) / spread) ** 2) / 2)
    axes.plot(
        at, np.maximum(normal, 0.1), color=colour, linewidth=1.0,
        ls="--", label=f"normal, σ = {spread:.3g} (robust)",
    )  # fmt: skip
    if np.isfinite(noise) and noise > 0:
        axes.axvspan(
            middle - noise, middle + noise, color=colour, alpha=0.25, linewidth=0,
            label=f"noise, ±1σ = ±{noise:.3g}",
        )  # fmt: skip


def power(maps: Sequence[MapContents], vectors: Mapping[str, tuple[float, float]]) -> Figure:
    """Power spectra of maps in two dimensions, and their means over rings and along the axes.

    Parameters
    ----------
    maps : sequence of MapContents
        With spectra.
    vectors : mapping
        Fringe vector (kx, ky), rad/px, of each set.
    """
    top = 0.35 + 0.2 * max(len(vectors), 1)
    figure, panels, axes = map_axes(len(maps), (1, 1), curve=True, top=top)
    assert axes is not None
    for panel, offset, colour in zip(panels, maps, LINES, strict=False):
        assert offset.spectrum is not None
        _spectrum_map(figure, panel, offset.spectrum, vectors)
        _spectrum_lines(axes, SYMBOLS[offset.name], offset.spectrum, colour)
        panel.set_ylabel(f"{SYMBOLS[offset.name]}: fy (cycles/px)")
    for vector in vectors.values():
        for order in (1, 2):
            f = _folded(np.array([order * v / (2 * np.pi) for v in vector]))
            axes.axvline(float(np.hypot(*f)), color=GREY, ls=":", linewidth=1)
    axes.set_yscale("log")
    axes.set_xlim(0, 0.5)
    axes.set(xlabel="spatial frequency (cycles/px)", ylabel="power (px² per (cycle/px)²)")
    finish(axes)
    axes.legend(fontsize=8.5, framealpha=0.9, ncols=len(maps), loc="upper right")
    return figure


def _spectrum_map(
    figure: Figure, axes: Axes, spectrum: Spectrum, vectors: Mapping[str, tuple[float, float]]
) -> None:
    relative = spectrum.power / spectrum.white if spectrum.white > 0 else spectrum.power
    positive = relative[relative > 0]
    low, high = np.percentile(positive, [1, 99.9]) if len(positive) else (0.1, 10.0)
    fy, fx = spectrum.frequencies
    drawn = axes.imshow(
        np.where(relative > 0, relative, np.nan), origin="lower", aspect="equal",
        interpolation="nearest", cmap=SEQUENTIAL, norm=LogNorm(low, max(high, 3 * low)),
        extent=(*_edges(fx), *_edges(fy)),
    )  # fmt: skip
    for n, (label, vector) in enumerate(vectors.items()):
        _mark(axes, vector, label, MARKS[n % len(MARKS)])
    axes.set(xlabel="fx (cycles/px)", xlim=(-0.5, 0.5), ylim=(-0.5, 0.5))
    add_bar(figure, axes, drawn, "power / white noise", "both")
    if vectors:
        axes.legend(
            fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False,
        )  # fmt: skip


def _mark(axes: Axes, vector: tuple[float, float], label: str, colour: str) -> None:
    for order, marker in ((1, "o"), (2, "s")):
        f = np.array([order * v / (2 * np.pi) for v in vector])
        both = _folded(np.stack([f, -f]))
        axes.plot(
            both[:, 0], both[:, 1], marker, color=colour, fillstyle="none", markersize=11,
            markeredgewidth=1.6, ls="none",
            label=f"{label}: {'fringes' if order == 1 else 'twice'}",
        )  # fmt: skip


def _folded(frequency: F64) -> F64:
    """Frequencies as they appear on the grid of pixels, in ±1/2."""
    return np.asarray((frequency + 0.5) % 1 - 0.5)


def _spectrum_lines(axes: Axes, symbol: str, spectrum: Spectrum, colour: str) -> None:
    fy, fx = spectrum.frequencies
    my, mx = len(fy), len(fx)
    for f, cut, style, label in (
        (fx, spectrum.power[my // 2], "-", "along fx (means of columns)"),
        (fy, spectrum.power[:, mx // 2], "--", "along fy (means of rows)"),
    ):
        look: Any = {"color": colour, "linewidth": 0.8, "alpha": 0.7, "ls": style}
        axes.plot(f[f > 0], cut[f > 0], label=f"{symbol} {label}", **look)
    axes.plot(*spectrum.radial(), color=colour, linewidth=2, label=f"{symbol}, mean over rings")
    if spectrum.white > 0:
        label = f"{symbol}, white noise of σ"
        axes.axhline(spectrum.white, color=colour, ls=(0, (6, 3)), linewidth=1.6, label=label)


def _edges(f: F64) -> tuple[float, float]:
    half = 0.5 / len(f)
    return float(f[0] - half), float(f[-1] + half)


def map_grid(panels: Sequence[tuple[str, str, MapSummary]]) -> Figure:
    """Maps two a row, each with its own scale: (title, unit, summary)."""
    figure, axes, _ = map_axes(len(panels), panels[0][2].shape)
    for panel, (title, unit, summary) in zip(axes, panels, strict=True):
        draw_panel(figure, panel, summary, unit, title)
    return figure


def levels(sets: Sequence[SetContents]) -> Figure:
    """Mean level and visibility of the sets, a row each."""
    return map_grid(
        [
            panel
            for s in sets
            for panel in (
                (f"{s.name}: mean level ι", "e⁻", s.iota),
                (f"{s.name}: visibility α/ι", "α/ι", s.visibility),
            )
        ]
    )


def flags(masks: Mapping[str, FlagSummary]) -> Figure:
    """Maps of flags side by side; those that are the same are drawn once.

    Pixel by pixel each flag has its colour; of larger maps the share of masked pixels is shown.
    """
    panels = _merge_same(masks)
    ny, nx = panels[0][1].shape
    columns = min(3, max(2, len(panels)))
    rows = -(-len(panels) // columns)
    tall = float(np.clip(8.4 / columns * ny / nx, 1.4, 4.6))
    whole = panels[0][1].block == 1
    bottom, top = 1.0 if whole else 0.6, 0.15 + 0.2 * max(t.count("\n") + 1 for t, _ in panels)
    height = rows * (tall + top) + (rows - 1) * 0.6 + bottom
    figure, grid = axes_grid((WIDE, height), rows, columns,
        right=0.2 if whole else 1.4, bottom=bottom, top=top, between=top + 0.6,
    )  # fmt: skip
    for axes in grid.ravel()[len(panels) :]:
        axes.set_visible(False)
    most = 100 * max(float(s.share.max()) for _, s in panels)
    drawn = None
    for axes, (title, summary) in zip(grid.ravel(), panels, strict=False):
        drawn = _draw_classes(axes, summary) if whole else _draw_share(axes, summary, most)
        axes.set(xlim=(-0.5, summary.shape[1] - 0.5), ylim=(-0.5, summary.shape[0] - 0.5))
        square(axes, summary.shape)
        axes.set_title(title, **TITLE)
        axes.set(xlabel="x (px)", ylabel="y (px)")
    if whole:
        handles = [Patch(color=FLAGS[f.value], label=flag_name(f)) for f in PixelFlag]
        handles.append(Patch(color=SEVERAL, label="several"))
        figure.legend(handles=handles, loc="lower center", ncols=8, frameon=False, fontsize=9.5)
    elif drawn is not None:
        bar = figure.colorbar(
            drawn, cax=place(figure, WIDE - 1.1, bottom, 0.2, height - bottom - top)
        )
        bar.set_label(f"masked (%)\nof {panels[0][1].block} × {panels[0][1].block} px")
    return figure


def _merge_same(masks: Mapping[str, FlagSummary]) -> list[tuple[str, FlagSummary]]:
    merged: dict[tuple[bytes, tuple[int, ...]], tuple[list[str], FlagSummary]] = {}
    for title, summary in masks.items():
        key = (summary.image.tobytes(), tuple(summary.counts.values()))
        merged.setdefault(key, ([], summary))[0].append(title)
    return [("\n".join(titles), summary) for titles, summary in merged.values()]


def _draw_classes(axes: Axes, summary: FlagSummary) -> ScalarMappable:
    several = len(FLAGS) + 1
    palette = ListedColormap([UNFLAGGED, *FLAGS.values(), SEVERAL])
    return axes.imshow(
        _classes(summary.image), cmap=palette, vmin=-0.5, vmax=several + 0.5, origin="lower",
        aspect="auto", interpolation="nearest", extent=covered(summary.image.shape, 1),
    )  # fmt: skip


def _draw_share(axes: Axes, summary: FlagSummary, top: float) -> ScalarMappable:
    return axes.imshow(
        100 * summary.share, cmap=SEQUENTIAL, vmin=0, vmax=top or 1, origin="lower",
        aspect="auto", interpolation="nearest",
        extent=covered(summary.share.shape, summary.block),
    )  # fmt: skip


def _classes(image: NDArray[np.uint8]) -> NDArray[np.int64]:
    """0 for good, 1 + bit for one flag, one more than all bits for several."""
    bits = np.unpackbits(image[..., None], axis=-1, bitorder="little").astype(np.int64)
    count = bits.sum(axis=-1)
    return np.where(count > 1, len(FLAGS) + 1, (bits * np.arange(1, 9)).sum(axis=-1))
