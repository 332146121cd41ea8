"""Combine the frames of a group, column by column, without loud, unlit and saturated samples."""

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.detector import calibration
from pixcal.estimators.detector.bad_pixels import (
    certainly_noisy,
    noisy,
    noisy_factor,
    variance_nearby,
)
from pixcal.estimators.detector.pair_noise import dark_pair_sums, flat_pair_sums
from pixcal.kernels.robust import BATCH, Combination, Combined
from pixcal.model.arrays import F32, Mask
from pixcal.stages import tiles
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.ingested import MOST_ADU
from pixcal.stages.reduce.measuring import Column, Measuring
from pixcal.stages.tiles import Index, Strip


def combine(job: Measuring, group: Group, columns: Sequence[Column]) -> list[Combined]:
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
