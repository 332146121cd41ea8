"""The two sides of a comparison: fitted runs, or parts of one, read tile by tile.

A side gives the offset along any direction that its fringe sets measure, its variance, and the
modes that this side's fit took off, as they come out in that direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.combine import (
    axes_span_plane,
    combine_parallel,
    combine_sets,
    weighted_mean,
)
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.fringe_fit.models import FringeShape
from pixcal.model.errors import InputError
from pixcal.stages.fitted_shape import fitted_shape
from pixcal.storage.artefact import read_json
from pixcal.storage.cube import ArrayReader
from pixcal.storage.stage import read_acquisition, require

F64 = NDArray[np.float64]
Range = tuple[int, int]
Tile = tuple[Range, Range]
Vector = tuple[float, float]

PART_OF = 1e-3  # a set whose share in a direction is below this brings no modes of its own there


@dataclass(frozen=True)
class ComparedSet:
    """One fringe set of a fitted run."""

    name: str
    folder: Path  # `fit.zarr/<set name>`
    shape: FringeShape  # of the fringes, as fitted
    batches: tuple[int, ...] | None = None  # those that count; None for the whole run

    def vector(self, tile: Tile) -> Vector:
        """Fringe vector (kx, ky) at the middle of a tile, rad/px."""
        (y0, y1), (x0, x1) = tile
        return self.shape.vector((y0 + y1 - 1) / 2, (x0 + x1 - 1) / 2)

    def axis(self, tile: Tile) -> Vector:
        """Unit vector along which the set measures."""
        kx, ky = self.vector(tile)
        return kx / float(np.hypot(kx, ky)), ky / float(np.hypot(kx, ky))

    def delta(self, tile: Tile) -> tuple[F64, F64]:
        """Offset along the axis and its error (y, x), px; NaN where there is none."""
        if self.batches is None:
            delta, sigma = (self._map(name, tile) for name in ("delta", "sigma"))
            return delta, sigma
        whole = (0, ArrayReader(self.folder / "batch_delta").shape[0])
        chosen = list(self.batches)
        delta, sigma = (
            ArrayReader(self.folder / f"batch_{name}").read(whole, *tile)[chosen].astype(float)
            for name in ("delta", "sigma")
        )
        mean, error, _ = weighted_mean(delta, sigma)
        return mean, error

    def modes(self, tile: Tile) -> F64:
        """What the fit took off the set's map, (mode, y, x), px but for a factor."""
        (y0, y1), (x0, x1) = tile
        y, x = np.arange(y0, y1, dtype=float)[:, None], np.arange(x0, x1, dtype=float)[None, :]
        iota, alpha = self._map("iota", tile), self._map("alpha", tile)
        lit = (alpha > 0) & (iota > 0)
        ratio = float(np.median(iota[lit] / alpha[lit])) if lit.any() else 1.0
        gauge = fringe_modes(self.shape.phase(y, x), np.asarray(ratio))
        both = np.concatenate([self.shape.modes(y, x), np.stack(gauge)])
        return np.asarray(both / np.hypot(*self.vector(tile)))

    def _map(self, name: str, tile: Tile) -> F64:
        return ArrayReader(self.folder / name).read(*tile).astype(float)


@dataclass(frozen=True)
class SideTile:
    """A part of one side along one direction."""

    delta: F64  # delta, variance: (y, x) px and px²; NaN where there is none
    variance: F64
    modes: F64  # (mode, y, x)


@dataclass(frozen=True)
class Side:
    """One side of a comparison."""

    label: str
    run: Path
    key: str  # of its fit
    sets: tuple[ComparedSet, ...]
    window: tuple[int, int]  # (y, x), px
    chunk: tuple[int, int]  # of its maps on disk
    facts: dict[str, Any]  # what to say of it

    @property
    def whole(self) -> Tile:
        """The window as one tile."""
        return (0, self.window[0]), (0, self.window[1])

    @property
    def axes(self) -> list[Vector]:
        """Of the sets, at the middle of the window."""
        return [s.axis(self.whole) for s in self.sets]

    @property
    def both(self) -> bool:
        """Whether it measures both components."""
        return axes_span_plane(self.axes)

    def sets_along(self, direction: Vector) -> tuple[ComparedSet, ...]:
        """The sets whose modes contribute along a direction."""
        ones = np.ones((len(self.sets), 1))
        shares = self._shares(self.axes, ones, direction)
        return tuple(
            s for s, share in zip(self.sets, shares[:, 0], strict=True) if abs(share) > PART_OF
        )

    def read(self, tile: Tile, direction: Vector) -> SideTile:
        """Offset along a unit vector (x, y), its variance, and its modes, on a tile."""
        offsets = [s.delta(tile) for s in self.sets]
        delta, sigma = (np.stack([f[n] for f in offsets]) for n in (0, 1))
        shares = self._shares([s.axis(tile) for s in self.sets], sigma, direction)
        lacking = ~np.isfinite(shares).all(axis=0)
        known = np.isfinite(sigma)
        value = np.where(known, shares * np.where(known, delta, 0.0), 0.0).sum(axis=0)
        variance = np.where(known, (shares * np.where(known, sigma, 0.0)) ** 2, 0.0).sum(axis=0)
        used = self.sets_along(direction)
        modes = np.concatenate(
            [
                np.nan_to_num(share) * s.modes(tile)
                for share, s in zip(shares, self.sets, strict=True)
                if s in used
            ]
        )
        return SideTile(
            np.where(lacking, np.nan, value), np.where(lacking, np.nan, variance), modes
        )

    def _shares(self, axes: Sequence[Vector], sigma: F64, direction: Vector) -> F64:
        """Weight of each set along a direction (set, ...), as in the fit."""
        shares = np.empty_like(sigma)
        for n in range(len(axes)):
            unit = np.zeros_like(sigma)
            unit[n] = 1.0
            if self.both:
                x, y = combine_sets(axes, unit, sigma)[0]
                shares[n] = direction[0] * x + direction[1] * y
            else:
                # The mean of parallel sets has the sign of the first.
                sign = np.sign(np.dot(axes[0], direction))
                shares[n] = sign * combine_parallel(axes, unit, sigma)[0]
        return shares


def whole_run(run: Path, label: str | None = None) -> Side:
    """A fitted run as a side.

    Raises
    ------
    InputError
        If the run has not been fitted, or by a model that this comparison does not know.
    """
    manifest = require(run, "fit")
    result = read_json(run / "fit" / "fit.json")
    acquisition = read_acquisition(run)
    group = run / "fit" / "fit.zarr"
    first = ArrayReader(group / next(iter(result["sets"])) / "delta")
    window = (first.shape[0], first.shape[1])
    sets = tuple(
        ComparedSet(name, group / name, fitted_shape(run, facts, acquisition, window))
        for name, facts in result["sets"].items()
    )
    about_sets = {
        name: {key: facts[key] for key in ("frames", "interfringe_px", "model", "axis")}
        for name, facts in result["sets"].items()
    }
    facts = {"run": str(run), "key": manifest.key, "sets": about_sets}
    return Side(
        label or run.name or str(run), run, manifest.key, sets, window,
        (first.chunks[0], first.chunks[1]), facts,
    )  # fmt: skip


def parts_of(run: Path, *, interleaved: bool) -> tuple[Side, Side]:
    """Two parts of a run: the first and the second half of its batches, or every other one.

    Raises
    ------
    InputError
        If the run has not been fitted, or a set has fewer than two batches.
    """
    side = whole_run(run)
    labels = ("odd batches", "even batches") if interleaved else ("first half", "second half")
    halves: list[list[ComparedSet]] = [[], []]
    counts: list[dict[str, int]] = [{}, {}]
    for s in side.sets:
        count = ArrayReader(s.folder / "batch_count").read()
        filled = np.flatnonzero(count > 0)
        if len(filled) < 2:
            raise InputError(
                f"{run}: set {s.name!r} has too few batches of frames ({len(filled)}) to be "
                "compared with itself; name two runs, or take more frames"
            )
        middle = len(filled) // 2
        chosen = (filled[::2], filled[1::2]) if interleaved else (filled[:middle], filled[middle:])
        for n, batches in enumerate(chosen):
            halves[n].append(replace(s, batches=tuple(int(b) for b in batches)))
            counts[n][s.name] = int(count[batches].sum())
    first, second = (
        replace(
            side,
            label=f"{side.label}, {label}",
            sets=tuple(sets),
            facts=side.facts | {"part": label, "frames_of_part": frames},
        )
        for label, sets, frames in zip(labels, halves, counts, strict=True)
    )
    return first, second
