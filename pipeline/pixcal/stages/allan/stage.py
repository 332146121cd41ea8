"""Stability: Allan deviation of the offset maps over batches of frames (paper, section 4.3).

``docs/reference/products.md`` describes ``allan.json``, the result of the stage for each set.
"""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pixcal import __version__
from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime
from pixcal.estimators.frame_series import stability
from pixcal.estimators.frame_series.stability import AllanCurve
from pixcal.kernels.allan import allan_deviation
from pixcal.kernels.medians import quantiles_of_parts
from pixcal.model.config import result_options
from pixcal.model.errors import DamagedError, InputError
from pixcal.model.options import Allan as Config
from pixcal.model.options import Region
from pixcal.stages.allan.batch_maps import (
    TILES_HIGH,
    Batches,
    positive_values,
    quantiles_of_region,
    region_name,
    sums_of_region,
)
from pixcal.stages.steps import run_steps
from pixcal.stages.tiles import Part
from pixcal.storage import cube
from pixcal.storage.artefact import Build
from pixcal.storage.cube import ArrayWriter
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, read_json, write_json
from pixcal.storage.stage import make, working

SCHEMA = "pixcal/allan/1"
COUNT_BYTES = 64 << 20  # counts of the digits of all values of a map (`quantiles_of_parts`)
# levels of the quantiles that describe the noise over a region
NOISE_LEVELS = (np.arange(64) + 0.5) / 64


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
    expected_of_batch = partial(positive_values, folder / "expected", None, region)
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
