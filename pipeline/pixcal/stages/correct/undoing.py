"""A sweep's maps without effects: the phase of every pixel moved, and the sums of tiles taken anew.

What is left is a sweep as that of the cube, which the shapes of the fringes are fitted to. In the
place of its batches are variants: the two halves of the frames, corrected each for itself, and the
map with each of the effects left in.

A tile is undone with the pixels around it that the effects reach over. Tiles are the columns of
chunks of the cube, so results depend neither on memory nor on workers.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.corrected import phase_change
from pixcal.estimators.fringes import wrapped
from pixcal.estimators.geometry import tile_plane
from pixcal.estimators.tile_sums import Carrier, TileSums, sum_row
from pixcal.kernels.crosstalk import FILL_REACH, filled
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, FringeMaps
from pixcal.stages.correct.surroundings import (
    BEYOND,
    CLOSED,
    DEPTH,
    Sides,
    border_misfit,
    decided,
    disturbed,
    scatter_of,
    usable,
)
from pixcal.stages.evidence import Part, fitted_theta
from pixcal.stages.fit.sweep import BATCH_MAPS
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.artefact import read_json, write_json
from pixcal.storage.cube import ArrayReader, ArrayWriter, create_array, create_group, write_array
from pixcal.storage.links import link_files

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

HALVES = 2
PIXEL_BYTES = 500
"""Peak of a tile's task for each of its pixels, those around it included (measured),"""
EFFECT_BYTES = 40
"""and for each effect."""
ALONG = 1024
"""Pixels along a side that tell whether it is open."""
SAME = ("chi2", "mask", "g", "dk", "time")
"""Arrays of a sweep that stay."""


@dataclass(frozen=True)
class Swept:
    """A set as swept, and what its maps are to be freed of.

    Attributes
    ----------
    folder : Path
        ``sweep.zarr/<set name>``.
    source : ReducedSet
        For the tiles.
    effects : tuple of Effect
        In the order in which they are undone.
    k : (float, float)
        Fringe vector at the centre, rad/px.
    flat : Path, optional
        Map that samples were divided by.
    read_noise : float
        e-.
    open_sides : (bool, bool, bool, bool)
        Where the detector goes on beyond the window: top, bottom, left, right.
    """

    folder: Path
    source: ReducedSet
    effects: tuple[Effect, ...]
    k: tuple[float, float]
    flat: Path | None
    read_noise: float
    open_sides: Sides = CLOSED

    @property
    def n_batches(self) -> int:
        """Batches of the sweep."""
        return int(ArrayReader(self.folder / "batch_count").shape[0])

    @property
    def variants(self) -> int:
        """Of the maps: the halves, where there are batches to make them of, and the effects."""
        return HALVES * self.has_halves + len(self.effects)

    @property
    def has_halves(self) -> bool:
        """Whether there are batches in both halves of the frames."""
        counts = ArrayReader(self.folder / "batch_count").read()
        middle = len(counts) // 2
        return bool(counts[:middle].any() and counts[middle:].any())

    @property
    def carrier(self) -> Carrier:
        """That phases are relative to."""
        facts = read_json(self.folder / "scout.json")
        (kx, ky), (y, x) = facts["k"], facts["reference"]
        return Carrier((float(kx), float(ky)), (float(y), float(x)))

    @property
    def halo(self) -> int:
        """Pixels around a tile that are read with it."""
        return FILL_REACH + sum(effect.undo_halo for effect in self.effects)

    def around(self, y: tuple[int, int], x: tuple[int, int]) -> Part:
        """A tile with its halo, as far as the detector goes: beyond the window at open sides."""
        ny, nx = self.source.shape
        top, bottom, left, right = (BEYOND * is_open for is_open in self.open_sides)
        rows = (max(-top, y[0] - self.halo), min(ny + bottom, y[1] + self.halo))
        return rows, (max(-left, x[0] - self.halo), min(nx + right, x[1] + self.halo))

    def within(self, part: Part) -> Part:
        """The share of the window in a part."""
        (y0, y1), (x0, x1) = part
        ny, nx = self.source.shape
        return (max(0, y0), min(ny, y1)), (max(0, x0), min(nx, x1))

    def inside(self, y: tuple[int, int], x: tuple[int, int]) -> tuple[slice, slice]:
        """Where a tile lies in its surroundings."""
        rows, columns = self.around(y, x)
        return slice(y[0] - rows[0], y[1] - rows[0]), slice(x[0] - columns[0], x[1] - columns[0])


def undo_on_maps(swept: Swept, target: Path, runtime: Runtime, name: str) -> None:
    """Write a set's sweep without effects.

    Parameters
    ----------
    swept : Swept
    target : Path
        Folder to make.
    runtime : Runtime
    name : str
        Of the set.

    Raises
    ------
    InputError
        If an effect gives back what is no map.
    """
    create_group(target)
    for array in SAME:
        link_files(swept.folder / array, target / array)
    write_json(target / "scout.json", read_json(swept.folder / "scout.json"))
    counts = ArrayReader(swept.folder / "batch_count").read()
    middle, frames = len(counts) // 2, swept.source.n_frames
    of_halves = [int(counts[:middle].sum()), int(counts[middle:].sum())] * swept.has_halves
    variants = np.array([*of_halves, *[frames] * len(swept.effects)], np.int32)
    write_array(target / "batch_count", variants, dims=("batch",))
    write_array(target / "batch_time", np.zeros(len(variants)), dims=("batch",))
    cy, cx = swept.source.signal.chunks[1:]
    around = (cy + 2 * swept.halo) * (cx + 2 * swept.halo)
    tiles = swept.source.tiles()
    if swept.has_halves:
        halves = _create(target, swept, ("half_phase", "half_sigma"), HALVES)
        plan = make_plan(f"halves of {name}", cy * cx * (28 * swept.n_batches + 100), 0, runtime)
        run_tasks(
            partial(_halve, swept, halves, middle), tiles, runtime.with_workers(plan.workers),
            label=f"halves {name}",
        )  # fmt: skip
        _finish(halves)
    writers = _create(target, swept, ("iota", "alpha", "phase", "sigma"))
    writers |= _create(target, swept, ("batch_phase", "batch_sigma"), swept.variants)
    width = TileSums.width(swept.variants)
    writers["sums"] = create_array(
        target / "sums", (*swept.source.grid, width), "<f8", dims=("row", "column", "fact"),
        chunks=(1, 1, width), fill_value=np.nan,
    )  # fmt: skip
    need = around * (PIXEL_BYTES + EFFECT_BYTES * len(swept.effects))
    plan = make_plan(f"undoing effects of {name}", need, 0, runtime)
    run_tasks(
        partial(_undo_tile, swept, target, writers), tiles, runtime.with_workers(plan.workers),
        label=f"undo {name}",
    )  # fmt: skip
    _finish(writers)


def _create(
    target: Path, swept: Swept, names: Sequence[str], number: int = 0
) -> dict[str, ArrayWriter]:
    """Writers of maps (y, x), or of several at a time (number, y, x)."""
    (cy, cx), shape = swept.source.signal.chunks[1:], swept.source.shape
    many = (number,) * (number > 0)
    return {
        name: create_array(
            target / name, (*many, *shape), "<f4", dims=("batch", "y", "x")[-2 - len(many) :],
            chunks=(*many, cy, cx), fill_value=np.nan,
        )
        for name in names
    }  # fmt: skip


def _finish(writers: dict[str, ArrayWriter]) -> None:
    for writer in writers.values():
        writer.finish()


def _halve(swept: Swept, writers: dict[str, ArrayWriter], middle: int, at: tuple[int, int]) -> None:
    """Phases of the halves of the frames relative to the whole, and their errors, from batches."""
    y, x = swept.source.ranges(at)
    every = (0, swept.n_batches)
    phase, sigma = (
        ArrayReader(swept.folder / name).read(every, y, x).astype(np.float32) for name in BATCH_MAPS
    )
    found = [mean_of(phase[part], sigma[part]) for part in (slice(middle), slice(middle, None))]
    for n, name in enumerate(("half_phase", "half_sigma")):
        writers[name].write((0, y[0], x[0]), np.stack([f[n] for f in found]))


def mean_of(maps: F32, sigma: F32) -> tuple[F32, F32]:
    """Weighted mean (y, x) of maps (batch, y, x) and its error; NaN where there is none."""
    good = np.isfinite(maps) & (sigma > 0)
    weight = np.where(good, 1 / np.where(good, sigma, 1.0).astype(float) ** 2, 0.0)
    total = weight.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = (weight * np.where(good, maps, 0.0)).sum(axis=0) / total
        error = 1 / np.sqrt(total)
    there = total > 0
    return (
        np.where(there, mean, np.nan).astype(np.float32),
        np.where(there, error, np.nan).astype(np.float32),
    )


def _undo_tile(
    swept: Swept, target: Path, writers: dict[str, ArrayWriter], at: tuple[int, int]
) -> None:
    y, x = swept.source.ranges(at)
    part = swept.around(y, x)
    inside = swept.inside(y, x)
    maps, good, known = maps_of(swept, part)
    after, steps = undone(maps, swept.effects)
    change = np.sum(steps, axis=0) if steps else np.zeros(maps.theta.shape[1:])
    phase = wrapped(
        ArrayReader(swept.folder / "phase").read(y, x) + change[inside].astype(np.float32)
    )
    factor = np.prod(_noise_factors(swept, maps), axis=0)[inside]
    own_error = ArrayReader(swept.folder / "sigma").read(y, x) * factor
    beside = _of_neighbours(swept, maps, after, known, part)[inside]
    sigma = np.hypot(own_error, beside).astype(np.float32)
    iota, alpha = after.theta[0][inside], np.hypot(after.theta[1], after.theta[2])[inside]
    variants: list[F64] = []
    errors: list[F64] = []
    if swept.has_halves:
        for n in range(HALVES):
            half = ArrayReader(target / "half_phase")
            own = _padded(half.read((n, n + 1), *swept.within(part))[0].astype(float), swept, part)
            its = undone(_turned(maps, own), swept.effects)[1]
            rest = np.sum(its, axis=0) - change if its else 0.0
            variants.append((own + rest)[inside])
            error = ArrayReader(target / "half_sigma").read((n, n + 1), y, x)[0]
            errors.append(error * factor)
    variants += [-step[inside] for step in steps]
    errors += [sigma] * len(steps)
    start = (y[0], x[0])
    for name, values in (("iota", iota), ("alpha", alpha), ("phase", phase), ("sigma", sigma)):
        writers[name].write(start, values.astype(np.float32))
    several = np.array(variants, np.float32).reshape(-1, *phase.shape)
    if len(several):
        writers["batch_phase"].write((0, *start), several)
        writers["batch_sigma"].write((0, *start), np.array(errors, np.float32))
    ratio = iota / np.maximum(alpha, 1e-9)
    row = _sums(swept, at, phase, sigma, ratio, good[inside], several)
    writers["sums"].write((*at, 0), row[None, None])


def maps_of(swept: Swept, part: Part) -> tuple[FringeMaps, Mask, Mask]:
    """What was fitted on a part; what is not known there is like the pixels around it.

    Returns
    -------
    maps : FringeMaps
    good, known : (y, x) bool
        Pixels that have an offset, and those whose light is known, flagged ones included.
    """
    there = swept.within(part)
    theta = fitted_theta(swept.folder, there, swept.carrier.reference)
    mask = ArrayReader(swept.folder / "mask").read(*there)
    known = usable(theta, mask)
    good = known & (mask == 0)
    theta[:, ~known] = np.nan
    theta = filled(_padded(theta, swept, part), swept.k)
    flat = None
    if swept.flat is not None:
        flat = _padded(ArrayReader(swept.flat).read(*there).astype(float), swept, part, 1.0)
    maps = FringeMaps(theta, swept.k, (part[0][0], part[1][0]), flat)
    return maps, _padded(good, swept, part, False), _padded(known, swept, part, False)


def _padded(values: NDArray[Any], swept: Swept, part: Part, fill: float = np.nan) -> NDArray[Any]:
    """Values (..., y, x) of the window's share in a part, with what lies beyond filled."""
    pads = [(0, 0)] * (values.ndim - 2)
    pads += [(t[0] - p[0], p[1] - t[1]) for p, t in zip(part, swept.within(part), strict=True)]
    return np.pad(values, pads, constant_values=fill)


def _of_neighbours(
    swept: Swept, maps: FringeMaps, after: FringeMaps, known: Mask, part: Part
) -> F64:
    """Error (y, x) of a pixel's phase that comes from neighbours whose light is not known, rad."""
    if known.all() or not any(effect.undo_halo for effect in swept.effects):
        return np.zeros(known.shape)
    within = _padded(np.ones([b - a for a, b in swept.within(part)], bool), swept, part, False)
    phase = ArrayReader(swept.folder / "phase").read(*swept.within(part)).astype(float)
    others = disturbed(maps, within & ~known, ~within, scatter_of(phase))
    steps = [phase_change(after.theta, undone(o, swept.effects)[0].theta) for o in others]
    error = np.sqrt(np.mean(np.square(steps), axis=0))
    return np.asarray(np.where(known, error, 0.0))


def sides_of(sets: Sequence[Swept]) -> Sides:
    """Where the detector goes on beyond the window, as the maps of all sets tell."""
    misfits = np.zeros((4, 2))
    for swept in sets:
        if any(effect.undo_halo for effect in swept.effects):
            for side in range(4):
                misfits[side] += [_misfit(swept, side, is_open) for is_open in (False, True)]
    return decided(misfits)


def _misfit(swept: Swept, side: int, is_open: bool) -> float:
    """Misfit of the pixels at one side, that being open or not."""
    shape = swept.source.shape
    axis, last = divmod(side, 2)
    strip = [(0, shape[0]), (0, shape[1])]
    length = shape[1 - axis]
    middle = max(0, (length - ALONG) // 2)
    strip[1 - axis] = (middle, min(length, middle + ALONG))
    strip[axis] = (max(0, shape[axis] - DEPTH), shape[axis]) if last else (0, DEPTH)
    if min(shape) < 2 * DEPTH:
        return 0.0
    y, x = strip
    sides = [False] * 4
    sides[side] = is_open
    one = replace(swept, open_sides=(sides[0], sides[1], sides[2], sides[3]))
    part, inside = one.around(y, x), one.inside(y, x)
    maps, good, _ = maps_of(one, part)
    theta, good = undone(maps, swept.effects)[0].theta[(slice(None), *inside)], good[inside]
    kx, ky = swept.k
    if axis:
        theta, good, kx, ky = theta.swapaxes(1, 2), good.T, ky, kx
    if last:
        theta, good, ky = theta[:, ::-1], good[::-1], -ky
    return border_misfit(theta, (kx, ky), good)


def _turned(maps: FringeMaps, phase: F64) -> FringeMaps:
    """Maps with their phase moved."""
    iota, sine, cosine = maps.theta
    z = (cosine + 1j * sine) * np.exp(1j * np.nan_to_num(phase))
    return FringeMaps(np.stack([iota, z.imag, z.real]), maps.k, maps.origin, maps.flat)


def undone(maps: FringeMaps, effects: Sequence[Effect]) -> tuple[FringeMaps, list[F64]]:
    """Maps without effects, and by how much each has moved the phase (y, x), rad.

    Raises
    ------
    InputError
        If an effect gives back what is no map of the same pixels.
    """
    steps = []
    for effect in effects:
        after = effect.undo(maps)
        if (
            not isinstance(after, FringeMaps)
            or after.theta.shape != maps.theta.shape
            or not np.isfinite(after.theta).all()
        ):
            raise InputError(
                f"effect {effect.name!r}: undo gives no finite maps of the shape it is given; "
                "mend its file"
            )
        steps.append(phase_change(maps.theta, after.theta))
        maps = after
    return maps, steps


def _noise_factors(swept: Swept, maps: FringeMaps) -> F64:
    """Of each effect (effect, y, x); of one that does nothing, where there is none."""
    light = maps.theta[0] if maps.flat is None else maps.theta[0] * maps.flat
    charge = float(light.mean())
    factors = [np.ones(light.shape)]
    factors += [e.noise_factor(charge, swept.read_noise, maps) for e in swept.effects]
    return np.stack(factors)


def _sums(
    swept: Swept,
    at: tuple[int, int],
    phase: F32,
    sigma: F32,
    ratio: F64,
    good: Mask,
    variants: F32,
) -> F64:
    """What shapes are fitted to, as the sweep leaves it."""
    stored = ArrayReader(swept.folder / "sums").read((at[0], at[0] + 1), (at[1], at[1] + 1))
    (old,) = TileSums.of_rows(stored.reshape(1, -1)).planes
    plane = tile_plane(
        phase, sigma, ratio.astype(np.float32), good, (old.kx, old.ky), old.centre
    )  # fmt: skip
    return sum_row(phase, sigma, good, variants, swept.carrier, plane)
