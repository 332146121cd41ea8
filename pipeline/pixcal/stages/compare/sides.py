"""The two sides of a comparison: fitted runs, or parts of one, read tile by tile.

A side gives the offset along any direction that its fringe sets measure, its variance, and the
modes removed by its fit, projected on that direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.estimators.fringe_fit import combine
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.fringe_fit.shapes import FringeShape
from pixcal.model.arrays import F64
from pixcal.model.errors import InputError
from pixcal.stages.fitted_shape import fitted_shape
from pixcal.stages.tiles import Part as Tile
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import read_json
from pixcal.storage.stage import read_acquisition, require

Vector = tuple[float, float]

PART_OF = 1e-3  # least share of a set in a direction to include its modes there


def _middle(tile: Tile) -> Vector:
    """(y, x), px."""
    (y0, y1), (x0, x1) = tile
    return (y0 + y1 - 1) / 2, (x0 + x1 - 1) / 2


@dataclass(frozen=True)
class ComparedSet:
    """One fringe set of a fitted run."""

    name: str
    folder: Path  # `fit.zarr/<set name>`
    shape: FringeShape  # of the fringes, as fitted
    batches: tuple[int, ...] | None = None  # batches to use; None for the whole run

    def axis(self, tile: Tile) -> Vector:
        """Unit vector along which the set measures, at the middle of a tile."""
        return self.shape.axis(*_middle(tile))

    def delta(self, tile: Tile) -> tuple[F64, F64]:
        """Offset along the axis and its error (y, x), px; NaN without data."""
        if self.batches is None:
            return self._map("delta", tile), self._map("sigma", tile)
        readers = [ArrayReader(self.folder / f"batch_{name}") for name in ("delta", "sigma")]
        delta, sigma = (
            r.read((0, r.shape[0]), *tile)[list(self.batches)].astype(float) for r in readers
        )
        return combine.weighted_mean(delta, sigma)[:2]

    def modes(self, tile: Tile) -> F64:
        """Modes that the fit removed from the set's map, (mode, y, x), px up to a factor."""
        (y0, y1), (x0, x1) = tile
        y, x = np.arange(y0, y1, dtype=float)[:, None], np.arange(x0, x1, dtype=float)[None, :]
        iota, alpha = self._map("iota", tile), self._map("alpha", tile)
        lit = (alpha > 0) & (iota > 0)
        ratio = float(np.median(iota[lit] / alpha[lit])) if lit.any() else 1.0
        gauge = fringe_modes(self.shape.phase(y, x), np.asarray(ratio))
        both = np.concatenate([self.shape.modes(y, x), np.stack(gauge)])
        return np.asarray(both / np.hypot(*self.shape.vector(*_middle(tile))))

    def _map(self, name: str, tile: Tile) -> F64:
        return ArrayReader(self.folder / name).read(*tile).astype(float)


@dataclass(frozen=True)
class Side:
    """One side of a comparison."""

    label: str
    run: Path
    key: str  # of its fit
    sets: tuple[ComparedSet, ...]
    window: tuple[int, int]  # (y, x), px
    chunk: tuple[int, int]  # of its maps on disk
    facts: dict[str, Any]  # its description in the results

    @property
    def axes(self) -> list[Vector]:
        """Axes of the sets, at the middle of the window."""
        return [s.axis(((0, self.window[0]), (0, self.window[1]))) for s in self.sets]

    @property
    def both(self) -> bool:
        """Whether it measures both components."""
        return combine.axes_span_plane(self.axes)

    def sets_along(self, direction: Vector) -> list[ComparedSet]:
        """The sets whose modes contribute along a direction."""
        shares = self._shares(self.axes, np.ones((len(self.sets), 1)), direction)
        return [s for s, share in zip(self.sets, shares, strict=True) if abs(share) > PART_OF]

    def read(self, tile: Tile, direction: Vector) -> tuple[F64, F64, F64]:
        """Offset along a vector (x, y), px, NaN where none; variance, px²; modes (mode, y, x)."""
        offsets = [s.delta(tile) for s in self.sets]
        delta, sigma = (np.stack(maps) for maps in zip(*offsets, strict=True))
        shares = self._shares([s.axis(tile) for s in self.sets], sigma, direction)
        # A set without an offset at a pixel has zero weight there.
        parts = np.where(np.isfinite(sigma), [shares * delta, (shares * sigma) ** 2], 0.0)
        lacking = ~np.isfinite(shares).all(axis=0)
        value, variance = np.where(lacking, np.nan, parts.sum(axis=1))
        used = self.sets_along(direction)
        known = zip(np.nan_to_num(shares), self.sets, strict=True)
        modes = np.concatenate([share * s.modes(tile) for share, s in known if s in used])
        return value, variance, modes

    def _shares(self, axes: Sequence[Vector], sigma: F64, direction: Vector) -> F64:
        """Weight of each set along a direction (set, ...), as in the fit."""
        shares = np.empty_like(sigma)
        for n in range(len(axes)):
            unit = np.zeros_like(sigma)
            unit[n] = 1.0
            if self.both:
                shares[n] = np.tensordot(direction, combine.combine_sets(axes, unit, sigma)[0], 1)
            else:
                # The mean of parallel sets has the sign of the first.
                sign = np.sign(np.dot(axes[0], direction))
                shares[n] = sign * combine.combine_parallel(axes, unit, sigma)[0]
        return shares


def whole_run(run: Path, label: str | None = None) -> Side:
    """A fitted run as a side."""
    key = require(run, "fit").key
    fitted = read_json(run / "fit" / "fit.json")["sets"]
    acquisition = read_acquisition(run)
    group = run / "fit" / "fit.zarr"
    first = ArrayReader(group / next(iter(fitted)) / "delta")
    (ny, nx), (cy, cx) = first.shape, first.chunks
    sets = tuple(
        ComparedSet(name, group / name, fitted_shape(run, facts, acquisition, (ny, nx)))
        for name, facts in fitted.items()
    )
    said = ("frames", "interfringe_px", "model", "axis")
    about_sets = {name: {key: facts[key] for key in said} for name, facts in fitted.items()}
    facts = {"run": str(run), "key": key, "sets": about_sets}
    return Side(label or run.name or str(run), run, key, sets, (ny, nx), (cy, cx), facts)


def parts_of(run: Path, *, interleaved: bool) -> list[Side]:
    """Two parts of a run: the first and the second half of its batches, or every other one."""
    side = whole_run(run)
    labels = ("odd batches", "even batches") if interleaved else ("first half", "second half")
    counts = {s.name: ArrayReader(s.folder / "batch_count").read() for s in side.sets}
    filled = {name: np.flatnonzero(count > 0) for name, count in counts.items()}
    for name, batches in filled.items():
        if len(batches) < 2:
            raise InputError(
                f"{run}: set {name!r} has too few batches of frames ({len(batches)}) to be "
                "compared with itself; name two runs, or take more frames"
            )
    parts = []
    for n, label in enumerate(labels):
        chosen = {
            name: batches[n::2] if interleaved else np.split(batches, [len(batches) // 2])[n]
            for name, batches in filled.items()
        }
        sets = tuple(replace(s, batches=tuple(chosen[s.name].tolist())) for s in side.sets)
        frames = {name: int(counts[name][batches].sum()) for name, batches in chosen.items()}
        facts = side.facts | {"part": label, "frames_of_part": frames}
        parts.append(replace(side, label=f"{side.label}, {label}", sets=sets, facts=facts))
    return parts
