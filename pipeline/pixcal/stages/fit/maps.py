"""The maps of all sets and what they give together: one pass over the sweep's maps."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from pixcal.engine.plan import make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.fringe_fit.combine import axes_span_plane, combine_parallel, combine_sets
from pixcal.estimators.fringe_fit.fringes import wrapped
from pixcal.estimators.fringe_fit.models import FringeShape
from pixcal.estimators.fringe_fit.tile_sums import local_modes
from pixcal.model.arrays import F32, F64, U8
from pixcal.stages.fit.fringe_set import FittedSet
from pixcal.stages.fit.scouting import read_frames
from pixcal.storage.cube import ArrayReader, ArrayWriter, create_array, create_group, write_array
from pixcal.storage.links import link_files
from pixcal.storage.place import Local

SAME_AS_SWEPT = ("iota", "alpha", "chi2", "mask")
"""Maps of a set that are those of its sweep."""
MANTISSA = 12
"""Binary digits kept of the batches' maps: the others, far below their noise, would take as much
disk again."""
TOLD, TOLD_IN_ALL = 4000, 4_000_000
"""Errors that a tile tells at most for the median of all, and about how many all of them tell."""


@dataclass(frozen=True)
class SetTotals:
    """What is known of a set once its maps are written."""

    masked: int
    sigma_px: float


@dataclass(frozen=True)
class Totals:
    """What is known once all maps are written.

    Attributes
    ----------
    sets : dict
        By name.
    outputs : tuple of str
        Maps that the sets give together.
    consistency : float or None
        Reduced chi-square of the sets' disagreement; None where they determine no more than that.
    """

    sets: dict[str, SetTotals]
    outputs: tuple[str, ...]
    consistency: float | None


def write_maps(group: Path, fitted: list[FittedSet], runtime: Runtime) -> Totals:
    """Write ``fit.zarr``: the maps of each set, and those that all sets give together.

    Parameters
    ----------
    group : Path
        ``fit.zarr``.
    fitted : list of FittedSet
        All of the same window.
    runtime : Runtime
    """
    source = fitted[0].source
    ny, nx = source.shape
    both = axes_span_plane([axis(f.shape, ny / 2, nx / 2) for f in fitted])
    outputs = outputs_of(both)
    create_group(group)
    writers = {f.name: _create_set(group / f.name, f) for f in fitted}
    joint = _create_joint(group, fitted[0], outputs)
    pixels = int(np.prod(source.signal.chunks[1:]))
    most = max(f.n_batches for f in fitted)
    plan = make_plan(
        "the maps of the fit", pixels * (500 + 60 * len(fitted) + 40 * most), 0, runtime
    )
    removed = {f.name: f.fit.basis.removed(f.planes, f.fit.coefficients) for f in fitted}
    # Each tile gets its own part of them: on a cluster they travel with it.
    jobs = [
        (at, {name: local[n] for name, local in removed.items()})
        for n, at in enumerate(source.tiles())
    ]
    told = run_tasks(
        partial(_tile_task, fitted, writers, joint, both),
        jobs,
        runtime.with_workers(plan.workers),
        label="maps",
    )
    for writer in [*(w for own in writers.values() for w in own.values()), *joint.values()]:
        writer.finish()
    sets = {}
    for n, f in enumerate(fitted):
        good = sum(t.good[n] for t in told)
        errors = np.concatenate([t.sigma[n] for t in told])
        sets[f.name] = SetTotals(ny * nx - good, float(np.median(errors)))
    freedom = sum(t.freedom for t in told)
    square = sum(t.square for t in told)
    return Totals(sets, outputs, square / freedom if freedom else None)


def write_offsets(group: Local, fitted: list[FittedSet]) -> None:
    """Write the offsets of each set alone, as `write_maps` has them."""
    for f in fitted:
        writer = _map_writers(group / f.name, f, ("delta",))["delta"]
        removed = f.fit.basis.removed(f.planes, f.fit.coefficients)
        for n, at in enumerate(f.source.tiles()):
            y, x = f.source.ranges(at)
            writer.write((y[0], x[0]), offsets(f, at, removed[n]).delta)
        writer.finish()


def _map_writers(group: Local, fitted: FittedSet, names: Sequence[str]) -> dict[str, ArrayWriter]:
    """Maps (y, x) in pixels."""
    return {
        name: create_array(
            group / name, fitted.source.shape, "<f4", dims=("y", "x"),
            chunks=fitted.source.signal.chunks[1:], fill_value=np.nan, attrs={"units": "pixel"},
        )
        for name in names
    }  # fmt: skip


@dataclass(frozen=True)
class _Told:
    """Of one tile: good pixels and some errors (px) of each set, and how the sets disagree."""

    good: list[int]
    sigma: list[F32]
    square: float
    freedom: int


def _tile_task(
    fitted: list[FittedSet],
    writers: dict[str, dict[str, ArrayWriter]],
    joint: dict[str, ArrayWriter],
    both: bool,
    job: tuple[tuple[int, int], dict[str, F64]],
) -> _Told:
    at, removed = job
    y, x = fitted[0].source.ranges(at)
    for f in fitted:
        for name in SAME_AS_SWEPT:
            ArrayReader(f.swept / name).read_chunk(at)  # linked: damage would be there for good
    found = [_write_set(f, at, removed[f.name], writers[f.name]) for f in fitted]
    delta, sigma = (
        np.stack([getattr(m, name) for m in found]).astype(float) for name in ("delta", "sigma")
    )
    masks = np.stack([m.flags for m in found])
    # Hyperbolic fringes turn over the window: each tile has its own axes.
    axes = [axis(f.shape, (y[0] + y[1] - 1) / 2, (x[0] + x[1] - 1) / 2) for f in fitted]
    value, error, chi2 = (combine_sets if both else combine_parallel)(axes, delta, sigma)
    values, errors = (v.reshape(-1, *chi2.shape).astype(np.float32) for v in (value, error))
    missing = ~np.isfinite(values).all(axis=0)
    # A flag counts where it costs the pixel its value; a set that others replace does not.
    flags = np.where(missing, np.bitwise_or.reduce(masks, axis=0), 0).astype(np.uint8)
    start = (y[0], x[0])
    for name, own_value, own_error in zip(outputs_of(both), values, errors, strict=True):
        joint[name].write(start, own_value)
        joint[f"{name}_sigma"].write(start, own_error)
    joint["mask"].write(start, flags)
    freedom = np.isfinite(delta).sum(axis=0) - len(values)
    goods = [np.isfinite(s) for s in sigma]
    number = max(1, min(TOLD, TOLD_IN_ALL // len(fitted[0].planes)))
    some = [_some(s[good].astype(np.float32), number) for s, good in zip(sigma, goods, strict=True)]
    return _Told(
        [int(good.sum()) for good in goods],
        some,
        float(chi2[~missing].sum()),
        int(freedom[~missing].sum()),
    )


@dataclass(frozen=True)
class SetOffsets:
    """Of one set in one tile.

    Attributes
    ----------
    delta, sigma : (y, x) float32
        Offset and its error, px; NaN where masked.
    flags : (y, x) uint8
    modes : (mode, y * x) float64
        Of the shape and the gauge.
    k : float
        Length of the fringe vector, rad/px.
    scale : float32
        Errors (px) over those of the sweep (rad).
    """

    delta: F32
    sigma: F32
    flags: U8
    modes: F64
    k: float
    scale: np.float32


def offsets(fitted: FittedSet, at: tuple[int, int], removed: F64) -> SetOffsets:
    """Offsets of a set in a tile, the modes that were removed from its phases."""
    source = fitted.source
    y, x = source.ranges(at)
    plane = fitted.planes[at[0] * source.grid[1] + at[1]]
    flags: U8 = ArrayReader(fitted.swept / "mask").read(y, x)
    phase = ArrayReader(fitted.swept / "phase").read(y, x)
    shape = (phase.shape[0], phase.shape[1])
    modes = local_modes(fitted.carrier, plane, shape)
    surface = (removed[:, 0] @ modes).reshape(shape)
    k = float(np.hypot(*fitted.shape.vector(*plane.centre)))
    scale = np.float32(np.sqrt(fitted.noise) / k)
    delta = ((wrapped(phase - plane.on(shape)) - surface) / k).astype(np.float32)
    sigma = np.asarray(ArrayReader(fitted.swept / "sigma").read(y, x) * scale)
    delta[flags != 0] = sigma[flags != 0] = np.nan
    return SetOffsets(delta, sigma, flags, modes, k, scale)


def _write_set(
    fitted: FittedSet, at: tuple[int, int], removed: F64, writers: dict[str, ArrayWriter]
) -> SetOffsets:
    """Write a set's own maps of a tile."""
    y, x = fitted.source.ranges(at)
    start, found = (y[0], x[0]), offsets(fitted, at, removed)
    writers["delta"].write(start, found.delta)
    writers["sigma"].write(start, found.sigma)
    if fitted.n_batches:
        everything = (0, fitted.n_batches)
        for name, array in (("batch_delta", "batch_phase"), ("batch_sigma", "batch_sigma")):
            maps = ArrayReader(fitted.swept / array).read(everything, y, x).astype(np.float32)
            if name == "batch_delta":
                surfaces = removed[:, 1:].T.astype(np.float32) @ found.modes.astype(np.float32)
                maps -= surfaces.reshape(maps.shape)
                maps *= np.float32(1 / found.k)
                maps += found.delta
            else:
                maps *= found.scale
            maps[:, found.flags != 0] = np.nan
            writers[name].write((0, *start), _rounded(maps))
    return found


def _create_set(folder: Path, fitted: FittedSet) -> dict[str, ArrayWriter]:
    """The set's folder: what is the sweep's is linked; writers of the rest."""
    create_group(folder)
    for name in SAME_AS_SWEPT:
        # Those that a killed fit has linked may be of a sweep that was damaged.
        shutil.rmtree(folder / name, ignore_errors=True)
        swept = fitted.swept / name
        assert isinstance(swept, Path)
        link_files(swept, folder / name)
    _write_frames(folder, fitted.swept)
    writers = _map_writers(folder, fitted, ("delta", "sigma"))
    (cy, cx), shape = fitted.source.signal.chunks[1:], fitted.source.shape
    n = fitted.n_batches
    for name in ("batch_delta", "batch_sigma") if n else ():
        writers[name] = create_array(
            folder / name, (n, *shape), "<f4", dims=("batch", "y", "x"), chunks=(n, cy, cx),
            fill_value=np.nan, attrs={"units": "pixel"},
        )  # fmt: skip
    return writers


def _create_joint(
    group: Path, fitted: FittedSet, outputs: tuple[str, ...]
) -> dict[str, ArrayWriter]:
    (cy, cx), shape = fitted.source.signal.chunks[1:], fitted.source.shape
    names = [array for name in outputs for array in (name, f"{name}_sigma")]
    writers = _map_writers(group, fitted, names)
    writers["mask"] = create_array(group / "mask", shape, "u1", dims=("y", "x"), chunks=(cy, cx))
    return writers


def _write_frames(folder: Path, maps: Local) -> None:
    """Parameters of every frame and the times of the batches, for those who read the fit."""
    frames = read_frames(maps)
    for array, data in (
        ("B", frames.B), ("A", frames.A), ("phi", frames.phi), ("dkx", frames.dk[:, 0]),
        ("dky", frames.dk[:, 1]), ("time", ArrayReader(maps / "time").read()),
    ):  # fmt: skip
        write_array(folder / array, data, dims=("time",))
    for array in ("batch_time", "batch_count"):
        write_array(folder / array, ArrayReader(maps / array).read(), dims=("batch",))


def outputs_of(both: bool) -> tuple[str, ...]:
    """Maps that sets give together, whose axes differ or not."""
    return ("delta_x", "delta_y") if both else ("delta_fringe",)


def _rounded(values: F32) -> F32:
    """Rounded to `MANTISSA` digits, in place; what is no number stays none."""
    bits, dropped = values.view(np.uint32), 23 - MANTISSA
    bits += np.uint32(1 << (dropped - 1))
    bits &= np.uint32(0xFFFFFFFF ^ ((1 << dropped) - 1))
    return values


def _some(values: F32, number: int) -> F32:
    """About a number of many values, evenly; a copy, lest they all stay in memory."""
    return values[:: max(1, len(values) // number)].copy()


def axis(shape: FringeShape, y: float, x: float) -> tuple[float, float]:
    """Unit vector (x, y) along which a set measures at a point."""
    kx, ky = shape.vector(y, x)
    k = float(np.hypot(kx, ky))
    return kx / k, ky / k
