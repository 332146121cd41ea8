"""Stability: Allan deviation of the offset maps over batches of frames (paper, section 4.3).

``docs/reference/products.md`` describes ``allan.json``, what the stage leaves for each set.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pixcal import __version__
from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime
from pixcal.estimators.frame_series.stability import (
    MAX_DRAWS,
    NO_CURVE,
    AllanCurve,
    fit_curve,
    shared_noise,
    white_population,
)
from pixcal.kernels.allan import allan_deviation, averaging_lengths
from pixcal.model.arrays import F32, F64
from pixcal.model.config import result_options
from pixcal.model.errors import InputError
from pixcal.model.options import Allan as Config
from pixcal.model.options import Region
from pixcal.stages.allan.batches import (
    TILES_HIGH,
    Batches,
    Tile,
    noise_levels,
    quantiles_of_region,
    region_name,
    sums_of_region,
)
from pixcal.stages.steps import run_steps
from pixcal.storage.artefact import Build
from pixcal.storage.cube import ArrayWriter, create_array, create_group, create_map, write_array
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, read_json, write_json
from pixcal.storage.stage import make, working

SCHEMA = "pixcal/allan/1"
COUNT_BYTES = 64 << 20  # of the digits of all values of a map (`quantiles_of_parts`)


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Make ``RUN/allan`` and ``allan.json`` from ``RUN/fit``: how the error falls with frames."""
    with working(run_dir, "fit") as inputs:
        facts = read_json(run_dir / "fit" / "fit.json")["sets"]
        sets = {
            name: Batches.open(run_dir / "fit" / "fit.zarr" / name, found)
            for name, found in facts.items()
        }
        for batches in sets.values():
            for region in (config.region, *config.regions):
                _check_region(region, batches.window)

        def body(made: Build) -> None:
            create_group(made.folder / "allan.zarr")
            result = {
                name: _measure_set(made, name, batches, config, runtime)
                for name, batches in sets.items()
            }
            whole = {"schema": SCHEMA, "pixcal": __version__, "sets": result}
            write_json(made.folder / "allan.json", whole)

        return make(run_dir, STAGES["allan"], result_options(config), inputs, body)


def _check_region(region: Region | None, window: tuple[int, int]) -> None:
    if region is None:
        return
    y0, y1, x0, x1 = region
    if not (0 <= y0 < y1 <= window[0] and 0 <= x0 < x1 <= window[1]):
        raise InputError(
            f"--region {region_name(region)}: not inside the window, which is "
            f"0:{window[0]},0:{window[1]} (y0:y1,x0:x1, ends excluded)"
        )


def _measure_set(
    made: Build, name: str, batches: Batches, config: Config, runtime: Runtime
) -> dict[str, Any]:
    """Maps and curves of one fringe set; returns its part of ``allan.json``."""
    folder = made.folder / "allan.zarr" / name
    lengths = averaging_lengths(batches.n)
    cy, cx = batches.chunks
    tile_bytes = 4 * cy * cx * (2 * batches.n + len(lengths) * (TILES_HIGH + 2))
    # Some rows of a map in copies, and counts of its values.
    values = 16 * TILES_HIGH * cy * batches.window[1] + COUNT_BYTES
    per_task, held = max(tile_bytes, values), values + 40 * MAX_DRAWS * len(lengths)
    runtime = within_memory(f"the Allan deviation of {name}", per_task, held, runtime)
    if lengths:
        _write_maps(made, folder, name, batches, lengths, runtime)
    whole = (0, batches.window[0], 0, batches.window[1])
    main = _measure_region(folder, batches, lengths, config.region or whole, runtime)
    regions = {
        region_name(region): _measure_region(folder, batches, lengths, region, runtime)
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


def _write_maps(
    made: Build,
    folder: Path,
    name: str,
    batches: Batches,
    lengths: tuple[int, ...],
    runtime: Runtime,
) -> None:
    """Deviation of every pixel, and what its error of the fit lets expect for one batch."""
    create_group(folder)
    (cy, cx), shape = batches.chunks, batches.window
    chunks = (TILES_HIGH * cy, cx)
    adev = create_array(
        folder / "adev", (len(lengths), *shape), "<f4", dims=("length", "y", "x"),
        chunks=(1, *chunks), fill_value=np.nan, attrs={"units": "pixel"},
    )  # fmt: skip
    expected = create_map(folder / "expected", shape, chunks, units="pixel")
    squares = batches.tiles((0, shape[0], 0, shape[1]), TILES_HIGH)
    steps = {f"{name}:{y[0]},{x[0]}": (y, x) for y, x in squares}
    task = partial(_maps_task, batches, lengths, adev, expected)
    run_steps(made, task, steps, runtime, label=f"Allan deviation {name}")
    adev.finish()
    expected.finish()
    frames = np.array(lengths) * batches.frames
    write_array(folder / "length", frames, dims=("length",), attrs={"units": "frames"})
    seconds = np.array(lengths) * batches.step_s
    write_array(folder / "seconds", seconds, dims=("length",), attrs={"units": "s"})


def _maps_task(
    batches: Batches,
    lengths: tuple[int, ...],
    adev: ArrayWriter,
    expected: ArrayWriter,
    square: Tile,
) -> None:
    (y0, y1), (x0, x1) = square
    deviations = np.empty((len(lengths), y1 - y0, x1 - x0), np.float32)
    white = np.empty((y1 - y0, x1 - x0), np.float32)
    for y, x in batches.tiles((y0, y1, x0, x1)):
        part = (slice(y[0] - y0, y[1] - y0), slice(x[0] - x0, x[1] - x0))
        series = batches.read("batch_delta", (y, x)).reshape(batches.n, -1)
        shape = (len(lengths), y[1] - y[0], x[1] - x[0])
        deviations[:, *part] = allan_deviation(series, lengths).reshape(shape)
        white[part] = _root_mean_square(batches.read("batch_sigma", (y, x)))
    adev.write((0, y0, x0), deviations)
    expected.write((y0, x0), white)


def _root_mean_square(sigma: F32) -> F64:
    """Over the batches that there are; NaN where there are none."""
    total, count = np.zeros(sigma.shape[1:]), np.zeros(sigma.shape[1:])
    for plane in sigma:
        there = np.isfinite(plane)
        total += np.where(there, plane, 0).astype(float) ** 2
        count += there
    return np.sqrt(np.where(count > 0, total, np.nan) / np.maximum(count, 1))


def _measure_region(
    folder: Path, batches: Batches, lengths: tuple[int, ...], region: Region, runtime: Runtime
) -> dict[str, Any]:
    """Curve of the median pixel of a region, as it goes into ``allan.json``."""
    counts, grams = sums_of_region(folder, batches, lengths, region, runtime)
    # A batch is there when most pixels have it: a few may lack one for reasons of their own.
    present = counts > counts.max(initial=0) / 2
    filled = int(present.sum())
    common = {"n_batches": batches.n, "gaps": batches.n - filled}
    # Gaps may leave no two neighbouring means.
    runs = [np.convolve(present, np.ones(2 * m, int), "valid") for m in lengths]
    usable = [n for n, m in enumerate(lengths) if np.isin(2 * m, runs[n])]
    quantiles, pixels = quantiles_of_region(folder / "adev", region, usable, runtime)
    if filled < 3 or not quantiles:
        reason = f"{filled} of {batches.n} batches have data: too few for an Allan deviation"
        return _as_json(batches, [], NO_CURVE, [], [reason]) | common | {"pixels": 0}
    chosen = [lengths[n] for n in quantiles]
    low, median, high = np.array(list(quantiles.values()), float).T
    noise = noise_levels(folder / "expected", region)
    white = white_population(present, chosen, noise if pixels > 1 else None)
    shared = shared_noise([grams[n] for n in quantiles], pixels)
    curve = fit_curve(chosen, median, np.log(high / low) / 2, pixels, shared, white)
    warnings = []
    if curve.knee is not None and curve.knee > batches.n / 2:
        at = f"{curve.knee * batches.frames:.0f} frames"
        warnings = [f"the noise is not quite white: fitted knee at {at}, beyond half of the run"]
        curve = replace(curve, knee=None)
    expected = float(np.median(noise)) / np.sqrt(chosen)
    facts = _as_json(batches, chosen, curve, expected.tolist(), warnings)
    return facts | common | {"pixels": pixels}


def _as_json(
    batches: Batches,
    lengths: Sequence[int],
    curve: AllanCurve,
    expected: list[float],
    warnings: list[str],
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
        "warnings": warnings,
    }
