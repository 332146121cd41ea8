"""Reduce: from raw frames to electrons, with maps to weight every sample.

Reads the frames that ``RUN/ingest`` lists in strips, from the FITS files if they were not copied,
and verifies their checksums.
"""

import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from pixcal.engine.plan import within_memory
from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.detector.multiplication import (
    EXCESS,
    EXCESS_ERROR,
    MIN_FRAMES,
    Skew,
    is_multiplied,
    skew,
)
from pixcal.model.config import result_options
from pixcal.model.errors import InputError
from pixcal.model.options import Reduce
from pixcal.stages.reduce.calibration import FLAT_FLOOR, Finishing, calibration_writers, finish
from pixcal.stages.reduce.columns import run_noted, strip_width
from pixcal.stages.reduce.detector_summary import ROUNDING_ADU, Summary, summarise
from pixcal.stages.reduce.electrons import convert_bytes
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.flat_survey import rough_gain
from pixcal.stages.reduce.frame_statistics import measure
from pixcal.stages.reduce.fringe_sets import Bounds, write_set
from pixcal.stages.reduce.halves import frames_of
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.measuring import Measuring, measure_bytes, statistics_writers
from pixcal.stages.reduce.reduction import Reduction, write_reduction
from pixcal.stages.reduce.subtracted import subtracted_rate
from pixcal.stages.tiles import STRIP, centred, indices, strips
from pixcal.storage.artefact import Build, Workspace
from pixcal.storage.cube import create_group
from pixcal.storage.cube_place import base_of, chosen_base
from pixcal.storage.folder import transit_bytes
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import Manifest
from pixcal.storage.place import Place
from pixcal.storage.stage import make, working

_SHARED_BYTES = 64 << 20
SKEW_SIDE = 512  # longest side of the middle of the detector whose frames are read
SKEW_FRAMES = 16  # most frames of a level that are read

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
            write_reduction(made, source, config, reduction, runtime)

        def keep(_ready: Manifest) -> bool:
            return config.cubes is None or base_of(run_dir / "reduce") == base

        options = result_options(config)
        return make(run_dir, STAGES["reduce"], options, inputs, body, cubes=base, keep=keep)


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
    summary = _with_excess_noise(summary, source, job)
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


def _with_excess_noise(summary: Summary, source: Ingested, job: Measuring) -> Summary:
    """The summary with the gain of electrons, where a register multiplied them."""
    # The slope of photon transfer is then F² times that of the light. F² is that of a large
    # multiplication, as only the third moment of the noise is known.
    gain, dark = summary.gain, job.read_series
    if gain is None or dark is None or len(dark.frames) < MIN_FRAMES:
        return summary
    slope, variance = 1 / gain.gain, max(gain.read_variance[0], job.quantum**2 / 12)

    def of(group: Group, level: float) -> Skew | None:
        used, window = group.frames[:SKEW_FRAMES], centred(job.shape, SKEW_SIDE)
        frames = np.stack([*frames_of(source, group.array, used, window)])
        good = np.ones(frames.shape[1:], np.bool_)
        return skew(frames.astype(np.float32), level, variance, slope, good, job.quantum)

    groups = [(dark, 0.0)]
    groups += [
        (group, float(level))
        for group, level, used in zip(job.flat, summary.levels, summary.usable, strict=True)
        if used and len(group.frames) >= MIN_FRAMES
    ]
    points = [of(*one) for one in groups]
    if points[0] is None or not is_multiplied((p for p in points if p is not None), slope):
        return summary
    return replace(summary, gain=replace(gain, excess=(EXCESS, EXCESS * EXCESS_ERROR)))
