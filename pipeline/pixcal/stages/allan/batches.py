"""The batch maps of a fringe set, as the fit left them, and what their pixels share."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.frame_series.stability import ONE_SIGMA
from pixcal.kernels.allan import disjoint_differences
from pixcal.kernels.quantiles import quantiles_of_parts
from pixcal.model.arrays import F32, F64, I64
from pixcal.model.errors import DamagedError
from pixcal.model.options import Region
from pixcal.storage.cube import ArrayReader

# a task takes so many of the fit's chunks, one above the other: one file of each length
TILES_HIGH = 4
# levels of the quantiles that describe the noise over a region
NOISE_LEVELS = (np.arange(64) + 0.5) / 64

Range = tuple[int, int]
Tile = tuple[Range, Range]


@dataclass(frozen=True)
class Batches:
    """The batch maps of one fringe set, as the fit left them."""

    folder: Path
    n: int  # batches, gaps included
    window: tuple[int, int]
    chunks: tuple[int, int]  # of the fit's maps, (rows, columns)
    frames: int  # frames of a batch
    step_s: float  # from one batch to the next, seconds
    note: str  # what the fit says of them, or ""

    @classmethod
    def open(cls, folder: Path, facts: dict[str, Any]) -> "Batches":
        """Look at ``fit.zarr/<set name>``; ``facts`` are the set's part of ``fit.json``."""
        delta, time = ArrayReader(folder / "delta"), ArrayReader(folder / "batch_time").read()
        ny, nx = delta.shape
        cy, cx = delta.chunks
        step = round(float(time[1] - time[0]), 9) if len(time) > 1 else 0.0
        note = facts.get("batch_note", "")
        return cls(folder, len(time), (ny, nx), (cy, cx), facts["batch_frames"], step, note)

    def tiles(self, area: Region, times: int = 1) -> list[Tile]:
        """So many chunks one above the other, cut to an area."""
        (y0, y1, x0, x1), (cy, cx) = area, self.chunks
        return list(product(_spans(y0, y1, times * cy), _spans(x0, x1, cx)))

    def read(self, name: str, tile: Tile) -> F32:
        """``batch_delta`` or ``batch_sigma`` (batch, y, x) of a tile, px."""
        return ArrayReader(self.folder / name).read((0, self.n), *tile)


def _spans(start: int, stop: int, size: int) -> Iterator[Range]:
    for edge in range(start // size * size, stop, size):
        yield max(edge, start), min(edge + size, stop)


def region_name(region: Region) -> str:
    """As the option writes it: y0:y1,x0:x1."""
    y0, y1, x0, x1 = region
    return f"{y0}:{y1},{x0}:{x1}"


def sums_of_region(
    folder: Path, batches: Batches, lengths: tuple[int, ...], region: Region, runtime: Runtime
) -> tuple[I64, list[F64]]:
    """Pixels of a region that have each batch, and for each length their products."""
    if not lengths:
        return ArrayReader(batches.folder / "batch_count").read().astype(np.int64), []
    sums = run_tasks(
        partial(_sums_task, batches, lengths, folder / "expected"),
        batches.tiles(region, TILES_HIGH),
        runtime,
        label=f"region {region_name(region)}",
    )
    grams = [np.sum(parts, axis=0) for parts in zip(*(s[1] for s in sums), strict=True)]
    return np.sum([s[0] for s in sums], axis=0), grams


def _sums_task(
    batches: Batches, lengths: tuple[int, ...], expected: Path, square: Tile
) -> tuple[I64, list[F64]]:
    """Pixels that have each batch, and the products of differences that pixels may share."""
    counts = np.zeros(batches.n, np.int64)
    grams: list[Any] = [0.0] * len(lengths)
    for tile in batches.tiles((*square[0], *square[1])):
        series = batches.read("batch_delta", tile).reshape(batches.n, -1)
        noise = ArrayReader(expected).read(*tile).ravel()
        noise[noise <= 0] = np.nan
        counts += np.isfinite(series).sum(axis=1)
        for number, m in enumerate(lengths):
            steps = disjoint_differences(series, m, 32)
            steps /= noise
            # Missing batches and pixels without errors are NaN both, and add nothing.
            steps[np.isnan(steps)] = 0.0
            grams[number] = grams[number] + steps @ steps.T
    return counts, grams


def quantiles_of_region(
    path: Path, region: Region, usable: Sequence[int], runtime: Runtime
) -> tuple[dict[int, tuple[float, float, float]], int]:
    """Central 68 % and median over a region for each length's number, and how many pixels."""
    quiet = replace(runtime, quiet=True)
    found = run_tasks(partial(_quantiles, path, region), usable, quiet, label="quantiles")
    quantiles = {
        n: (float(q[0]), float(q[1]), float(q[2]))
        for n, (q, count) in zip(usable, found, strict=True)
        if count
    }
    return quantiles, max((count for _, count in found), default=0)


def _quantiles(path: Path, region: Region, n: int) -> tuple[F64, int]:
    parts = partial(_positive, path, (n, n + 1), region)
    return quantiles_of_parts(parts, (ONE_SIGMA[0], 0.5, ONE_SIGMA[1]))


def _positive(path: Path, lengths: Range | None, region: Region) -> Iterator[F32]:
    """Finite values of a map over a region that are above zero, some rows at a time."""
    reader = ArrayReader(path)
    y0, y1, x0, x1 = region
    for rows in _spans(y0, y1, reader.chunks[-2]):
        values = reader.read(*([lengths] if lengths else []), rows, (x0, x1))
        # No noise gives zero.
        yield values[(values > 0) & (values < np.inf)]


def noise_levels(path: Path, region: Region) -> F64:
    """Quantiles of the expected deviation of one batch over a region, px."""
    levels, count = quantiles_of_parts(partial(_positive, path, None, region), NOISE_LEVELS)
    if not count:
        raise DamagedError(f"{path}: no errors of batches", path)
    return levels
