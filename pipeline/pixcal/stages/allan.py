"""Stability: Allan deviation of the offset maps over batches of frames (paper, section 4.3).

``docs/reference/products.md`` describes ``allan.json``, the result of the stage for each set.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from pixcal import __version__
from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.frame_series import stability
from pixcal.estimators.frame_series.stability import AllanCurve
from pixcal.kernels.allan import allan_deviation, averaging_lengths, disjoint_differences
from pixcal.kernels.quantiles import quantiles_of_parts
from pixcal.model.arrays import F32, F64, I64
from pixcal.model.config import result_options
from pixcal.model.errors import DamagedError, InputError
from pixcal.model.options import Allan as Config
from pixcal.model.options import Region
from pixcal.stages.steps import run_steps
from pixcal.stages.tiles import Part, Range, spans
from pixcal.storage import cube
from pixcal.storage.artefact import Build
from pixcal.storage.cube import ArrayReader, ArrayWriter
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, read_json, write_json
from pixcal.storage.stage import make, working

SCHEMA = "pixcal/allan/1"
COUNT_BYTES = 64 << 20  # counts of the digits of all values of a map (`quantiles_of_parts`)
# chunks of the fit per task, stacked vertically: one file for each length
TILES_HIGH = 4
# levels of the quantiles that describe the noise over a region
NOISE_LEVELS = (np.arange(64) + 0.5) / 64


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


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Make ``RUN/allan`` and ``allan.json`` from ``RUN/fit``: how the error falls with frames."""
    with working(run_dir, "fit") as inputs:
        facts = read_json(run_dir / "fit" / "fit.json")["sets"]
        sets = {
            name: Batches.open(run_dir / "fit" / "fit.zarr" / name, entry)
            for name, entry in facts.items()
        }
        for batches in sets.values():
            for region in filter(None, (config.region, *config.regions)):
                y0, y1, x0, x1 = region
                if not (0 <= y0 < y1 <= batches.window[0] and 0 <= x0 < x1 <= batches.window[1]):
                    raise InputError(
                        f"--region {region_name(region)}: not inside the window, which is "
                        f"0:{batches.window[0]},0:{batches.window[1]} (y0:y1,x0:x1, ends excluded)"
                    )

        def body(made: Build) -> None:
            cube.create_group(made.folder / "allan.zarr")
            result = {
                name: _measure_set(made, name, batches, config, runtime)
                for name, batches in sets.items()
            }
            whole = {"schema": SCHEMA, "pixcal": __version__, "sets": result}
            write_json(made.folder / "allan.json", whole)

        return make(run_dir, STAGES["allan"], result_options(config), inputs, body)


def _measure_set(
    made: Build, name: str, batches: Batches, config: Config, runtime: Runtime
) -> dict[str, Any]:
    """Maps and curves of one fringe set; returns its part of ``allan.json``."""
    folder = made.folder / "allan.zarr" / name
    (cy, cx), lengths = batches.chunks, batches.lengths
    tile_bytes = 4 * cy * cx * (2 * batches.n + len(lengths) * (TILES_HIGH + 2))
    # Copies of rows of a map, and counts of its values.
    values = 16 * TILES_HIGH * cy * batches.window[1] + COUNT_BYTES
    per_task, held = max(tile_bytes, values), values + 40 * stability.MAX_DRAWS * len(lengths)
    runtime = within_memory(f"the Allan deviation of {name}", per_task, held, runtime)
    if lengths:
        _write_maps(made, folder, batches, runtime)
    whole = (0, batches.window[0], 0, batches.window[1])
    main = _measure_region(folder, batches, config.region or whole, runtime)
    regions = {
        region_name(region): _measure_region(folder, batches, region, runtime)
        for region in config.regions
    }
    notes = [batches.note] if batches.note else []
    return main | {
        "warnings": notes + main["warnings"],
        "region": config.region,
        "batch_frames": batches.frames,
        "batch_seconds": batches.step_s,
        "regions": regions,
    }


def _write_maps(made: Build, folder: Path, batches: Batches, runtime: Runtime) -> None:
    """Write the deviation of every pixel, and that expected for one batch from fit errors."""
    cube.create_group(folder)
    name, lengths = folder.name, batches.lengths
    (cy, cx), shape = batches.chunks, batches.window
    chunks = (TILES_HIGH * cy, cx)
    adev = cube.create_array(
        folder / "adev",
        (len(lengths), *shape),
        "<f4",
        dims=("length", "y", "x"),
        chunks=(1, *chunks),
        fill_value=np.nan,
        attrs={"units": "pixel"},
    )
    expected = cube.create_map(folder / "expected", shape, chunks, units="pixel")
    squares = batches.tiles((0, shape[0], 0, shape[1]), TILES_HIGH)
    steps = {f"{name}:{y[0]},{x[0]}": (y, x) for y, x in squares}
    task = partial(_maps_task, batches, adev, expected)
    run_steps(made, task, steps, runtime, label=f"Allan deviation {name}")
    adev.finish()
    expected.finish()
    frames = np.array(lengths) * batches.frames
    cube.write_array(folder / "length", frames, dims=("length",), attrs={"units": "frames"})
    seconds = np.array(lengths) * batches.step_s
    cube.write_array(folder / "seconds", seconds, dims=("length",), attrs={"units": "s"})


def _maps_task(batches: Batches, adev: ArrayWriter, expected: ArrayWriter, square: Part) -> None:
    ((y0, y1), (x0, x1)), lengths = square, batches.lengths
    deviations = np.empty((len(lengths), y1 - y0, x1 - x0), np.float32)
    white = np.empty((y1 - y0, x1 - x0), np.float32)
    for y, x in batches.tiles((y0, y1, x0, x1)):
        part = (slice(y[0] - y0, y[1] - y0), slice(x[0] - x0, x[1] - x0))
        series = batches.read("batch_delta", (y, x)).reshape(batches.n, -1)
        shape = (len(lengths), y[1] - y[0], x[1] - x[0])
        deviations[:, *part] = allan_deviation(series, lengths).reshape(shape)
        # Over the batches present; NaN without any.
        sigma = batches.read("batch_sigma", (y, x))
        total, count = np.zeros(sigma.shape[1:]), np.zeros(sigma.shape[1:])
        for plane in sigma:
            there = np.isfinite(plane)
            total += np.where(there, plane, 0).astype(float) ** 2
            count += there
        white[part] = np.sqrt(np.where(count > 0, total, np.nan) / np.maximum(count, 1))
    adev.write((0, y0, x0), deviations)
    expected.write((y0, x0), white)


def _measure_region(
    folder: Path, batches: Batches, region: Region, runtime: Runtime
) -> dict[str, Any]:
    """Curve of the median pixel of a region, in the format of ``allan.json``."""
    lengths = batches.lengths
    counts, grams = sums_of_region(folder, batches, region, runtime)
    # A batch is present if most pixels have it: a few may lack one individually.
    present = counts > counts.max(initial=0) / 2
    filled = int(present.sum())
    common = {"n_batches": batches.n, "gaps": batches.n - filled}
    # Gaps may leave no two neighbouring means.
    runs = [np.convolve(present, np.ones(2 * m, int), "valid") for m in lengths]
    usable = [n for n, m in enumerate(lengths) if np.isin(2 * m, runs[n])]
    quantiles, pixels = quantiles_of_region(folder / "adev", region, usable, runtime)
    if filled < 3 or not quantiles:
        reason = f"{filled} of {batches.n} batches have data: too few for an Allan deviation"
        return _as_json(batches, [], stability.NO_CURVE, [], reason) | common | {"pixels": 0}
    chosen = [lengths[n] for n in quantiles]
    low, median, high = np.array(list(quantiles.values()), float).T
    expected_of_batch = partial(_positive, folder / "expected", None, region)
    noise, count = quantiles_of_parts(expected_of_batch, NOISE_LEVELS)
    if not count:
        raise DamagedError(folder / "expected", "no errors of batches")
    white = stability.white_population(present, chosen, noise if pixels > 1 else None)
    shared = stability.shared_noise([grams[n] for n in quantiles], pixels)
    curve = stability.fit_curve(chosen, median, np.log(high / low) / 2, pixels, shared, white)
    warnings = []
    if curve.knee is not None and curve.knee > batches.n / 2:
        at = f"{curve.knee * batches.frames:.0f} frames"
        warnings = [
            f"weak evidence of drift: fitted knee at {at}, is beyond half the run and not reported"
        ]
        curve = replace(curve, knee=None)
    expected = float(np.median(noise)) / np.sqrt(chosen)
    facts = _as_json(batches, chosen, curve, expected.tolist(), *warnings)
    return facts | common | {"pixels": pixels}


def _as_json(
    batches: Batches, lengths: list[int], curve: AllanCurve, expected: list[float], *warnings: str
) -> dict[str, Any]:
    return {
        "frames": [m * batches.frames for m in lengths],
        "seconds": [m * batches.step_s for m in lengths],
        "adev_px": curve.adev.tolist(),
        "adev_err_px": curve.error.tolist(),
        "adev_lo_px": curve.low.tolist(),
        "adev_hi_px": curve.high.tolist(),
        "slope": curve.slope,
        "slope_err": curve.slope_error,
        "white_expected_px": expected,
        "knee_frames": None if curve.knee is None else curve.knee * batches.frames,
        "warnings": list(warnings),
    }


# The batch maps of a fringe set, and the changes common to their pixels


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
    parts = partial(_positive, path, (n, n + 1), region)
    return quantiles_of_parts(parts, (stability.ONE_SIGMA[0], 0.5, stability.ONE_SIGMA[1]))


def _positive(path: Path, lengths: Range | None, region: Region) -> Iterator[F32]:
    """Finite positive values of a map over a region, a few rows at a time."""
    reader = ArrayReader(path)
    y0, y1, x0, x1 = region
    for rows in spans(y1, reader.chunks[-2], y0):
        values = reader.read(*([lengths] if lengths else []), rows, (x0, x1))
        # Zero means no noise.
        yield values[(values > 0) & (values < np.inf)]
