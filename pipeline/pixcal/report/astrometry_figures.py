"""The figure of star centroids: a table, errors against electrons and positions, and error maps."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.transforms import Bbox

from pixcal.model.arrays import F64
from pixcal.report.colours import BLUE, DIVERGING, GREEN, GREY, INK, RED, SEQUENTIAL
from pixcal.report.drawing import WIDE, Unit, draw_blocks, finish, new_figure, second_axis, unit_for

PERFECT, MEASURED = RED, BLUE
LABELS = {"perfect": "perfect grid", "measured": "measured maps"}
COLOURS = {"perfect": PERFECT, "measured": MEASURED}


@dataclass(frozen=True)
class AstrometryView:
    """Contents of the figure."""

    result: Mapping[str, Any]  # `astrometry.json`
    target_px: float  # requirement of the mission
    # rows: case, axis, error on a perfect grid, error with the maps, gain
    table: Sequence[Sequence[str]]
    photons: F64  # (2, n) electrons, and the bound of a centroid from photon noise, px
    weights: F64  # (y, x) weight of each pixel along the first axis of a centred star, sum 1
    # (grid, y, x) error along the first axis of a star in the middle of each pixel, px; NaN
    # without a star
    detail: F64
    detail_at: tuple[int, int]  # first row and column of it
    rms: F64  # (grid, y, x) of the errors, over blocks of the whole detector, px
    block: int  # side of the blocks, px

    @property
    def first(self) -> Mapping[str, Any]:
        """Entry of the first axis."""
        return dict(next(iter(self.result["axes"].values())))

    @property
    def uas_per_px(self) -> float:
        """Plate scale."""
        return float(self.result["telescope"]["uas_per_px"])


def astrometry_figure(view: AstrometryView) -> Figure:
    """Table; errors against electrons and positions, and the weights; maps of the errors."""
    figure = new_figure(WIDE, 14.6)
    rows: Any = figure.subfigures(4, 1, height_ratios=[0.95, 0.95, 1.05, 1.05])
    _table(rows[0].subplots(), view)
    left, middle, right = rows[1].subplots(1, 3, width_ratios=[1.25, 1.1, 0.9])
    _against_electrons(left, view)
    _against_positions(middle, view)
    _weights(rows[1], right, view)
    _detail(rows[2], view)
    _everywhere(rows[3], view)
    return figure


def _table(axes: Axes, view: AstrometryView) -> None:
    axes.set_axis_off()
    header = ["error of a star's centroid", "along", *LABELS.values(), "gain"]
    drawn = axes.table(
        view.table,
        colLabels=header,
        cellLoc="left",
        colLoc="left",
        edges="horizontal",
        colWidths=[0.21, 0.07, 0.3, 0.3, 0.12],
        bbox=Bbox.from_bounds(0.01, 0, 0.98, 1),
    )
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(9)
    for (row, column), cell in drawn.get_celld().items():
        colour = {2: PERFECT, 3: MEASURED}.get(column, INK)
        cell.set_text_props(color=colour, weight="bold" if column == 4 or not row else "normal")
        cell.set_edgecolor("#d9dee5")
    axes.set_title(_facts(view), fontsize=9.5, color=INK, loc="left", x=0.01)


def _facts(view: AstrometryView) -> str:
    t, s = view.result["telescope"], view.result["stars"]
    bound = view.first["photon_bound"]
    return (
        f"{t['diameter_m']:g} m telescope, {t['focal_length_m']:g} m focal length, "
        f"{t['wavelength_nm']:g} nm: {t['uas_per_px'] / 1e3:.3g} mas/px, "
        f"{t['px_per_lambda_over_d']:.3g} px in λ/D\n"
        f"{s['number']} stars, {s['positions']} positions each, {s['window_px']} × "
        f"{s['window_px']} px fitted; photon noise alone {bound['px']:.3g} px, "
        f"{bound['uas']:.3g} µas per position\n"
        f"pixels of the simulated detector: {view.result['detector']['pixels']}"
    )


def _floors(view: AstrometryView) -> dict[str, float]:
    """Errors without photon noise, px, those that are known."""
    floors = {grid: view.first["floor"][grid]["px"] for grid in LABELS}
    return {grid: float(value) for grid, value in floors.items() if value is not None}


def _against_electrons(axes: Axes, view: AstrometryView) -> None:
    electrons, photons = view.photons
    axes.loglog(electrons, photons, color=GREY, lw=1, ls="--", label="photon noise alone")
    for grid, floor in _floors(view).items():
        axes.loglog(
            electrons, np.hypot(floor, photons), color=COLOURS[grid], lw=1.6, label=LABELS[grid]
        )
        errors = view.first["photons"][grid]
        if errors["px"] is not None:
            style: Any = {"fmt": "o", "color": COLOURS[grid], "ms": 5}
            stars = view.result["stars"]["electrons"]
            axes.errorbar(stars, errors["px"], yerr=errors["err_px"], **style)
    axes.axhline(view.target_px, color=GREEN, lw=1, label=f"target, {view.target_px:g} px")
    lowest = min([view.target_px, *(f for f in _floors(view).values() if f > 0)])
    axes.set(xlim=(electrons[0], electrons[-1]), ylim=(0.3 * lowest, 20 * float(photons[0])))
    axes.set(xlabel="photo-electrons of the star (e-)", ylabel="error, one position (px)")
    axes.legend(fontsize=7.5, loc="upper right", framealpha=0.95)
    _finish_with_sky(axes, view)


def _against_positions(axes: Axes, view: AstrometryView) -> None:
    averaging = view.first["averaging"]
    positions = np.array(averaging["positions"], dtype=float)
    values: list[float] = [view.target_px]
    for grid, label in LABELS.items():
        px = np.array(averaging[f"{grid}_px"], dtype=float)
        error = np.nan_to_num(np.array(averaging[f"{grid}_err_px"], dtype=float))
        known = np.isfinite(px)
        if not known.any():
            continue
        style: Any = {"fmt": "o-", "color": COLOURS[grid], "ms": 4, "lw": 1, "label": label}
        axes.errorbar(positions[known], px[known], yerr=error[known], **style)
        first = np.flatnonzero(known)[0]
        independent = px[first] * np.sqrt(positions[first] / positions)
        axes.plot(positions, independent, color=COLOURS[grid], lw=0.8, ls=":")
        values += px[known].tolist()
    axes.axhline(view.target_px, color=GREEN, lw=1)
    axes.set_xscale("log", base=2)
    axes.set(yscale="log", ylim=(0.4 * min(values), 2 * max(values)))
    axes.set_xticks(positions, [f"{n:g}" for n in positions])
    axes.minorticks_off()
    axes.set(
        xlabel="positions averaged (dotted: independent)", ylabel="error with photon noise (px)"
    )
    _finish_with_sky(axes, view)


def _finish_with_sky(axes: Axes, view: AstrometryView) -> None:
    finish(axes)
    second_axis(axes, "right", view.uas_per_px).set_ylabel("µas", labelpad=1)


def _weights(figure: SubFigure, axes: Axes, view: AstrometryView) -> None:
    half = view.weights.shape[0] // 2
    top = float(np.max(np.abs(view.weights)))
    drawn = draw_blocks(axes, view.weights, 1, (-half, -half), cmap=DIVERGING, vmin=-top, vmax=top)
    name = next(iter(view.result["axes"]))
    axes.set(xlabel="px from the star", title=f"weight of a pixel's offset, {name}")
    axes.title.set_fontsize(9.5)
    figure.colorbar(drawn, ax=axes, location="bottom", shrink=0.9)


def _detail(figure: SubFigure, view: AstrometryView) -> None:
    panels: Any = figure.subplots(1, 2)
    finite = np.abs(view.detail[np.isfinite(view.detail)])
    top = float(np.quantile(finite, 0.99)) if finite.size else 1.0
    unit = unit_for([top], "px")
    span: Any = {"cmap": DIVERGING, "vmin": -unit.factor * top, "vmax": unit.factor * top}
    for axes, image, grid in zip(panels, view.detail, LABELS, strict=True):
        drawn = draw_blocks(axes, unit.factor * image, 1, view.detail_at, **span)
        _map_labels(axes, f"error of a star at each place, {LABELS[grid]}")
    name = next(iter(view.result["axes"]))
    _bar(figure, panels, drawn, unit, f"along {name}")


def _everywhere(figure: SubFigure, view: AstrometryView) -> None:
    panels: Any = figure.subplots(1, 2)
    (height, width), side = view.result["detector"]["shape"], view.block
    for axes, image, grid in zip(panels, view.rms, LABELS, strict=True):
        finite = image[np.isfinite(image)]
        low, high = np.quantile(finite, [0.01, 0.99]) if finite.size else (0.0, 1.0)
        unit = unit_for([high], "px")
        ends = unit.factor * low, unit.factor * max(high, low * 1.001 + 1e-12)
        shown = unit.factor * image
        drawn = draw_blocks(axes, shown, side, cmap=SEQUENTIAL, vmin=ends[0], vmax=ends[1])
        axes.set(xlim=(-0.5, width - 0.5), ylim=(-0.5, height - 0.5))
        _map_labels(axes, f"rms of {side} × {side} px, {LABELS[grid]}")
        _bar(figure, axes, drawn, unit, "rms")


def _map_labels(axes: Axes, title: str) -> None:
    axes.set(xlabel="x (px)", ylabel="y (px)", title=title)
    axes.title.set_fontsize(9.5)


def _bar(figure: SubFigure, axes: Any, drawn: Any, unit: Unit, label: str) -> None:
    figure.colorbar(drawn, ax=axes, pad=0.02).set_label(f"{label} ({unit.label})")
