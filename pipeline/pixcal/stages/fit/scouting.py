"""Frame parameters of a set, from a few tiles that are read before the sweep."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, one_blas_thread, run_tasks
from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.scout import Scout, serial_map
from pixcal.model.arrays import U16, Indices
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage import cube
from pixcal.storage.manifest import write_json
from pixcal.storage.place import Local

SCOUT_SHARE = 0.01  # share of the tiles that the scout reads (of large windows)
SCOUT_TILES = 5  # tiles that the scout reads if they can be kept in memory
# memory for the scout's tiles; fixed, so that results do not depend on ``--memory``
CACHE_BYTES = 384 << 20
PRIME_BYTES = 48 << 20  # memory for the codes of the first fit of the scout
# chunks along time from which the first fit takes frames: one may hold little of a slow scan
SCOUT_BLOCKS = 16
# most frames of the first fit: three unknowns per pixel add a fraction 3 / `FIRST_FIT_FRAMES` to
# the variance of the frames' parameters; the time of the rank-three search grows with the square
FIRST_FIT_FRAMES = 128


def scout_tiles(grid: tuple[int, int], number: int) -> list[tuple[int, int]]:
    """Tiles spread over the window: the central one, then repeatedly the one farthest from all."""
    tiles = np.array(list(product(range(grid[0]), range(grid[1]))), dtype=float)
    middle = (np.array(grid) - 1) / 2
    chosen = [int(np.argmin(((tiles - middle) ** 2).sum(axis=1)))]
    distance = ((tiles - tiles[chosen[0]]) ** 2).sum(axis=1)
    while len(chosen) < min(number, len(tiles)):
        chosen.append(int(np.argmax(distance)))
        distance = np.minimum(distance, ((tiles - tiles[chosen[-1]]) ** 2).sum(axis=1))
    return [(int(tiles[n][0]), int(tiles[n][1])) for n in chosen]


def scout_set(
    source: ReducedSet, nominal: tuple[float, float], folder: Local, runtime: Runtime, name: str
) -> None:
    """Find the frame parameters of a set, near the nominal vector (rad/px), and write them."""
    n_tiles = len(source.tiles())
    chunk_bytes = int(np.prod(source.signal.chunks)) * source.signal.dtype.itemsize
    tile_bytes = source.n_blocks * chunk_bytes
    number = max(1, round(SCOUT_SHARE * n_tiles), min(SCOUT_TILES, CACHE_BYTES // tile_bytes))
    places = scout_tiles(source.grid, number)
    keep = len(places) * tile_bytes <= CACHE_BYTES
    tiles = [source.tile(at) for at in places]
    # The first tile must show fringes, so it needs enough good pixels.
    order = sorted(range(len(tiles)), key=lambda n: -int(tiles[n].good.sum() > 100))
    places, tiles = [places[n] for n in order], [tiles[n] for n in order]
    ny, nx = source.shape
    # In this process, wherever the sweep runs: other processes could not keep codes for the sweep.
    here = replace(runtime.here, quiet=True)
    if runtime.remote:
        here = here.with_workers(0)
    # Kept chunks; codes of the first fit, copies of a tile's share, and its Gram matrix; for each
    # task the sums of a tile, or chunks that are not kept.
    kept = len(places) * tile_bytes if keep else 0
    what = f"the frame phases of {name}"
    per_task = (4 if keep else max(4, len(places))) * chunk_bytes
    here = within_memory(what, per_task, 3 * PRIME_BYTES + kept, here)
    each = partial(run_tasks, runtime=here, label=f"phases {name}")
    scout = Scout(tiles, source.coding, nominal, ((ny - 1) / 2, (nx - 1) / 2), each)
    codes = partial(_codes, source, places, keep)

    first = _first_look(source, PRIME_BYTES // (len(places) * chunk_bytes))
    looks = run_tasks(partial(_look, codes), first, here, label=f"phases {name}")
    with one_blas_thread():
        parts = [scout.prime([np.concatenate(tile) for tile in zip(*looks, strict=True)])]
    del looks
    scout.each = serial_map
    if len(parts[0].g) < source.n_frames:
        # A chunk of each place and the memory of its solution.
        runtime = within_memory(what, 3 * len(places) * chunk_bytes, kept, runtime)
        task = partial(_solve_block, codes, scout)
        parts = run_tasks(task, range(source.n_blocks), runtime, label=f"phases {name}")
    arrays = {name: np.concatenate([getattr(p, name) for p in parts]) for name in ("g", "dk")}
    for array, data in (arrays | {"time": source.time_s()}).items():
        cube.write_array(folder / array, data, dims=("time", "component")[: data.ndim])
    again = 0 if keep else len(places) * (source.n_blocks + len(first))
    facts: dict[str, Any] = {
        "k": [float(v) for v in scout.k],
        "nominal_k": list(nominal),
        "reference": list(scout.reference),
        "moving": bool(scout.moving),
        "moving_significance": scout.moving_significance,
        "noise": scout.noise,
        "excess_scatter": scout.excess_scatter,
        "scout_tiles": len(places),
        "chunks_read": len(places) * source.n_blocks if keep else again,
    }
    write_json(folder / "scout.json", facts)


def _codes(source: ReducedSet, places: list[tuple[int, int]], keep: bool, block: int) -> list[U16]:
    """Codes (t, y, x) of a block of frames for each place, perhaps kept for the sweep."""
    return [source.codes(at, block, keep=keep) for at in places]


def _look(codes: Callable[[int], list[U16]], wanted: tuple[int, Indices]) -> list[U16]:
    block, frames = wanted
    return [of_tile[frames] for of_tile in codes(block)]


def _solve_block(codes: Callable[[int], list[U16]], scout: Scout, block: int) -> FrameParameters:
    return scout.solve(codes(block))


def _first_look(source: ReducedSet, blocks: int) -> list[tuple[int, Indices]]:
    """Blocks spread over the run and frames of each, as many in total as in ``blocks`` blocks."""
    wanted = min(source.n_blocks, max(blocks, SCOUT_BLOCKS))
    each = max(1, source.block * max(1, min(blocks, wanted)) // wanted)
    each = min(each, -(-FIRST_FIT_FRAMES // wanted))
    # At random: evenly spaced frames may all have the same phase.
    rng = np.random.default_rng(0)
    looks = []
    for n in np.linspace(0, source.n_blocks - 1, wanted).astype(int):
        frames = rng.permutation(min(source.block, source.n_frames - n * source.block))
        looks.append((int(n), np.sort(frames[:each])))
    return looks
