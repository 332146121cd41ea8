"""Scout and sweep: the only part of the fit that reads the cube.

What it leaves, ``RUN/sweep``, holds for every model of the fringes' geometry, which is fitted to
the phases afterwards: trying another model does not read the cube again.
"""

from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import make_plan
from pixcal.engine.progress import Progress
from pixcal.engine.run import Runtime, one_blas_thread, run_tasks
from pixcal.estimators.batches import Batches, plan_batches
from pixcal.estimators.fringes import FrameParameters
from pixcal.estimators.scout import Scout
from pixcal.estimators.sweep import BOUND_PIXELS, frames_to_prime, sweep_tile
from pixcal.model.acquisition import Acquisition
from pixcal.model.config import parse, quantity
from pixcal.model.errors import DamagedError, InputError
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.artefact import (
    Build,
    Manifest,
    artefact_key,
    build,
    read_json,
    require,
    up_to_date,
    write_json,
)
from pixcal.storage.cube import ArrayReader, ArrayWriter, create_array, create_group, write_array

FORMAT = 1
SCOUT_SHARE = 0.01
"""Share of the tiles that the scout reads (of large windows)."""
SCOUT_TILES = 5
"""Tiles that the scout reads where they can be kept in memory."""
CACHE_BYTES = 384 << 20
"""Memory for the scout's tiles; fixed, so that results do not depend on ``--memory``."""
PRIME_BYTES = 96 << 20
"""Memory for the codes of the scout's first look."""
LOOKS = 16
"""Chunks along time that the first look takes frames from: one may hold little of a slow scan."""
MAPS = ("iota", "alpha", "phase", "sigma", "chi2", "count")
BATCH_MAPS = ("batch_phase", "batch_sigma")


@dataclass(frozen=True)
class Config:
    """Options of the sweep."""

    batch_frames: int | None = quantity(None, low=4, doc="frames of an Allan batch (500, or fewer)")


def nominal_vector(acquisition: Acquisition, name: str) -> tuple[float, float]:
    """Nominal fringe vector (kx, ky) of a set in rad/px (paper, equation 4)."""
    (baseline,) = (s.baseline_mm for s in acquisition.frames.fringes if s.name == name)
    optics = acquisition.optics
    per_mm = (
        2 * np.pi * acquisition.detector.pitch_um * 1e3
        / (optics.wavelength_nm * optics.distance_mm)
    )  # fmt: skip
    return baseline[0] * per_mm, baseline[1] * per_mm


def load_run(run_dir: Path) -> tuple[Acquisition, Manifest]:
    """Acquisition and manifest of the reduce stage of a run."""
    manifest = require(run_dir, "reduce", 1)
    file = run_dir / "ingest" / "acquisition.json"
    return parse(Acquisition, read_json(file), str(file)), manifest


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Sweep every fringe set of a run (the caller holds the run's lock).

    Raises
    ------
    InputError
        If there are no fringe sets, or a set has no fringes to fit; the set is named.
    """
    acquisition, reduced = load_run(run_dir)
    if not acquisition.frames.fringes:
        raise InputError(f"{run_dir}: the acquisition lists no fringes (frames.fringes), no fit")
    inputs = {"reduce": reduced.key}
    key = artefact_key("sweep", FORMAT, asdict(config), inputs)
    if (ready := up_to_date(run_dir, "sweep", key)) is not None:
        return ready
    with build(run_dir, "sweep", FORMAT, asdict(config), inputs) as made:
        create_group(made.folder / "sweep.zarr")
        sets = {}
        for fringe_set in acquisition.frames.fringes:
            nominal = nominal_vector(acquisition, fringe_set.name)
            source = ReducedSet(run_dir / "reduce" / "reduced.zarr" / fringe_set.name)
            try:
                sets[fringe_set.name] = _sweep_set(
                    made, source, fringe_set.name, nominal, config, runtime
                )
            except DamagedError:
                raise
            except InputError as error:
                raise InputError(f"{run_dir}: fringe set {fringe_set.name!r}: {error}") from error
        made.summary = {"sets": sets}
        write_json(made.folder / "sweep.json", made.summary)
    return require(run_dir, "sweep", FORMAT)


def scout_tiles(grid: tuple[int, int], number: int) -> list[tuple[int, int]]:
    """Tiles spread over the window: the central one, then each time the one farthest from all."""
    tiles = np.array(list(product(range(grid[0]), range(grid[1]))), dtype=float)
    middle = (np.array(grid) - 1) / 2
    chosen = [int(np.argmin(((tiles - middle) ** 2).sum(axis=1)))]
    distance = ((tiles - tiles[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < min(number, len(tiles)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((tiles - tiles[chosen[-1]]) ** 2).sum(axis=1))
    return [(int(tiles[n][0]), int(tiles[n][1])) for n in chosen]


def _sweep_set(
    made: Build,
    source: ReducedSet,
    name: str,
    nominal: tuple[float, float],
    config: Config,
    runtime: Runtime,
) -> dict[str, Any]:
    folder = made.folder / "sweep.zarr" / name
    create_group(folder)
    done = made.journal()
    if f"{name}:scout" not in done:
        with one_blas_thread():
            found = _scout_set(source, nominal, folder, runtime, name)
        write_json(folder / "scout.json", found)
        made.note(f"{name}:scout")
    facts: dict[str, Any] = read_json(folder / "scout.json")
    frames = read_frames(folder)
    batches = plan_batches(source.time_s(), config.batch_frames)
    prime = frames_to_prime(frames, source.block)
    write_array(folder / "batch_time", batches.time, dims=("batch",))
    write_array(folder / "batch_count", batches.count, dims=("batch",))

    writers = _create_maps(folder, source, len(batches.ranges))
    cy, cx = source.signal.chunks[1:]
    # Codes held until the start model stands and those of the chunk at hand, the two sets of sums,
    # the start model's temporaries, and what is kept of each batch.
    held = 2 * min(prime, source.n_frames) + 6 * source.block
    per_task = cy * cx * (held + 900 + 32 * len(batches.ranges))
    plan = make_plan(f"the fit of {name}", per_task, CACHE_BYTES, runtime)
    tiles = [t for t in source.tiles() if f"{name}:{t[0]},{t[1]}" not in done]
    carrier = (float(facts["k"][0]), float(facts["k"][1]))
    run_tasks(
        partial(_sweep_task, source, writers, frames, carrier, batches, prime),
        tiles,
        runtime.with_workers(plan.workers),
        label=f"fit {name}",
        done=lambda n, _: made.note(f"{name}:{tiles[n][0]},{tiles[n][1]}"),
    )
    for writer in writers.values():
        writer.finish()
    table = ArrayReader(folder / "tiles").read()
    bounds = table[..., 1:]
    return facts | {
        "chunks": source.signal.n_chunks,
        "chunks_read": int(facts["chunks_read"] + table[..., 0].sum()),
        "bound_rad": float(np.nanmedian(bounds)) if np.isfinite(bounds).any() else None,
        "batch_frames": batches.frames,
        "batch_period_s": batches.period_s,
        "batch_note": batches.note,
        "frames": source.n_frames,
    }


def _create_maps(folder: Path, source: ReducedSet, n_batches: int) -> dict[str, ArrayWriter]:
    """Arrays that the tasks write, one chunk a tile."""
    ny, nx = source.shape
    cy, cx = source.signal.chunks[1:]
    writers = {
        name: create_array(
            folder / name, (ny, nx), "<f4", dims=("y", "x"), chunks=(cy, cx), fill_value=np.nan
        )
        for name in MAPS
    }
    for name in BATCH_MAPS if n_batches else ():
        writers[name] = create_array(
            folder / name, (n_batches, ny, nx), "<f4", dims=("batch", "y", "x"),
            chunks=(n_batches, cy, cx), fill_value=np.nan,
        )  # fmt: skip
    width = 1 + _bound_pixels(source)
    writers["tiles"] = create_array(
        folder / "tiles", (*source.grid, width), "<f8", dims=("row", "column", "fact"),
        chunks=(1, 1, width), fill_value=np.nan,
    )  # fmt: skip
    return writers


def _bound_pixels(source: ReducedSet) -> int:
    """Pixels of each tile for the bound: some hundreds in all, whatever the number of tiles."""
    rows, columns = source.grid
    return max(4, min(BOUND_PIXELS, 512 // (rows * columns)))


def _sweep_task(
    source: ReducedSet,
    writers: dict[str, ArrayWriter],
    frames: FrameParameters,
    carrier: tuple[float, float],
    batches: Batches,
    prime: int,
    at: tuple[int, int],
) -> None:
    tile = source.tile(at)
    fresh = sum(not source.signal.holds((n, *at)) for n in range(source.n_blocks))
    number = _bound_pixels(source)
    maps = sweep_tile(
        tile, source.blocks(at), source.coding, frames, carrier, batches, prime, number
    )
    start = (tile.y[0], tile.x[0])
    for name in MAPS:
        writers[name].write(start, getattr(maps, name))
    for name in BATCH_MAPS if "batch_phase" in writers else ():
        writers[name].write((0, *start), getattr(maps, name))
    facts = np.full((1, 1, 1 + number), np.nan)
    facts[0, 0, 0] = fresh
    facts[0, 0, 1 : 1 + len(maps.bound)] = maps.bound
    writers["tiles"].write((*at, 0), facts)


def _scout_set(
    source: ReducedSet, nominal: tuple[float, float], folder: Path, runtime: Runtime, name: str
) -> dict[str, Any]:
    """Find the frame parameters of a set and write them; returns facts for the summary."""
    n_tiles = source.grid[0] * source.grid[1]
    chunk_bytes = int(np.prod(source.signal.chunks)) * source.signal.dtype.itemsize
    tile_bytes = source.n_blocks * chunk_bytes
    number = max(1, round(SCOUT_SHARE * n_tiles), min(SCOUT_TILES, CACHE_BYTES // tile_bytes))
    places = scout_tiles(source.grid, number)
    keep = len(places) * tile_bytes <= CACHE_BYTES
    tiles = [source.tile(at) for at in places]
    # The first tile must show fringes: one with few good pixels is a bad place to look.
    order = sorted(range(len(tiles)), key=lambda n: -int(tiles[n].good.sum() > 100))
    places, tiles = [places[n] for n in order], [tiles[n] for n in order]
    ny, nx = source.shape
    scout = Scout(tiles, source.coding, nominal, ((ny - 1) / 2, (nx - 1) / 2))

    # The chunks kept; the first look's codes, copies of a tile's share, and its Gram matrix.
    kept = len(places) * tile_bytes if keep else 0
    make_plan(f"the scout of {name}", 3 * PRIME_BYTES, kept, runtime.with_workers(1))
    first = _first_look(source, PRIME_BYTES // (len(places) * chunk_bytes))
    codes = [
        np.concatenate([source.codes(at, n, keep=keep)[some] for n, some in first]) for at in places
    ]
    scout.prime(codes)
    del codes
    parts = []
    with Progress(f"scout {name}", source.n_blocks, quiet=runtime.quiet) as progress:
        for block in range(source.n_blocks):
            parts.append(scout.solve([source.codes(at, block, keep=keep) for at in places]))
            progress.advance()
    g = np.concatenate([p.g for p in parts])
    dk = np.concatenate([p.dk for p in parts])
    for array, data in (("g", g), ("dk", dk), ("time", source.time_s())):
        dims = ("time", "component")[: data.ndim]
        write_array(folder / array, data, dims=dims)
    again = 0 if keep else len(places) * (source.n_blocks + len(first))
    return {
        "k": [float(v) for v in scout.k],
        "nominal_k": list(nominal),
        "reference": list(scout.reference),
        "moving": bool(scout.moving),
        "moving_significance": scout.moving_significance,
        "scout_tiles": len(places),
        "chunks_read": len(places) * source.n_blocks if keep else again,
    }


def _first_look(source: ReducedSet, blocks: int) -> list[tuple[int, NDArray[np.intp]]]:
    """Blocks spread over the run and frames of each, as many in all as in ``blocks`` whole ones."""
    wanted = min(source.n_blocks, max(blocks, LOOKS))
    each = max(1, source.block * max(1, min(blocks, wanted)) // wanted)
    # At random: frames at even steps may have the same phase again and again.
    rng = np.random.default_rng(0)
    looks = []
    for n in np.linspace(0, source.n_blocks - 1, wanted).astype(int):
        frames = rng.permutation(min(source.block, source.n_frames - n * source.block))
        looks.append((int(n), np.sort(frames[:each])))
    return looks


def read_frames(folder: Path) -> FrameParameters:
    """Frame parameters that the scout left in ``sweep.zarr/<set name>``."""
    y, x = read_json(folder / "scout.json")["reference"]
    return FrameParameters(
        ArrayReader(folder / "g").read(), ArrayReader(folder / "dk").read(), (float(y), float(x))
    )
