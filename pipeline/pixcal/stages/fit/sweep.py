"""Scout and sweep: the only part of the fit that reads the cube.

Its result, ``RUN/sweep``, is valid for every model of the fringes' geometry, which is fitted to the
phases afterwards: a fit with another model does not read the cube again.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime
from pixcal.estimators.fringe_fit.fit_flags import fit_flags, typical_chi2
from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.sweep import (
    BOUND_PIXELS,
    SetSweep,
    TileMaps,
    frames_to_prime,
    plan_batches,
    sweep_tile,
)
from pixcal.estimators.fringe_fit.tile_fit import Tile
from pixcal.estimators.fringe_fit.tile_sums import Carrier, TileSums, sum_row, tile_plane
from pixcal.model.acquisition import Acquisition
from pixcal.model.arrays import F32, F64, Mask
from pixcal.model.config import result_options
from pixcal.model.errors import InputError, naming
from pixcal.model.options import Sweep as Config
from pixcal.stages.fit.scouting import CACHE_BYTES, scout_set
from pixcal.stages.fitted_shape import nominal_vector
from pixcal.stages.reduced_set import ReducedSet
from pixcal.stages.steps import run_steps
from pixcal.stages.tiles import STRIP
from pixcal.storage import cube
from pixcal.storage.artefact import Build, Workspace
from pixcal.storage.cube import ArrayWriter
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, file_digest, read_json, write_json
from pixcal.storage.place import Local
from pixcal.storage.stage import make, read_acquisition, require

# total of chi-squares kept to estimate the typical one (at least `MIN_SAMPLES` per tile)
CHI2_SAMPLES = 4096
MIN_SAMPLES = 16
MAPS = ("iota", "alpha", "phase", "sigma", "chi2")
BATCH_MAPS = ("batch_phase", "batch_sigma")
# binary digits kept of the batches' maps: the rest, far below their noise, would double the disk
# space
DIGITS = {"batch_phase": 10, "batch_sigma": 8, "batch_delta": 12}
TABLES = ("tiles", "sums")  # with a row of numbers for each tile


def load_run(run_dir: Path, command: str = "") -> Acquisition:
    """Acquisition of a run that must have been reduced and, for a ``command``, have fringes."""
    require(run_dir, "reduce")
    acquisition = read_acquisition(run_dir)
    if command and not acquisition.frames.fringes:
        raise InputError(
            f"{run_dir}: its acquisition.yaml lists no frames.fringes, which {command} needs; add "
            f"them there and run 'pixcal ingest' again"
        )
    return acquisition


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Sweep every fringe set of a run (the caller holds the run's lock)."""
    acquisition = load_run(run_dir, "fit")

    def body(made: Build) -> None:
        with naming(str(run_dir)):
            cubes = run_dir / "reduce" / "reduced.zarr"
            sets = sweep_sets(made, cubes, acquisition, config, runtime)
        made.summary = {"sets": sets}
        write_json(made.folder / "sweep.json", made.summary)

    inputs = {"reduce": require(run_dir, "reduce").key}
    return make(run_dir, STAGES["sweep"], result_options(config, Config), inputs, body)


def sweep_sets(
    made: Workspace, reduced: Local, acquisition: Acquisition, config: Config, runtime: Runtime
) -> dict[str, dict[str, Any]]:
    """Sweep every set of ``reduced.zarr`` into ``sweep.zarr``; their summaries by name."""
    cube.create_group(made.folder / "sweep.zarr")
    sets = {}
    for name in (listed.name for listed in acquisition.frames.fringes):
        nominal = nominal_vector(acquisition, name)
        with naming(f"fringe set {name!r}"):
            sets[name] = sweep_set(made, ReducedSet(reduced / name), nominal, config, runtime)
    return sets


@dataclass(frozen=True)
class _Job:
    """Input common to all tiles of a set."""

    source: ReducedSet
    writers: dict[str, ArrayWriter]
    common: SetSweep
    carrier: Carrier
    noise: float
    excess_scatter: float
    chi2_limit: float


def sweep_set(
    made: Workspace,
    source: ReducedSet,
    nominal: tuple[float, float],
    config: Config,
    runtime: Runtime,
) -> dict[str, Any]:
    """Sweep one set into ``sweep.zarr/<set name>`` of a build; returns its summary."""
    name = source.folder.name
    folder = made.folder / "sweep.zarr" / name
    cube.create_group(folder)
    scouted = folder / "scout.json"
    if not scouted.exists() or f"{name}:scout {file_digest(scouted)}" not in made.journal():
        scout_set(source, nominal, folder, runtime, name)
        made.note(f"{name}:scout {file_digest(scouted)}")
    facts: dict[str, Any] = read_json(scouted)
    frames = read_frames(folder)
    batches = plan_batches(source.time_s(), config.batch_frames)
    prime = frames_to_prime(frames, source.block)
    cube.write_array(folder / "batch_time", batches.time, dims=("batch",))
    cube.write_array(folder / "batch_count", batches.count, dims=("batch",))

    n_batches = len(batches.ranges)
    writers = _create_maps(folder, source, n_batches)
    cy, cx = source.signal.chunks[1:]
    # Codes held until the start model is fitted, and codes of the current chunk; sums, maps and
    # modes; arrays of each batch.
    held = 2 * min(prime, source.n_frames) + 4 * source.block
    kept = STRIP * (40 + 16 * n_batches)
    per_task = cy * cx * (held + 900 + 24 * n_batches + kept + source.more_bytes)
    runtime = within_memory(f"the fit of {name}", per_task, CACHE_BYTES, runtime)
    carrier = Carrier(tuple(facts["k"]), frames.reference)
    usual = (facts["noise"], facts["excess_scatter"])
    number = _bound_pixels(source)
    common = SetSweep(source.coding, frames, carrier.k, batches, prime, number)
    job = _Job(source, writers, common, carrier, *usual, config.chi2_limit)
    steps = {f"{name}:{strip[0]}": strip for strip in source.strips()}
    run_steps(made, partial(_sweep_strip, job), steps, runtime, label=f"fit {name}")
    for writer in writers.values():
        writer.finish()
    table = ArrayReader(folder / "tiles").read()
    bounds, chi2 = table[..., 1 : 1 + number], table[..., 1 + number :]
    chi2 = chi2[np.isfinite(chi2)]
    return facts | {
        "chunks": source.signal.n_chunks,
        "chunks_read": int(facts["chunks_read"] + table[..., 0].sum()),
        "bound_rad": float(np.nanmedian(bounds)) if np.isfinite(bounds).any() else None,
        "chi2_reduced": typical_chi2(chi2, source.n_frames - 3),
        "batch_frames": batches.frames,
        "batch_period_s": batches.period_s,
        "batch_note": batches.note,
        "frames": source.n_frames,
    }


def _create_maps(folder: Local, source: ReducedSet, n_batches: int) -> dict[str, ArrayWriter]:
    """Arrays that the tasks write, one chunk per strip."""
    (ny, nx), (cy, cx) = source.shape, source.map_chunks
    units = {"iota": "electron", "alpha": "electron", "phase": "radian", "sigma": "radian"}
    writers = {
        name: cube.create_map(folder / name, (ny, nx), (cy, cx), units=units.get(name, "1"))
        for name in MAPS
    }
    writers["mask"] = cube.create_array(
        folder / "mask", (ny, nx), "u1", dims=("y", "x"), chunks=(cy, cx)
    )
    for name in BATCH_MAPS if n_batches else ():
        writers[name] = cube.create_map(folder / name, (ny, nx), (cy, cx), number=n_batches)
    width = 1 + _bound_pixels(source) + _chi2_pixels(source)
    for name, numbers in zip(TABLES, (width, TileSums.width(n_batches)), strict=True):
        writers[name] = cube.create_array(
            folder / name,
            (*source.grid, numbers),
            "<f8",
            dims=("row", "column", "fact"),
            chunks=(1, min(STRIP, source.grid[1]), numbers),
            fill_value=np.nan,
        )
    return writers


def _bound_pixels(source: ReducedSet) -> int:
    """Pixels of each tile for the bound: several hundred in total, for any number of tiles."""
    return max(4, min(BOUND_PIXELS, 512 // math.prod(source.grid)))


def _chi2_pixels(source: ReducedSet) -> int:
    return max(MIN_SAMPLES, CHI2_SAMPLES // math.prod(source.grid))


def _sweep_strip(job: _Job, strip: Sequence[tuple[int, int]]) -> None:
    parts = [_sweep_tile(job, at) for at in strip]
    (y, _), (x, _) = job.source.ranges(strip[0])
    for name, writer in job.writers.items():
        of_tiles = name in TABLES
        data = np.concatenate([part.pop(name) for part in parts], axis=1 if of_tiles else -1)
        writer.write((*strip[0], 0) if of_tiles else (*(0,) * (data.ndim - 2), y, x), data)


def _sweep_tile(job: _Job, at: tuple[int, int]) -> dict[str, NDArray[Any]]:
    """A tile's maps, and its rows of the tables, by the names of their arrays."""
    source = job.source
    tile, mask = source.tile(at), source.mask(at)
    fresh = sum(not source.signal.holds((n, *at)) for n in range(source.n_blocks))
    maps = sweep_tile(tile, source.blocks(at), job.common)
    flags = fit_flags(mask, maps, job.noise, job.excess_scatter, job.chi2_limit)
    usable = (mask == 0) & np.isfinite(maps.chi2)
    chi2 = maps.chi2[usable]
    chi2 = chi2[:: -(-len(chi2) // _chi2_pixels(source)) or 1]
    facts = np.full((1, 1, job.writers["tiles"].shape[2]), np.nan)
    facts[0, 0, 0] = fresh
    facts[0, 0, 1 : 1 + len(maps.bound)] = maps.bound
    number = job.common.bound_pixels
    facts[0, 0, 1 + number : 1 + number + len(chi2)] = chi2
    sums = _sums(job, tile, maps, flags == 0)[None, None]
    arrays = {name: getattr(maps, name) for name in MAPS}
    # In place, once the sums have been taken.
    arrays |= {name: rounded(getattr(maps, name), DIGITS[name]) for name in BATCH_MAPS}
    return arrays | {"mask": flags, "tiles": facts, "sums": sums}


def rounded(values: F32, digits: int) -> F32:
    """Round to a number of binary digits, in place; NaN stay NaN."""
    bits, dropped = values.view(np.uint32), 23 - digits
    bits += np.uint32(1 << (dropped - 1))
    bits &= np.uint32(0xFFFFFFFF ^ ((1 << dropped) - 1))
    return values


def _sums(job: _Job, tile: Tile, maps: TileMaps, good: Mask) -> F64:
    """Sums of the tile's phases for the shapes that will be fitted to them."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = maps.iota / maps.alpha
    (kx, ky), carrier = maps.smooth.k, job.carrier
    slope = (kx - carrier.k[0], ky - carrier.k[1])
    plane = tile_plane(maps.phase, maps.sigma, ratio, good, slope, tile.centre)
    return sum_row(maps.phase, maps.sigma, good, maps.batch_phase, carrier, plane)


def read_frames(folder: Local) -> FrameParameters:
    """Frame parameters that the scout wrote to ``sweep.zarr/<set name>``."""
    g, dk = (ArrayReader(folder / name).read() for name in ("g", "dk"))
    return FrameParameters(g, dk, tuple(read_json(folder / "scout.json")["reference"]))
