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
    GREEN,
    GREY,
    INK,
    MARKS,
    RED,
    SEQUENTIAL,
    SEVERAL,
    UNFLAGGED,
)
from pixcal.report.contents import MapContents
from pixcal.report.drawing import (
    TITLE,
    WIDE,
    ColourScale,
    Unit,
    add_bar,
    axes_grid,
    bare_figure,
    block_note,
    covered,
    draw_map,
    finish,
    fit_box,
    limits,
    place,
    span_scale,
    symmetric_scale,
    unit_for,
)
from pixcal.report.summary import FlagSummary, MapSummary, Profile, Spectrum
from pixcal.report.text import SYMBOLS, flag_name

F64 = NDArray[np.float64]

# room between a map and what is beside it, for a colour bar, its numbers and labels, inches
BESIDE_BAR = 1.95
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
    figure = bare_figure(WIDE, total)
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


def errors_and_histogram(offset: MapContents) -> Figure:
    """The map of errors, and the histograms of offsets and of errors."""
    sigma = offset.sigma
    figure, ((left, right),) = axes_grid(
        (WIDE, 4.5), 1, 2, beside=BESIDE_BAR, width_ratios=[1, 1.15]
    )
    unit = unit_for([sigma.median], "px")
    scale = span_scale(sigma.image * unit.factor)
    drawn = draw_map(left, sigma, scale, unit.factor)
    _square(left, sigma.shape)
    left.set(xlabel="x (px)", ylabel="y (px)")
    label = _with_note(f"σ of {SYMBOLS[offset.name]} ({unit.label})", sigma)
    add_bar(figure, left, drawn, label, scale.beyond)
    _histogram(right, offset)
    return figure


def _histogram(axes: Axes, offset: MapContents) -> None:
    delta, symbol = offset.delta, SYMBOLS[offset.name]
    unit = unit_for([delta.robust_std], "px")
    values = delta.sample.astype(float) * unit.factor
    spread, middle = delta.robust_std * unit.factor, delta.median * unit.factor
    noise = offset.sigma.median * unit.factor
    if len(values) and spread > 0:
        reach = 6 * spread
        number = int(np.clip(np.sqrt(len(values)) / 1.5, 15, 120))
        edges = np.linspace(middle - reach, middle + reach, number + 1)
        count, _ = np.histogram(values, edges)
        axes.stairs(count, edges, fill=True, color=BAR, edgecolor=BLUE, label=f"{symbol}, pixels")
        at = np.linspace(edges[0], edges[-1], 400)
        top = len(values) * (edges[1] - edges[0]) / (np.sqrt(2 * np.pi) * spread)
        axes.plot(
            at, top * np.exp(-(((at - middle) / spread) ** 2) / 2), color=INK, linewidth=1.4,
            label=f"normal, σ = {spread:.3g} (robust)",
        )  # fmt: skip
        if np.isfinite(noise) and noise > 0:
            axes.axvspan(
                middle - noise, middle + noise, color=RED, alpha=0.3, linewidth=0,
                label=f"noise, ±1σ = ±{noise:.3g}",
            )  # fmt: skip
        axes.set_yscale("log")
        axes.set_ylim(0.5, 30 * max(float(count.max()), top, 1.0))
    axes.set(xlabel=f"{symbol} ({unit.label})", ylabel="pixels per bin")
    finish(axes)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=9, loc="upper right", framealpha=0.9)


def power(name: str, spectrum: Spectrum, vectors: Mapping[str, tuple[float, float]]) -> Figure:
    """Power spectrum of a map in two dimensions, and its means over rings and along the axes.

    Parameters
    ----------
    name : str
        Of the map.
    vectors : mapping
        Fringe vector (kx, ky), rad/px, of each set.
    """
    top = 0.3 + 0.2 * max(len(vectors), 1)
    figure, ((left, right),) = axes_grid(
        (WIDE, 4.4 + top), 1, 2, top=top, beside=BESIDE_BAR, width_ratios=[1, 1.1]
    )
    relative = spectrum.power / spectrum.white if spectrum.white > 0 else spectrum.power
    positive = relative[relative > 0]
    low, high = np.percentile(positive, [1, 99.9]) if len(positive) else (0.1, 10.0)
    fy, fx = spectrum.frequencies
    drawn = left.imshow(
        np.where(relative > 0, relative, np.nan), origin="lower", aspect="equal",
        interpolation="nearest", cmap=SEQUENTIAL, norm=LogNorm(low, max(high, 3 * low)),
        extent=(*_edges(fx), *_edges(fy)),
    )  # fmt: skip
    for n, (label, vector) in enumerate(vectors.items()):
        _mark(left, vector, label, MARKS[n % len(MARKS)])
    left.set(xlabel="fx (cycles/px)", ylabel="fy (cycles/px)", xlim=(-0.5, 0.5), ylim=(-0.5, 0.5))
    add_bar(figure, left, drawn, "power / white noise", "both")
    if vectors:
        left.legend(
            fontsize=9, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False,
        )  # fmt: skip
    _power_lines(right, spectrum, vectors)
    right.set_title(f"{SYMBOLS[name]}: means over rings and cuts", **TITLE)
    return figure


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


def _power_lines(
    axes: Axes, spectrum: Spectrum, vectors: Mapping[str, tuple[float, float]]
) -> None:
    fy, fx = spectrum.frequencies
    my, mx = len(fy), len(fx)
    for f, cut, colour, label in (
        (fx, spectrum.power[my // 2], RED, "along fx (means of columns)"),
        (fy, spectrum.power[:, mx // 2], GREEN, "along fy (means of rows)"),
    ):
        up = f > 0
        axes.plot(f[up], cut[up], color=colour, linewidth=0.8, alpha=0.75, label=label)
    ring, mean = spectrum.radial()
    axes.plot(ring, mean, color=BLUE, linewidth=2, label="mean over rings")
    if spectrum.white > 0:
        axes.axhline(spectrum.white, color=INK, ls="--", linewidth=1.3, label="white noise of σ")
    for vector in vectors.values():
        for order in (1, 2):
            f = _folded(np.array([order * v / (2 * np.pi) for v in vector]))
            axes.axvline(float(np.hypot(*f)), color=GREY, ls=":", linewidth=1)
    axes.set_yscale("log")
    axes.set_xlim(0, 0.5)
    axes.set(xlabel="spatial frequency (cycles/px)", ylabel="power (px² per (cycle/px)²)")
    finish(axes)
    axes.legend(fontsize=8.5, framealpha=0.9)


def _edges(f: F64) -> tuple[float, float]:
    half = 0.5 / len(f)
    return float(f[0] - half), float(f[-1] + half)


def map_row(panels: Sequence[tuple[str, str, MapSummary]], *, symmetric: bool = False) -> Figure:
    """Maps side by side, each with its own scale: (title, unit, summary)."""
    ny, nx = panels[0][2].shape
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    tall = float(np.clip(3.2 * ny / nx, 1.2, 4.4))
    figure, grid = axes_grid(
        (WIDE if columns == 2 else WIDE / 2 + 0.5, rows * (tall + 0.9)), rows, columns,
        right=1.2, bottom=0.6, top=0.3, beside=BESIDE_BAR, between=0.9,
    )  # fmt: skip
    for axes in grid.ravel()[len(panels) :]:
        axes.set_visible(False)
    for axes, (title, unit, summary) in zip(grid.ravel(), panels, strict=False):
        scale: ColourScale = (symmetric_scale if symmetric else span_scale)(summary.image)
        drawn = draw_map(axes, summary, scale)
        _square(axes, summary.shape)
        axes.set_title(", ".join(filter(None, (title, block_note(summary)))), **TITLE)
        axes.set(xlabel="x (px)", ylabel="y (px)")
        add_bar(figure, axes, drawn, unit, scale.beyond)
    return figure


def flags(panels: Sequence[tuple[str, FlagSummary]]) -> Figure:
    """Maps of flags side by side; those that are the same are drawn once.

    Pixel by pixel each flag has its colour; of larger maps the share of masked pixels is shown.
    """
    panels = _merge_same(panels)
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
        _square(axes, summary.shape)
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


def _merge_same(panels: Sequence[tuple[str, FlagSummary]]) -> list[tuple[str, FlagSummary]]:
    merged: dict[tuple[bytes, tuple[int, ...]], tuple[list[str], FlagSummary]] = {}
    for title, summary in panels:
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


def _square(axes: Axes, shape: tuple[int, int]) -> None:
    """Square pixels, unless the map is very elongated."""
    ny, nx = shape
    if max(ny, nx) <= 6 * min(ny, nx):
        axes.set_aspect("equal")


def _with_note(label: str, summary: MapSummary) -> str:
    note = block_note(summary)
    return f"{label}\n{note}" if note else label
