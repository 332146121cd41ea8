"""Reduce: from raw frames to electrons, with maps to weight every sample.

Reads the frames that ``RUN/ingest`` lists in strips, from the FITS files if they were not copied,
and verifies their checksums.
"""

import math
from collections import Counter
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.arrays import Mask
from pixcal.model.config import result_options
from pixcal.model.errors import InputError
from pixcal.model.flags import PixelFlag
from pixcal.model.options import Reduce
from pixcal.stages.reduce.black_cut_off import cut_off_warnings
from pixcal.stages.reduce.calibration import FLAT_FLOOR, Finishing, calibration_writers, finish
from pixcal.stages.reduce.columns import run_noted, strip_width
from pixcal.stages.reduce.dark_levels import level_warnings
from pixcal.stages.reduce.detector_summary import ROUNDING_ADU, Summary, linearity_report, summarise
from pixcal.stages.reduce.detector_warnings import detector_warnings, lamp_warnings, trail_warnings
from pixcal.stages.reduce.electrons import convert_bytes
from pixcal.stages.reduce.figures_of_merit import characterise
from pixcal.stages.reduce.flat_survey import rough_gain
from pixcal.stages.reduce.frame_statistics import (
    Measuring,
    measure,
    measure_bytes,
    statistics_writers,
)
from pixcal.stages.reduce.fringe_sets import Bounds, set_warnings, share_at_mean, write_set
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.multiplied import with_excess_noise
from pixcal.stages.reduce.read_noise import Nearby
from pixcal.stages.reduce.subtracted import subtracted_rate, subtracted_warnings
from pixcal.stages.tiles import STRIP, indices, span, strips
from pixcal.storage.artefact import Build, Workspace
from pixcal.storage.cube import create_group
from pixcal.storage.cube_place import base_of, chosen_base
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.folder import transit_bytes
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest, write_json
from pixcal.storage.place import Place
from pixcal.storage.stage import make, working

SCHEMA = "pixcal/reduce/1"

_SHARED_BYTES = 64 << 20
_LINES = 4  # fewest neighbouring rows or columns without light to report


Config = Reduce


def run(run_dir: Path, config: Config, runtime: Runtime) -> Manifest:
    """Make ``RUN/reduce`` from ``RUN/ingest``, unless it is up to date.

    The ``summary`` of its manifest holds gain, counts of flags and ``warnings``. Raises InputError
    if the gain is to be measured but cannot be.
    """
    with working(run_dir, "ingest") as inputs:
        base = chosen_base(config.cubes, run_dir, run_dir / "ingest")

        def body(made: Build) -> None:
            source = Ingested(run_dir / "ingest")
            reduction = reduce_frames(made, source, config, runtime)
            _report(made, source, config, reduction, runtime)

        def keep(_ready: Manifest) -> bool:
            return config.cubes is None or base_of(run_dir / "reduce") == base

        options = result_options(config)
        return make(run_dir, STAGES["reduce"], options, inputs, body, cubes=base, keep=keep)


@dataclass(frozen=True)
class Reduction:
    """Results of a reduction other than cubes and maps."""

    job: Measuring  # how the calibration frames were measured
    summary: Summary  # their results for the whole detector
    gain: float  # used gain, e-/ADU
    bounds: Bounds  # extremes over the good pixels
    sets: dict[str, dict[str, Any]]  # entry of each fringe set in ``reduce.json``

    def noise(self, config: Config) -> dict[str, Any]:
        """Entries of ``reduce.json`` on gain, read noise and subtracted dark signal."""
        summary, gain, fitted = self.summary, self.gain, self.summary.gain
        noise = summary.noise_measured_e(summary.before_rounding, gain)
        total = summary.noise_measured_e(summary.read_noise, gain)
        return {
            "gain_e_per_adu": {
                "declared": summary.declared.gain_e_per_adu,
                "measured": fitted.of_electrons[0] if fitted else None,
                "error": fitted.of_electrons[1] if fitted else None,
                "chi2_reduced": fitted.chi2_reduced if fitted else None,
                "levels_adu": list(fitted.levels) if fitted else None,
                "neighbours": [list(lag) for lag in fitted.neighbours] if fitted else [],
                "without_dark": fitted.without_dark if fitted else None,
                "of_noise": [fitted.gain, fitted.error] if fitted else None,
                "used": gain,
                "used_from": "measured" if summary.declared.gain_e_per_adu is None else config.gain,
            },
            "read_noise_e": {
                "declared": summary.declared.read_noise_e,
                "measured": noise[0] if noise else None,
                "error": noise[1] if noise else None,
                "with_rounding": total[0] if total else None,
                "before_rounding": summary.noise_before_rounding_e(gain),
                "used": self.bounds.read_noise,
                "used_error": gain * summary.read_noise[1] if summary.read_noise else None,
            },
            "subtracted_dark_e_s": gain * self.job.subtracted[0],
        }


def reduce_frames(made: Workspace, source: Ingested, config: Config, runtime: Runtime) -> Reduction:
    """Write ``calibration.zarr`` and ``reduced.zarr``; InputError if the gain is unknown."""
    undeclared = source.detector.gain_e_per_adu is None
    if (
        config.gain == "measured"
        and not undeclared
        and len(source.tables.get("flat", {}).get("file", ())) < 2
    ):
        raise InputError(
            "gain: 'measured' needs two flat frames or more; list them under frames.flat of "
            "acquisition.yaml, or use gain: declared"
        )
    exposures = source.exposures
    transit = transit_bytes(source.raw, made.cubes)

    def need(width: int) -> int:
        return _SHARED_BYTES + transit + measure_bytes(exposures.dark, exposures.flat, width)

    job = _measuring(source, config, made.scratch / "statistics")
    width = strip_width(source.arrays.values(), need, runtime)
    least = transit + max(measure_bytes(exposures.dark, exposures.flat, width), convert_bytes(4, 1))
    runtime = within_memory("reduce", least, _SHARED_BYTES, runtime)
    create_group(made.scratch)
    run_noted(made, partial(measure, job), indices(source.shape), width, runtime, "statistics")
    for writer in job.writers.values():
        writer.finish()
    summary = summarise(job, made.scratch / "statistics", source)
    summary = with_excess_noise(summary, source, job)
    gain = summary.gain_to_use(config.gain, bool(exposures.dark))
    bounds = _calibrate(made, source, summary, job, gain, runtime)
    sets = {}
    for name in exposures.fringes:
        sets[name.partition("/")[2]] = write_set(
            made,
            source,
            name,
            gain=gain,
            bounds=bounds,
            share=config.rounding_share,
            runtime=runtime,
        )
    return Reduction(job, summary, gain, bounds, sets)


def _measuring(source: Ingested, config: Config, folder: Place) -> Measuring:
    exposures, detector = source.exposures, source.detector
    gain = detector.gain_e_per_adu
    if gain is None:
        levels = np.zeros(0) if source.survey is None else source.survey.levels
        gain = rough_gain(source.arrays, levels, [group.frames for group in exposures.flat])
    frames = {
        name: source.arrays[name] for name in ("bias", "dark", "flat") if name in source.arrays
    }
    return Measuring(
        frames=frames,
        shape=source.shape,
        dark=exposures.dark,
        flat=exposures.flat,
        read_series=exposures.read_series,
        flats_timed=exposures.known,
        bright=None if source.survey is None else source.survey.brightest(FLAT_FLOOR),
        saturation=source.saturation("flat") if exposures.flat else math.inf,
        full=min(map(source.saturation, source.tables)),
        bands=source.survey is not None
        and source.survey.may_have_bands(
            frames, [group.frames for group in exposures.flat], source.saturation("flat")
        ),
        quantum=source.quantum,
        cut_off=source.cut_off,
        without_dark=None if source.black is None else source.black.without_dark,
        subtracted=subtracted_rate(source, gain),
        gain=gain,
        read_noise=max(detector.read_noise_e / gain, ROUNDING_ADU),
        options=config,
        writers=statistics_writers(folder, source.shape, len(exposures.flat)),
    )


def _calibrate(
    made: Workspace,
    source: Ingested,
    summary: Summary,
    measured: Measuring,
    gain: float,
    runtime: Runtime,
) -> Bounds:
    """Write ``calibration.zarr``; return its extremes over the good pixels."""
    read_noise = summary.read_noise_e(gain)
    job = Finishing(
        measured=measured,
        statistics=made.scratch / "statistics",
        usual=summary.usual,
        light=summary.light,
        gain=gain,
        read_noise=read_noise,
        floor=gain * ROUNDING_ADU * source.quantum,
        writers=calibration_writers(made.folder / "calibration.zarr", source.shape),
    )
    todo = strips(indices(source.shape), STRIP)
    ends = np.concatenate(run_tasks(partial(finish, job), todo, runtime, label="calibration"))
    for writer in job.writers.values():
        writer.finish()
    least, largest = float(ends[:, 0].min()), ends[:, 1:].max(axis=0)
    if not math.isfinite(least):
        return Bounds((1.0, 1.0), 0.0, 0.0, read_noise)
    return Bounds((least, float(largest[0])), float(largest[1]), float(largest[2]), read_noise)


# reduce.json


def _report(
    made: Build, source: Ingested, config: Config, reduction: Reduction, runtime: Runtime
) -> None:
    job, summary, sets = reduction.job, reduction.summary, reduction.sets
    piled = source.saturation_found if source.detector.saturation_adu is None else None
    warnings = [*source.exposures.warnings, *cut_off_warnings(source.cut_off)]
    warnings += subtracted_warnings(job.subtracted, reduction.gain)
    nearby = summary.read_noise and Nearby.of(job, summary.read_noise[0] ** 2)
    warnings += detector_warnings(summary, reduction.gain, piled, nearby)
    if source.survey is not None and source.exposures.known:
        light = source.survey.levels
        warnings += lamp_warnings([(g.exptime, light[list(g.frames)]) for g in job.flat])
    warnings += level_warnings(source, reduction.gain, summary.read_noise_e(reduction.gain))
    warnings += trail_warnings(made.folder / "calibration.zarr", source, reduction.gain)
    warnings += _dark_lines(ArrayReader(made.folder / "calibration.zarr" / "mask"), source.shape)
    for name, facts in sets.items():
        warnings += set_warnings(name, facts, source.detector.saturation_adu, config.rounding_share)
        facts["quantisation"]["share_at_mean"] = share_at_mean(facts, reduction.bounds)
        facts["flags"] = _count_flags(made.cubes / "reduced.zarr" / name / "mask", source.shape)
    report = {
        "schema": SCHEMA,
        **reduction.noise(config),
        "linearity": linearity_report(summary, job, reduction.gain),
        "saturation_adu": {
            "declared": source.detector.saturation_adu,
            "found": source.saturation_found,
            "used": job.saturation if math.isfinite(job.saturation) else None,
            "levels_left_out": int((~summary.usable).sum()),
            "full_frames": _flats(source, summary.full),
            "frames_above_step": _flats(source, summary.above_step),
        },
        "flags": _count_flags(made.folder / "calibration.zarr" / "mask", source.shape),
        "quantisation": {name: facts.pop("quantisation") for name, facts in sets.items()},
        "sets": sets,
        "warnings": warnings,
    }
    report["figures_of_merit"] = characterise(made, source, job, summary, nearby, report, runtime)
    write_json(made.folder / "reduce.json", report)
    made.summary.update({key: report[key] for key in ("gain_e_per_adu", "flags", "warnings")})


def _flats(source: Ingested, levels: Mask) -> list[int]:
    """Numbers of the flats of some levels (step,)."""
    chosen = zip(source.exposures.flat, levels, strict=True)
    return sorted(frame for group, wanted in chosen if wanted for frame in group.frames)


def _dark_lines(mask: ArrayReader, shape: tuple[int, int]) -> list[str]:
    """Warnings on neighbouring rows or columns without any light."""
    dark = {"rows": np.ones(shape[0], np.bool_), "columns": np.ones(shape[1], np.bool_)}
    for strip in strips(indices(shape), STRIP):
        (y0, y1), (x0, x1) = span(shape, strip)
        dead = mask.read((y0, y1), (x0, x1)) & PixelFlag.DEAD > 0
        dark["rows"][y0:y1] &= dead.all(axis=1)
        dark["columns"][x0:x1] &= dead.all(axis=0)
    said = []
    for name, lines in dark.items():
        ends = np.flatnonzero(np.diff(lines, prepend=False, append=False)).reshape(-1, 2)
        spans = [f"{a} to {b - 1}" for a, b in ends if b - a >= _LINES]
        if spans and not lines.all():
            said.append(
                f"{name} {', '.join(spans)} see no light and are masked as dead: an overscan, or a "
                "border of the detector"
            )
    return said


def _count_flags(mask: Place, shape: tuple[int, int]) -> dict[str, int]:
    """Pixels with each flag, and without any."""
    reader = ArrayReader(mask)
    counts: Counter[str] = Counter()
    for strip in strips(indices(shape), STRIP):
        values = reader.read(*span(shape, strip))
        counts["good"] += int((values == 0).sum())
        for flag in PixelFlag:
            counts[str(flag.name).lower()] += int((values & flag > 0).sum())
    return dict(counts)
