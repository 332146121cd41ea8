"""The maps of all sets and their combination, in one pass over the sweep's maps."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.fringe_fit.combine import axes_span_plane, combine_parallel, combine_sets
from pixcal.estimators.fringe_fit.fringes import wrapped
from pixcal.estimators.fringe_fit.tile_sums import local_modes
from pixcal.model.arrays import F32, F64, U8
from pixcal.stages.fit.fringe_set import SetWithShape
from pixcal.stages.fit.sweep import BATCH_MAPS, DIGITS, read_frames, rounded
from pixcal.stages.tiles import STRIP, span
from pixcal.storage import cube
from pixcal.storage.cube import ArrayWriter
from pixcal.storage.cube_reader import ArrayReader, CachedReader
from pixcal.storage.folder import link_files
from pixcal.storage.place import Local

SAME_AS_SWEPT = ("iota", "alpha", "chi2", "mask")  # maps identical to those of the sweep
# by names of the set ("" for combined maps) and of the array
Writers = dict[tuple[str, str], ArrayWriter]
Made = dict[tuple[str, str], NDArray[Any]]  # maps of a tile, by the same keys
# most errors that a tile contributes to the median, and about how many all tiles contribute
SAMPLED_ERRORS, MAX_SAMPLED_ERRORS = 4000, 4_000_000


@dataclass(frozen=True)
class Totals:
    """Totals over all written maps."""

    sets: dict[str, tuple[int, float]]  # masked pixels and median error (px) of each set
    outputs: tuple[str, ...]  # combined maps of the sets
    # reduced chi-square of the sets' disagreement; None without redundant sets
    consistency: float | None


def write_maps(group: Path, fitted: list[SetWithShape], runtime: Runtime) -> Totals:
    """Write ``fit.zarr``: the maps of each set, and the combined maps."""
    source = fitted[0].source
    ny, nx = source.shape
    both = axes_span_plane([f.shape.axis(ny / 2, nx / 2) for f in fitted])
    outputs = outputs_of(both)
    cube.create_group(group)
    names = [array for name in outputs for array in (name, f"{name}_sigma")]
    writers = {("", name): _map_writer(group / name, fitted[0]) for name in names}
    writers["", "mask"] = cube.create_array(
        group / "mask", source.shape, "u1", dims=("y", "x"), chunks=source.map_chunks
    )
    for f in fitted:
        writers |= _create_set(group / f.name, f)
    pixels = int(np.prod(source.signal.chunks[1:]))
    most = max(f.n_batches for f in fitted)
    # For a tile, and for all maps of a strip, read, computed and written.
    per_pixel = 500 + 60 * len(fitted) + 40 * most + STRIP * len(fitted) * (60 + 20 * most)
    runtime = within_memory("the maps of the fit", pixels * per_pixel, 0, runtime)
    removed = {f.name: f.fit.basis.removed(f.planes, f.fit.coefficients) for f in fitted}
    # Each tile gets its own part, which is sent with its task on a cluster.
    jobs = {
        at: (at, {name: local[n] for name, local in removed.items()})
        for n, at in enumerate(source.tiles())
    }
    strips = [[jobs[at] for at in strip] for strip in source.strips()]
    every = run_tasks(partial(_write_strip, fitted, writers, both), strips, runtime, label="maps")
    for writer in writers.values():
        writer.finish()
    good, sigma, square, freedom = zip(*chain.from_iterable(every), strict=True)
    sets = {}
    for n, f in enumerate(fitted):
        errors = np.concatenate([of_tile[n] for of_tile in sigma])
        sets[f.name] = ny * nx - sum(of_tile[n] for of_tile in good), float(np.median(errors))
    return Totals(sets, outputs, sum(square) / sum(freedom) if any(freedom) else None)


def write_offsets(group: Local, fitted: list[SetWithShape]) -> None:
    """Write only the offsets of each set, as `write_maps` does."""
    for f in fitted:
        swept = {name: ArrayReader(f.swept / name) for name in ("mask", "phase", "sigma")}
        writer = _map_writer(group / f.name / "delta", f)
        removed = f.fit.basis.removed(f.planes, f.fit.coefficients)
        tiles = enumerate(f.source.tiles())
        parts = {at: offsets(f, swept, at, removed[n]).delta for n, at in tiles}
        for strip in f.source.strips():
            (y, _), (x, _) = f.source.ranges(strip[0])
            writer.write((y, x), np.concatenate([parts[at] for at in strip], axis=1))
        writer.finish()


def _map_writer(place: Local, fitted: SetWithShape, batches: int = 0) -> ArrayWriter:
    """A map (y, x) in pixels, or one for each batch."""
    source = fitted.source
    return cube.create_map(place, source.shape, source.map_chunks, units="pixel", number=batches)


Job = tuple[tuple[int, int], dict[str, F64]]  # a tile, and the modes removed from each set there
Swept = Mapping[str, ArrayReader]  # readers of the maps of a set's sweep
# of a tile: good pixels and sampled errors (px) of each set; square and freedom of the sets'
# disagreement
_TileTotals = tuple[list[int], list[F32], float, int]


def _write_strip(
    fitted: list[SetWithShape], writers: Writers, both: bool, strip: Sequence[Job]
) -> list[_TileTotals]:
    (y0, y1), (x0, x1) = span(fitted[0].source.shape, [at for at, _ in strip])
    swept: list[Swept] = []
    for f in fitted:
        names = ("phase", "sigma", *SAME_AS_SWEPT, *(BATCH_MAPS if f.n_batches else ()))
        held = {name: CachedReader(f.swept / name) for name in names}
        for reader in held.values():
            # Also for linked maps: damage to them would be permanent.
            reader.keep_block((y0, y1), (x0, x1))
        swept.append(held)
    shape = (y1 - y0, x1 - x0)
    made = {n: np.empty((*w.shape[:-2], *shape), w.dtype) for n, w in writers.items()}
    of_tiles = []
    for job in strip:
        _, (a, b) = fitted[0].source.ranges(job[0])
        part = {name: data[..., a - x0 : b - x0] for name, data in made.items()}
        of_tiles.append(_maps_of_tile(fitted, swept, both, job, part))
    for name, writer in writers.items():
        writer.write((*(0,) * (made[name].ndim - 2), y0, x0), made[name])
    return of_tiles


def _maps_of_tile(
    fitted: list[SetWithShape], readers: list[Swept], both: bool, job: Job, made: Made
) -> _TileTotals:
    """Fill the maps of a tile; return its share of the totals."""
    at, removed = job
    y, x = fitted[0].source.ranges(at)
    maps = [
        _maps_of_set(f, swept, at, removed[f.name], made)
        for f, swept in zip(fitted, readers, strict=True)
    ]
    delta, sigma = (
        np.stack([getattr(m, name) for m in maps]).astype(float) for name in ("delta", "sigma")
    )
    masks = np.stack([m.flags for m in maps])
    # The direction of hyperbolic fringes varies over the window: each tile has its own axes.
    axes = [f.shape.axis((y[0] + y[1] - 1) / 2, (x[0] + x[1] - 1) / 2) for f in fitted]
    value, error, chi2 = (combine_sets if both else combine_parallel)(axes, delta, sigma)
    values, errors = (v.reshape(-1, *chi2.shape).astype(np.float32) for v in (value, error))
    missing = ~np.isfinite(values).all(axis=0)
    # A flag counts only if the pixel has no value; other sets can replace a flagged one.
    flags = np.where(missing, np.bitwise_or.reduce(masks, axis=0), 0).astype(np.uint8)
    for name, own_value, own_error in zip(outputs_of(both), values, errors, strict=True):
        made["", name][...], made["", f"{name}_sigma"][...] = own_value, own_error
    made["", "mask"][...] = flags
    freedom = np.isfinite(delta).sum(axis=0) - len(values)
    goods = [np.isfinite(s) for s in sigma]
    number = max(1, min(SAMPLED_ERRORS, MAX_SAMPLED_ERRORS // len(fitted[0].planes)))
    some = [_some(s[good].astype(np.float32), number) for s, good in zip(sigma, goods, strict=True)]
    count = [int(good.sum()) for good in goods]
    return count, some, float(chi2[~missing].sum()), int(freedom[~missing].sum())


@dataclass(frozen=True)
class SetOffsets:
    """Offsets of one set in one tile."""

    delta: F32  # delta, sigma: (y, x) offset and its error, px; NaN where masked
    sigma: F32
    flags: U8  # (y, x)
    modes: F64  # (mode, y * x) of the shape and the gauge
    k: float  # length of the fringe vector, rad/px
    scale: np.float32  # ratio of errors (px) to those of the sweep (rad)


def offsets(fitted: SetWithShape, swept: Swept, at: tuple[int, int], removed: F64) -> SetOffsets:
    """Offsets of a set in a tile, given the modes ``removed`` from its phases."""
    source = fitted.source
    y, x = source.ranges(at)
    plane = fitted.planes[at[0] * source.grid[1] + at[1]]
    flags: U8 = swept["mask"].read(y, x)
    phase = swept["phase"].read(y, x)
    modes = local_modes(fitted.carrier, plane, phase.shape)
    surface = (removed[:, 0] @ modes).reshape(phase.shape)
    k = float(np.hypot(*fitted.shape.vector(*plane.centre)))
    scale = np.float32(fitted.sigma_scale / k)
    delta = ((wrapped(phase - plane.on(phase.shape)) - surface) / k).astype(np.float32)
    sigma = np.asarray(swept["sigma"].read(y, x) * scale)
    delta[flags != 0] = sigma[flags != 0] = np.nan
    return SetOffsets(delta, sigma, flags, modes, k, scale)


def _maps_of_set(
    fitted: SetWithShape, swept: Swept, at: tuple[int, int], removed: F64, made: Made
) -> SetOffsets:
    """Fill a set's own maps of a tile."""
    y, x = fitted.source.ranges(at)
    tile = offsets(fitted, swept, at, removed)
    made[fitted.name, "delta"][...], made[fitted.name, "sigma"][...] = tile.delta, tile.sigma
    for name, array in (
        (("batch_delta", "batch_phase"), ("batch_sigma", "batch_sigma")) if fitted.n_batches else ()
    ):
        maps = swept[array].read((0, fitted.n_batches), y, x, out=made[fitted.name, name])
        if name == "batch_delta":
            surfaces = removed[:, 1:].T.astype(np.float32) @ tile.modes.astype(np.float32)
            maps -= surfaces.reshape(maps.shape)
            maps *= np.float32(1 / tile.k)
            maps += tile.delta
        else:
            maps *= tile.scale
        maps[:, tile.flags != 0] = np.nan
        rounded(maps, DIGITS[name])
    return tile


def _create_set(folder: Path, fitted: SetWithShape) -> Writers:
    """Create the set's folder: link maps of the sweep, and return writers of the others."""
    cube.create_group(folder)
    for name in SAME_AS_SWEPT:
        # Links left by a killed fit may point to a damaged sweep.
        shutil.rmtree(folder / name, ignore_errors=True)
        swept = fitted.swept / name
        assert isinstance(swept, Path)
        link_files(swept, folder / name)
    _write_frames(folder, fitted.swept)
    n = fitted.n_batches
    writers = {name: _map_writer(folder / name, fitted) for name in ("delta", "sigma")}
    for name in ("batch_delta", "batch_sigma") if n else ():
        writers[name] = _map_writer(folder / name, fitted, n)
    return {(fitted.name, name): writer for name, writer in writers.items()}


def _write_frames(folder: Path, maps: Local) -> None:
    """Write the parameters of every frame and the times of the batches, for users of the fit."""
    frames = read_frames(maps)
    for array, data in (
        ("B", frames.B),
        ("A", frames.A),
        ("phi", frames.phi),
        ("dkx", frames.dk[:, 0]),
        ("dky", frames.dk[:, 1]),
        ("time", ArrayReader(maps / "time").read()),
    ):
        cube.write_array(folder / array, data, dims=("time",))
    for array in ("batch_time", "batch_count"):
        cube.write_array(folder / array, ArrayReader(maps / array).read(), dims=("batch",))


def outputs_of(both: bool) -> tuple[str, ...]:
    """Names of the combined maps of sets along one axis, or along two (``both``)."""
    return ("delta_x", "delta_y") if both else ("delta_fringe",)


def _some(values: F32, number: int) -> F32:
    """A copy of about ``number`` evenly spaced values, so that the rest can be freed."""
    return values[:: max(1, len(values) // number)].copy()
