"""The batch maps of a fringe set, and the changes common to the pixels of a region."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.frame_series import stability
from pixcal.kernels.allan import averaging_lengths, disjoint_differences
from pixcal.kernels.medians import quantiles_of_parts
from pixcal.model.arrays import F32, F64, I64
from pixcal.model.options import Region
from pixcal.stages.tiles import Part, Range, spans
from pixcal.storage.cube_reader import ArrayReader

TILES_HIGH = 4  # chunks of the fit per task, stacked vertically: one file for each length


@dataclass(frozen=True)
class Batches:
    """The batch maps of one fringe set, as written by the fit."""

    folder: Path
    n: int  # batches, gaps included
    lengths: tuple[int, ...]  # of averaging, batches
    window: tuple[int, int]
    chunks: tuple[int, int]  # of the fit's maps, (rows, columns)
    frames: int  # frames of a batch
    step_s: float  # from one batch to the next, seconds
    note: str  # note of the fit on them, or ""

    @classmethod
    def open(cls, folder: Path, facts: dict[str, Any]) -> "Batches":
        """Open ``fit.zarr/<set name>``; ``facts``: the set's part of ``fit.json``."""
        delta, time = ArrayReader(folder / "delta"), ArrayReader(folder / "batch_time").read()
        ny, nx = delta.shape
        cy, cx = delta.chunks
        step = round(float(time[1] - time[0]), 9) if len(time) > 1 else 0.0
        note = facts.get("batch_note", "")
        frames, lengths = facts["batch_frames"], averaging_lengths(len(time))
        return cls(folder, len(time), lengths, (ny, nx), (cy, cx), frames, step, note)

    def tiles(self, area: Region, times: int = 1) -> list[Part]:
        """Tiles of ``times`` vertically stacked chunks, cut to an area."""
        (y0, y1, x0, x1), (cy, cx) = area, self.chunks
        return list(product(spans(y1, times * cy, y0), spans(x1, cx, x0)))

    def read(self, name: str, tile: Part) -> F32:
        """``batch_delta`` or ``batch_sigma`` (batch, y, x) of a tile, px."""
        return ArrayReader(self.folder / name).read((0, self.n), *tile)


def region_name(region: Region) -> str:
    """Name in the format of the option: y0:y1,x0:x1."""
    y0, y1, x0, x1 = region
    return f"{y0}:{y1},{x0}:{x1}"


def sums_of_region(
    folder: Path, batches: Batches, region: Region, runtime: Runtime
) -> tuple[I64, list[F64]]:
    """Number of pixels of a region with each batch, and products for each length."""
    if not batches.lengths:
        return ArrayReader(batches.folder / "batch_count").read().astype(np.int64), []
    task = partial(_sums_task, batches, folder / "expected")
    squares, label = batches.tiles(region, TILES_HIGH), f"region {region_name(region)}"
    sums = run_tasks(task, squares, runtime, label=label)
    grams = [np.sum(parts, axis=0) for parts in zip(*(s[1] for s in sums), strict=True)]
    return np.sum([s[0] for s in sums], axis=0), grams


def _sums_task(batches: Batches, expected: Path, square: Part) -> tuple[I64, list[F64]]:
    """Number of pixels with each batch, and products of differences that pixels may share."""
    counts = np.zeros(batches.n, np.int64)
    grams: list[Any] = [0.0] * len(batches.lengths)
    for tile in batches.tiles((*square[0], *square[1])):
        series = batches.read("batch_delta", tile).reshape(batches.n, -1)
        noise = ArrayReader(expected).read(*tile).ravel()
        noise[noise <= 0] = np.nan
        counts += np.isfinite(series).sum(axis=1)
        for number, m in enumerate(batches.lengths):
            steps = disjoint_differences(series, m, 32)
            steps /= noise
            # Missing batches and pixels without errors are both NaN, and add zero.
            steps[np.isnan(steps)] = 0.0
            grams[number] = grams[number] + steps @ steps.T
    return counts, grams


def quantiles_of_region(
    path: Path, region: Region, usable: Sequence[int], runtime: Runtime
) -> tuple[dict[int, tuple[float, float, float]], int]:
    """Central 68 % and median over a region, by index of the length, and count of pixels."""
    quiet = replace(runtime, quiet=True)
    results = run_tasks(partial(_quantiles, path, region), usable, quiet, label="quantiles")
    quantiles = {
        n: (float(q[0]), float(q[1]), float(q[2]))
        for n, (q, count) in zip(usable, results, strict=True)
        if count
    }
    return quantiles, max((count for _, count in results), default=0)


def _quantiles(path: Path, region: Region, n: int) -> tuple[F64, int]:
    parts = partial(positive_values, path, (n, n + 1), region)
    return quantiles_of_parts(parts, (stability.ONE_SIGMA[0], 0.5, stability.ONE_SIGMA[1]))


def positive_values(path: Path, lengths: Range | None, region: Region) -> Iterator[F32]:
    """Finite positive values of a map over a region, a few rows at a time."""
    reader = ArrayReader(path)
    y0, y1, x0, x1 = region
    for rows in spans(y1, reader.chunks[-2], y0):
        values = reader.read(*([lengths] if lengths else []), rows, (x0, x1))
        # Zero means no noise.
        yield values[(values > 0) & (values < np.inf)]
