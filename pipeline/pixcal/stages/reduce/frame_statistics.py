"""Statistics of the calibration frames by columns of chunks; each frame is read once.

Strips of neighbouring columns are read together. A column's bias, dark and flat frames are combined
into maps; its share of the photon transfer and of the exposure-time steps of flats goes into small
tables. All results are kept in a scratch store, so that an interrupted run resumes with the missing
columns.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.detector import calibration
from pixcal.estimators.detector.bad_pixels import (
    certainly_noisy,
    noisy,
    noisy_factor,
    nonlinear,
    variance_nearby,
)
from pixcal.estimators.detector.calibration import DarkLine, ExposureLevel
from pixcal.estimators.detector.cut_off import without_cut_off
from pixcal.estimators.detector.pair_noise import LineNoise, dark_pair_sums, flat_pair_sums
from pixcal.kernels.medians import finite_median
from pixcal.kernels.photon_transfer import COLUMNS, N_BINS
from pixcal.kernels.robust import BATCH, Combination, Combined, lit
from pixcal.kernels.rounding import SHEPPARD
from pixcal.model.arrays import F32, F64, Mask
from pixcal.model.flags import PixelFlag
from pixcal.model.options import Reduce
from pixcal.stages import tiles
from pixcal.stages.reduce.black_cut_off import CutOff
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.ingested import MOST_ADU
from pixcal.stages.tiles import STRIP, Index, Strip
from pixcal.storage.cube import CHUNK, ArrayWriter, create_array, create_group
from pixcal.storage.frame_reader import Reader
from pixcal.storage.place import Place

# maps of the scratch store
STATISTICS = (
    "bias",  # ADU
    "dark_rate",  # ADU/s
    "dark_rate_error",  # ADU/s
    "response",  # relative to the tile
    "response_error",
    "read_variance",  # ADU², of the read-noise series
    "dark_variance",  # ADU², of all frames without light, less the shot noise of dark signal
    "dark_dof",
    "kurtosis",
    "outliers",
    "shot",  # shot variance of flats over their light, 1/gain (ADU/e-); NaN where unknown
    "flags",
)

# noise, in steps of the samples, below which the median of variances of few frames jumps
_COARSE = 3.0


@dataclass(frozen=True)
class Measuring:
    """Input of the first task of a column."""

    frames: Mapping[str, Reader]  # a reader of each array
    shape: tuple[int, int]  # of the detector's window (y, x)
    dark: Sequence[Group]  # dark, flat: frames without light, and flats
    flat: Sequence[Group]
    read_series: Group | None  # the one of ``dark`` whose noise is the read noise
    flats_timed: bool  # whether the exposure times of the flats are known
    # number of a bright flat, and the level (ADU above bias) below which its pixels see no light
    bright: tuple[int, float] | None
    # saturation, full: level (ADU) from which samples are saturated: in flats, and in any frames
    saturation: float
    full: float
    bands: bool  # whether rows of flats may share more than those of frames without light
    quantum: float  # step of the samples (ADU), 0 for real numbers
    cut_off: Mapping[str, CutOff]  # arrays whose noise is cut off at their lowest code
    # whether the gain leaves out the noise of frames without light; None: to be found
    without_dark: bool | None
    subtracted: tuple[float, float]  # dark signal that the camera subtracts, and error, ADU/s
    gain: float  # gain, read_noise: rough values (e-/ADU, ADU)
    read_noise: float
    options: Reduce  # limits of outliers and flags
    writers: Mapping[str, ArrayWriter]  # arrays for the results


def statistics_writers(folder: Place, shape: tuple[int, int], flats: int) -> dict[str, ArrayWriter]:
    """Make the arrays that `measure` writes: one chunk of each for `STRIP` columns."""
    whole, n, steps = tiles.grid(shape), len(STATISTICS), max(flats, 1)
    wide = min(STRIP, whole[1])
    create_group(folder)
    made = {}
    for name, extents, chunks, dtype in (
        ("maps", (n, *shape), (n, *tiles.map_chunk(shape)), np.float32),
        ("pairs", (*whole, 3, N_BINS, COLUMNS), (1, wide, 3, N_BINS, COLUMNS), np.float64),
        ("levels", (*whole, steps, 4), (1, wide, steps, 4), np.float64),
    ):
        dims = [f"axis{axis}" for axis in range(len(extents))]
        made[name] = create_array(folder / name, extents, dtype, chunks=chunks, dims=dims)
    return made


def measure_bytes(dark: Sequence[Group], flat: Sequence[Group], width: int) -> int:
    """Peak of `measure`: copies of a column's batch; one chunk and the maps of each column."""
    chunk, tile = 4 * CHUNK[0] * CHUNK[1] * CHUNK[2], 8 * CHUNK[1] * CHUNK[2]
    maps = max(width, STRIP) * tile * (60 + 8 * len(dark) + 24 * len(flat))
    return (6 + width) * chunk + maps


@dataclass
class _Column:
    """Statistics of a column of chunks."""

    index: Index
    maps: dict[str, F64]
    pairs: F64
    levels: F64
    noise: F64  # typical variance of a sample in this column (ADU²)
    # pixels that photon transfer and read noise leave out: noisy without light, or unlit in flats
    loud: Mask
    full: Mask  # pixels with saturated samples in flats
    line_noise: LineNoise = field(default_factory=LineNoise)
    line: DarkLine | None = None
    steps: list[ExposureLevel] = field(default_factory=list)
    variances: list[F64] = field(default_factory=list)  # of a sample of each pixel in each step

    @classmethod
    def begin(cls, job: Measuring, index: Index) -> "_Column":
        (y0, y1), (x0, x1) = tiles.extent(job.shape, index)
        shape = y1 - y0, x1 - x0
        maps = {name: np.zeros(shape) for name in STATISTICS}
        levels = np.zeros(job.writers["levels"].shape[2:])
        pairs = np.zeros((3, N_BINS, COLUMNS))
        loud, full = np.zeros((2, *shape), np.bool_)
        return cls(index, maps, pairs, levels, np.zeros(shape), loud, full)


def measure(job: Measuring, parts: Sequence[Strip]) -> None:
    """Combine the calibration frames of columns of chunks and write their statistics."""
    by_index = {column.index: column for strip in parts for column in _measured(job, strip)}
    for strip in tiles.strips(list(by_index), STRIP):
        columns = [by_index[index] for index in strip]
        (i, j), ((y0, _), (x0, _)) = strip[0], tiles.span(job.shape, strip)
        maps = [np.stack([column.maps[name] for name in STATISTICS]) for column in columns]
        job.writers["maps"].write((0, y0, x0), np.concatenate(maps, axis=2).astype(np.float32))
        job.writers["pairs"].write((i, j, 0, 0, 0), np.stack([c.pairs for c in columns])[None])
        job.writers["levels"].write((i, j, 0, 0), np.stack([c.levels for c in columns])[None])


def _measured(job: Measuring, strip: Strip) -> list[_Column]:
    """Statistics of columns that are read together."""
    columns = [_Column.begin(job, index) for index in strip]
    combined = [_combine_dark(job, group, columns) for group in job.dark]
    for column, *darks in zip(columns, *combined, strict=True) if combined else []:
        _measure_dark(job, column, darks)
    del combined
    for number, group in enumerate(job.flat):
        for column, combination in zip(columns, _combine(job, group, columns), strict=True):
            _measure_level(job, column, number, combination)
    for column in columns:
        if job.flat:
            _measure_response(job, column)
    return columns


def _combine_dark(job: Measuring, group: Group, columns: Sequence[_Column]) -> list[Combined]:
    """Combine frames without light in each column, corrected for noise that is cut off."""
    every = _combine(job, group, columns)
    if group.array not in job.cut_off:
        return every
    lowest = job.cut_off[group.array].code
    made = [without_cut_off(one, len(group.frames), job.quantum, lowest) for one in every]
    if group == job.read_series:
        for column, (_, factor) in zip(columns, made, strict=True):
            column.pairs[0, :, 2:] *= factor
    return [combined for combined, _ in made]


def _measure_dark(job: Measuring, column: _Column, combined: Sequence[Combined]) -> None:
    """Measure bias and dark signal, and the typical variance of a sample in this column."""
    maps = column.maps
    times = [group.exptime for group in job.dark]
    counts = [c.kept.astype(float) for c in combined]
    beyond = np.zeros(counts[0].shape, np.bool_)
    for n in np.argsort(times):
        # A pixel that is full without light tells no more at longer exposures.
        counts[n][beyond] = 0
        beyond |= combined[n].mean >= job.full
    line = calibration.dark_line([c.mean for c in combined], counts, times)
    maps["bias"], maps["dark_rate"] = line.bias, line.rate
    rate = np.nan_to_num(line.rate) + job.subtracted[0]
    charges = [np.maximum(rate * time, 0) for time in times]
    least = int(np.argmin(times))
    read = calibration.usual_variance(
        combined[least].variance - charges[least] / job.gain, len(job.dark[least].frames) - 1
    )
    read = max(read if read > 0 else job.read_noise**2, SHEPPARD * job.quantum**2)
    dofs = [np.where(np.isfinite(c.variance), c.kept - 1, 0.0) for c in combined]
    dof = np.sum(dofs, axis=0)
    # Subtract the shot noise of the dark signal from the variance; it adds to the error.
    shots = [charge / job.gain for charge in charges]
    weights = [n * (read / (read + shot)) ** 2 for n, shot in zip(dofs, shots, strict=True)]
    weight = np.sum(weights, axis=0)
    pooled = np.zeros_like(line.bias)
    for group, dark, n, w, shot in zip(job.dark, combined, dofs, weights, shots, strict=True):
        variance, share = np.nan_to_num(dark.variance), w / np.where(weight > 0, weight, 1)
        pooled += n / np.maximum(dof, 1) * variance
        maps["dark_variance"] += share * (variance - shot)
        maps["kurtosis"] += share * np.nan_to_num(dark.excess_kurtosis)
        maps["outliers"] += dark.seen - dark.kept
        if group == job.read_series:
            maps["read_variance"] = dark.variance - shot
    maps["dark_dof"] = np.rint(weight)
    missing = ~np.isfinite(line.bias) | ~np.isfinite(line.rate)
    maps["flags"][missing] += int(PixelFlag.NO_DATA)
    maps["flags"][line.bias >= job.full] += int(PixelFlag.HOT)
    usual = calibration.usual_variance(pooled, int(np.median(dof)))
    usual = job.read_noise**2 if np.isnan(usual) else usual
    column.line, column.noise = line, np.maximum(pooled, usual)
    maps["dark_rate_error"] = np.sqrt(line.per_rate * column.noise)


def _measure_level(job: Measuring, column: _Column, number: int, combined: Combined) -> None:
    """Measure a level of the flats, and count its samples without weight."""
    group, line = job.flat[number], column.line
    exptime = group.exptime if job.flats_timed else 0.0
    frames = len(group.frames)
    signal = np.where(combined.seen == frames, combined.mean, np.nan)
    column.levels[number, 1:3] = signal.size, (frames - combined.seen).sum()
    # Few frames give a poor estimate of one pixel's noise, and most pixels are similar.
    seen = lit(signal)
    level = finite_median(signal[seen])
    usual = calibration.usual_variance(combined.variance[seen], frames - 1)
    if usual < (_COARSE * job.quantum) ** 2:
        usual = float(np.nanmean(combined.variance[seen]))
    usual = max(level, 0) / job.gain + job.read_noise**2 if np.isnan(usual) else usual
    # A brighter pixel has more photon noise, and the same read noise.
    photons = max(usual - float(np.median(column.noise)), 0.0)
    brighter = np.fmax(signal / level - 1, 0) if level > 0 else 0.0
    variance = np.fmax(combined.variance, usual + photons * brighter) / frames
    if line is not None:
        variance = variance + column.noise * line.variance(exptime)
    column.steps.append(ExposureLevel(group.exptime, frames, signal, variance, usual))
    column.variances.append(combined.variance)


def _measure_response(job: Measuring, column: _Column) -> None:
    """Measure the response, the levels of the tile, and pixels with deviating levels."""
    maps, levels = column.maps, calibration.step_levels(column.steps)
    column.levels[:, 0] = levels
    steps, levels = calibration.unsaturated(column.steps, levels, float(np.median(column.noise)))
    for number, (before, after) in enumerate(zip(column.steps, steps, strict=True)):
        ended = np.isfinite(before.signal) & ~np.isfinite(after.signal)
        column.full |= ended
        column.levels[number, 3] = ended.sum()
    maps["response"], maps["response_error"] = calibration.relative_response(steps, levels)
    maps["shot"] = calibration.shot_over_light(
        [replace(step, variance=new) for step, new in zip(steps, column.variances, strict=True)],
        levels,
        maps["dark_variance"],
        maps["dark_rate"] if job.flats_timed else 0 * maps["dark_rate"],
        job.gain,
    )
    lost = ~np.isfinite(maps["response"]) & column.full
    maps["flags"][lost] += int(PixelFlag.SATURATED)
    maps["flags"][nonlinear(steps, levels, job.options.nonlinear_share)] += int(PixelFlag.NONLINEAR)


def _combine(job: Measuring, group: Group, columns: Sequence[_Column]) -> list[Combined]:
    """Robust combination of a group in each column; statistics of its pairs are added there."""
    lamp = group.array == "flat"
    # The median deviation of noise that is cut off may be zero.
    cut = job.cut_off.get(group.array)
    step = max(job.quantum, cut.noise if cut else 0.0)
    every = [Combination(clip=job.options.clip_sigma, lamp=lamp, quantum=step) for _ in columns]
    pedestals: list[F32 | None] = [None] * len(columns)
    charges = [0.0] * len(columns)
    if lamp:
        exptime = group.exptime if job.flats_timed else 0.0
        hot = job.options.hot_sigma
        for n, line in enumerate(column.line for column in columns):
            if line is not None:
                pedestals[n] = line.signal(exptime).astype(np.float32)
                rate = calibration.usual_rate(line.rate, hot) + job.subtracted[0]
                charges[n] = exptime * rate if exptime else 0.0
    for number, batch in enumerate(_batches(job, group, tuple(c.index for c in columns))):
        for column, combination, pedestal, charge, samples in zip(
            columns, every, pedestals, charges, batch, strict=True
        ):
            if lamp:
                column.full |= (samples >= job.saturation).any(axis=0)
            frames = _usable(job, samples, lamp)
            if pedestal is not None:
                frames -= pedestal
            levels = combination.update(frames)
            if not lamp and number == 0:
                column.loud |= _loud(job, frames - levels[:, None, None])
            if group == job.read_series and number == 0:
                column.loud |= _unlit(job, column.index, frames[0])
            if lamp or group == job.read_series:
                frames[:, column.loud] = np.nan
                # The pairs are frames 0 and 1, 2 and 3, and so on.
                of_samples = job.read_noise, job.quantum
                if lamp:
                    full = job.saturation - (0.0 if pedestal is None else pedestal)
                    guess = job.gain, *of_samples, column.line_noise
                    column.pairs[1:] += flat_pair_sums(
                        frames, levels, *guess, full, charge, job.bands
                    )
                else:
                    frames -= levels[:, None, None]
                    sums = dark_pair_sums(frames, *of_samples)
                    column.line_noise.add(frames, sums, *of_samples)
                    column.pairs[0] += sums
    return [combination.result() for combination in every]


def _loud(job: Measuring, frames: F32) -> Mask:
    """Pixels whose noise without light is far above typical."""
    if len(frames) < 2:
        return np.zeros(frames.shape[1:], np.bool_)
    variance = frames.var(axis=0, ddof=1, dtype=float)
    dof = np.full(variance.shape, len(frames) - 1.0)
    # A level at the boundary of two codes gives either one.
    usual = max(calibration.usual_variance(variance, len(frames) - 1), job.quantum**2 / 4)
    if not (variance > certainly_noisy(len(frames) - 1) * usual).any():
        return np.zeros(variance.shape, np.bool_)
    unknown = np.full(variance.shape, np.nan)
    # Read noise allows for unlike pixels, and photon transfer is to be of the same ones.
    factor = noisy_factor(
        job.options.noisy_factor, variance, len(frames) - 1, job.quantum, unlike=True
    )
    nearby = variance_nearby(variance, dof, usual)
    return noisy(variance, dof, nearby, unknown, 0 * dof, factor)


def _unlit(job: Measuring, index: Index, dark: F32) -> Mask:
    """Pixels that a bright flat leaves as ``dark`` (y, x): overscan, reference pixels, dead ones.

    The noise of such pixels is not that of the others.
    """
    if job.bright is None:
        return np.zeros(dark.shape, np.bool_)
    frame, least = job.bright
    flat = job.frames["flat"].read((frame, frame + 1), *tiles.extent(job.shape, index))[0]
    return np.asarray(flat.astype(np.float32) - dark < least)


def _usable(job: Measuring, samples: NDArray[Any], lamp: bool) -> F32:
    """Samples as real numbers; NaN if unusable."""
    frames = samples.astype(np.float32)
    frames[~(np.abs(frames) <= MOST_ADU)] = np.nan
    if lamp:
        # Only in flats: a pixel that saturates without light is to be flagged hot.
        frames[frames >= job.saturation] = np.nan
    return frames


def _batches(job: Measuring, group: Group, strip: Strip) -> Iterator[list[NDArray[Any]]]:
    """Frames (t, y, x) of a group in each column of a strip, `BATCH` at a time."""
    reader = job.frames[group.array]
    rows, (x0, x1) = tiles.span(job.shape, strip)
    for first in range(0, len(group.frames), BATCH):
        numbers = group.frames[first : first + BATCH]
        batch = np.empty((len(numbers), rows[1] - rows[0], x1 - x0), reader.dtype)
        for _, run in groupby(enumerate(numbers), key=lambda at: at[1] - at[0]):
            # Successive frames are read at once.
            (n, frame), *more = run
            last = n + 1 + len(more)
            reader.read((frame, frame + last - n), rows, (x0, x1), out=batch[n:last])
        yield tiles.by_column(batch)
