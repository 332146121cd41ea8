"""Statistics of the calibration frames by columns of chunks; each frame is read once.

Strips of neighbouring columns are read together. A column's bias, dark and flat frames are combined
into maps; its share of the photon transfer and of the exposure-time steps of flats goes into small
tables. All results are kept in a scratch store, so that an interrupted run resumes with the missing
columns.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixcal.estimators.detector import calibration
from pixcal.estimators.detector.bad_pixels import nonlinear
from pixcal.estimators.detector.calibration import ExposureLevel
from pixcal.estimators.detector.cut_off import without_cut_off
from pixcal.kernels.medians import finite_median
from pixcal.kernels.robust import Combined, lit
from pixcal.kernels.rounding import SHEPPARD
from pixcal.model.flags import PixelFlag
from pixcal.stages import tiles
from pixcal.stages.reduce.combine import combine
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.measuring import STATISTICS, Column, Measuring
from pixcal.stages.tiles import STRIP, Strip

# noise, in steps of the samples, below which the median of variances of few frames jumps
_COARSE = 3.0


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


def _measured(job: Measuring, strip: Strip) -> list[Column]:
    """Statistics of columns that are read together."""
    columns = [Column.begin(job, index) for index in strip]
    combined = [_combine_dark(job, group, columns) for group in job.dark]
    for column, *darks in zip(columns, *combined, strict=True) if combined else []:
        _measure_dark(job, column, darks)
    del combined
    for number, group in enumerate(job.flat):
        for column, combination in zip(columns, combine(job, group, columns), strict=True):
            _measure_level(job, column, number, combination)
    for column in columns:
        if job.flat:
            _measure_response(job, column)
    return columns


def _combine_dark(job: Measuring, group: Group, columns: Sequence[Column]) -> list[Combined]:
    """Combine frames without light in each column, corrected for noise that is cut off."""
    every = combine(job, group, columns)
    if group.array not in job.cut_off:
        return every
    lowest = job.cut_off[group.array].code
    made = [without_cut_off(one, len(group.frames), job.quantum, lowest) for one in every]
    if group == job.read_series:
        for column, (_, factor) in zip(columns, made, strict=True):
            column.pairs[0, :, 2:] *= factor
    return [combined for combined, _ in made]


def _measure_dark(job: Measuring, column: Column, combined: Sequence[Combined]) -> None:
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


def _measure_level(job: Measuring, column: Column, number: int, combined: Combined) -> None:
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


def _measure_response(job: Measuring, column: Column) -> None:
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
