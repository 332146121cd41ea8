"""The detector of the simulated stars: true and measured positions of its pixels.

True offsets are the measured ones plus a draw of their errors. The error of a centroid with pixels
at their measured positions comes from the draw alone. Relative to a perfect grid, such a detector
contains the maps' errors twice, which `summary` subtracts. A given truth is used as the detector,
less the modes that are degenerate with the bench (docs/explanation/gauge.md).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.random import default_rng

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.fringe_fit.gauge import fringe_modes
from pixcal.estimators.fringe_fit.shapes import FringeShape
from pixcal.estimators.fringe_fit.shapes.paraxial import Paraxial
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F64, Mask
from pixcal.model.errors import InputError
from pixcal.stages.tiles import Range, spans
from pixcal.storage.products import FitsMap

DRAW_TILE = 64  # side of the tiles of pixels that share a generator of errors, px
LARGEST = 1.0  # largest valid offset, px; pixels beyond are left out
AXES = {"delta_x": ("x", (1.0, 0.0)), "delta_y": ("y", (0.0, 1.0))}
ENOUGH = 4_000_000  # pixels that determine the modes; on larger detectors, bands are left out
BAND = 16  # rows of a task of the fit of the modes


@dataclass(frozen=True)
class DegenerateModes:
    """Modes of all sets' maps that are degenerate with the bench; smooth ones first."""

    shape: tuple[int, int]  # of the detector, (y, x)
    sets: tuple[FringeShape, ...]  # as fitted

    @property
    def n_smooth(self) -> int:
        """Number of smooth modes."""
        return 3 + sum(len(s.names) - 1 for s in self.sets if not s.linear)

    @property
    def number(self) -> int:
        """Number of modes."""
        return self.n_smooth + 4 * len(self.sets)

    def basis(self, y: Range, x: Range) -> F64:
        """All modes (mode, y, x) on a part of the detector."""
        rows, columns = np.arange(*y, dtype=float)[:, None], np.arange(*x, dtype=float)[None, :]
        middle = (self.shape[0] - 1) / 2, (self.shape[1] - 1) / 2
        plane = Paraxial(0.0, 0.0, 0.0, middle, max(self.shape) / 2).modes(rows, columns)
        curved = [s.modes(rows, columns)[1:] for s in self.sets if not s.linear]
        fringes = [fringe_modes(s.phase(rows, columns), np.asarray(1.0)) for s in self.sets]
        return np.concatenate([plane, *curved, *map(np.stack, fringes)])


@dataclass(frozen=True)
class Component:
    """The offsets along one axis."""

    name: str  # `x`, `y` or `fringe`
    axis: tuple[float, float]  # unit vector (x, y)
    delta: FitsMap  # delta, sigma, mask: product of the fit
    sigma: FitsMap
    mask: FitsMap
    # the true offset is the sum of the maps times the numbers; empty if unknown
    truth: tuple[tuple[float, FitsMap], ...] = ()
    # modes to remove from the truth, and the coefficient of each, px
    removed: tuple[DegenerateModes, tuple[float, ...]] | None = None

    def true(self, y: Range, x: Range) -> F64:
        """The true offset along the axis, px."""
        total = sum(share * image.read(y, x).astype(float) for share, image in self.truth)
        if self.removed is not None:
            modes, coefficients = self.removed
            total = total - np.tensordot(coefficients, modes.basis(y, x), 1)
        return np.asarray(total)


@dataclass(frozen=True)
class Patch:
    """A part of the detector."""

    # true, known: (component, y, x) true offsets and offsets of the maps, px; zero where not
    # `good`
    true: F64
    known: F64
    good: Mask  # (y, x) pixels whose offset is known


@dataclass(frozen=True)
class PixelPositions:
    """The whole detector; picklable, read on demand."""

    components: tuple[Component, ...]
    seed: int

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) size, px."""
        return self.components[0].delta.shape

    @property
    def drawn(self) -> bool:
        """Whether the true positions are the maps plus a random draw of their errors."""
        return not self.components[0].truth

    @property
    def axes(self) -> F64:
        """Unit vectors (x, y) of the components, (component, 2)."""
        return np.array([component.axis for component in self.components])

    def patch(self, y: Range, x: Range) -> Patch:
        """A part, (start, stop) of rows and of columns; beyond the detector no pixel is good."""
        inside = [
            (min(max(0, a), n), min(max(0, b), n))
            for (a, b), n in zip((y, x), self.shape, strict=True)
        ]
        beyond = [(a - o, p - b) for (o, p), (a, b) in zip((y, x), inside, strict=True)]
        if any(a == b for a, b in inside):
            inside, beyond = [(0, 0), (0, 0)], [(0, y[1] - y[0]), (0, x[1] - x[0])]
        true, known, good = self._inside(*inside)
        wide = [(0, 0), *beyond]
        return Patch(np.pad(true, wide), np.pad(known, wide), np.pad(good, beyond))

    def _inside(self, y: Range, x: Range) -> tuple[F64, F64, Mask]:
        known = np.stack([c.delta.read(y, x).astype(float) for c in self.components])
        if self.drawn:
            sigma = np.stack([c.sigma.read(y, x).astype(float) for c in self.components])
            true = known + sigma * self._draw(y, x)
        else:
            true = np.stack([c.true(y, x) for c in self.components])
        flags = np.stack([c.mask.read(y, x) for c in self.components])
        with np.errstate(invalid="ignore"):
            fine = (np.abs(true) < LARGEST) & (np.abs(known) < LARGEST) & (flags == 0)
        good = fine.all(axis=0)
        return np.where(good, true, 0.0), np.where(good, known, 0.0), good

    def _draw(self, y: Range, x: Range) -> F64:
        """Standard normals of the pixels, the same in every patch that holds them."""
        side, (rows, columns) = DRAW_TILE, [(a // DRAW_TILE, -(-b // DRAW_TILE)) for a, b in (y, x)]
        size = (len(self.components), side, side)
        tiles = [
            [default_rng([self.seed, 1, i, j]).standard_normal(size) for j in range(*columns)]
            for i in range(*rows)
        ]
        (y0, y1), (x0, x1) = (
            (a - side * n, b - side * n) for (a, b), (n, _) in ((y, rows), (x, columns))
        )
        return np.block(tiles)[:, y0:y1, x0:x1] if tiles else np.zeros((len(self.components), 0, 0))


def open_components(run_dir: Path, fit: dict[str, Any], truth: Path | None) -> list[Component]:
    """The products of a run as components, with their truth if given."""
    true = {}
    files = {} if truth is None else {name: truth / f"{name}.fits" for name in AXES}
    for name, file in files.items():
        if not file.exists():
            raise InputError(
                f"--truth {truth}: no {file.name} there; give the directory that 'pixcal simulate' "
                "wrote beside the acquisition (ACQ-truth)"
            )
        true[name] = FitsMap.open(file)
    components = []
    for output in fit["outputs"]:
        file = run_dir / "products" / f"{output}.fits"
        if not file.exists():
            raise InputError(f"{file}: not there; run 'pixcal fit {run_dir}' again")
        axis_x, axis_y = next(iter(fit["sets"].values()))["axis"]
        name, axis = AXES.get(output, ("fringe", (axis_x, axis_y)))
        delta, sigma, mask = (FitsMap.open(file, n) for n in (0, "SIGMA", "MASK"))
        shares = tuple((s, true[n]) for s, n in zip(axis, AXES, strict=True) if true and s)
        for _, image in shares:
            if image.shape != delta.shape:
                raise InputError(
                    f"{image.path}: {image.shape} pixels (y, x), the run's maps have "
                    f"{delta.shape}; give the truth of this acquisition"
                )
        components.append(Component(name, axis, delta, sigma, mask, shares))
    return components


def free_from_modes(
    components: Sequence[Component], modes: DegenerateModes, runtime: Runtime
) -> tuple[list[Component], dict[str, dict[str, float]]]:
    """Fit the modes to truth minus maps, and remove them; rms (px) of ``smooth``, ``fringe``."""
    ny, nx = modes.shape
    # Odd step, so that bands are not in phase with fringes.
    step = (ny * nx // ENOUGH) | 1
    bands = list(spans(ny, BAND))[::step]
    task = partial(_mode_sums, tuple(components), modes)
    parts = run_tasks(task, bands, runtime, label="modes of the truth")
    groups = {"smooth": slice(modes.n_smooth), "fringe": slice(modes.n_smooth, None)}
    freed, removed = [], {}
    for component, sums in zip(components, zip(*parts, strict=True), strict=True):
        normal, right, count = (np.sum(part, axis=0) for part in zip(*sums, strict=True))
        # Modes of two sets overlap: take the minimum-norm solution.
        c = inverse_normal(normal, 1e-10) @ right
        freed.append(replace(component, removed=(modes, tuple(c.tolist()))))
        removed[component.name] = {
            group: float(np.sqrt(c[p] @ normal[p, p] @ c[p] / max(count, 1)))
            for group, p in groups.items()
        }
    return freed, removed


def _mode_sums(
    components: tuple[Component, ...], modes: DegenerateModes, y: Range
) -> list[tuple[F64, F64, int]]:
    """Normal equations of the modes in truth minus map over a band, for each component."""
    x = (0, modes.shape[1])
    basis, sums = modes.basis(y, x), []
    for component in components:
        difference = component.true(y, x) - component.delta.read(y, x)
        good = np.isfinite(difference) & (component.mask.read(y, x) == 0)
        chosen = basis[:, good]
        sums.append((chosen @ chosen.T, chosen @ difference[good], int(good.sum())))
    return sums
