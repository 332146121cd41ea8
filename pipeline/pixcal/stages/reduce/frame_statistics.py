"""What the calibration frames say, column of chunks by column; each frame is read once.

A column's bias, dark and flat frames are combined into maps; its share of the photon transfer and
of the ladder of flats goes into small tables. All of it is left in a scratch store, so that a run
that was cut short goes on with the columns that are missing.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.bad_pixels import nonlinear
from pixcal.estimators.detector import (
    DarkLine,
    Rung,
    dark_line,
    median_and_sigma,
    response_rate,
    usual_variance,
)
from pixcal.kernels.photon_transfer import N_BINS, bin_pairs, pair_statistics
from pixcal.kernels.robust import BATCH, Combination, Combined
from pixcal.model.flags import PixelFlag
from pixcal.stages.reduce.columns import Index, extent, grid
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.ingested import MOST_ADU
from pixcal.storage.cube import CHUNK, ArrayReader, ArrayWriter, create_array, create_group
from pixcal.storage.place import Place

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

STATISTICS = (
    "bias",  # ADU
    "dark_rate",  # ADU/s
    "dark_rate_error",  # of a pixel of unit variance, 1/s
    "response",  # ADU/s
    "response_error",  # ADU/s
    "read_variance",  # ADU², of the read noise series
    "dark_variance",  # ADU², of all frames without light
    "dark_dof",
    "dark_charge",  # ADU, mean dark signal of these frames
    "kurtosis",
    "outliers",
    "flags",
)
"""Maps of the scratch store."""

_PAIR_LAMP_CHANGE = 0.05


@dataclass(frozen=True)
class Limits:
    """Limits of outliers and flags, see `pixcal.stages.reduce.Config`."""

    clip: float
    hot: float
    dead: float
    bright: float
    noisy: float
    nonlinear: float


@dataclass(frozen=True)
class Measuring:
    """What the first task of a column needs.

    Attributes
    ----------
    raw : Path or UrlPath
        ``raw.zarr`` of ``RUN/ingest``.
    shape : (int, int)
        Of the detector's window (y, x).
    dark, flat : sequence of Group
        Frames without light, and flats.
    read_series : Group or None
        The one of ``dark`` whose noise is the read noise.
    flats_timed : bool
        Whether the exposure times of the flats are known.
    saturation, full : float
        Level (ADU) from which on samples of flats are saturated; of any frames.
    quantum : float
        Step of the samples (ADU), 0 for real numbers.
    gain, read_noise : float
        Rough guess: e-/ADU, ADU.
    limits : Limits
        Of outliers and flags.
    writers : dict
        Arrays for the results.
    """

    raw: Place
    shape: tuple[int, int]
    dark: Sequence[Group]
    flat: Sequence[Group]
    read_series: Group | None
    flats_timed: bool
    saturation: float
    full: float
    quantum: float
    gain: float
    read_noise: float
    limits: Limits
    writers: Mapping[str, ArrayWriter]


def statistics_writers(folder: Path, shape: tuple[int, int], flats: int) -> dict[str, ArrayWriter]:
    """Make the arrays that `measure` writes: one chunk of each for a column."""
    tiles, n, rungs = grid(shape), len(STATISTICS), max(flats, 1)
    create_group(folder)
    made = {}
    for name, whole, chunks, dtype in (
        ("maps", (n, *shape), (n, *CHUNK[1:]), np.float32),
        ("pairs", (*tiles, 2, N_BINS, 3), (1, 1, 2, N_BINS, 3), np.float64),
        ("levels", (*tiles, rungs, 3), (1, 1, rungs, 3), np.float64),
    ):
        dims = [f"axis{axis}" for axis in range(len(whole))]
        made[name] = create_array(folder / name, whole, dtype, chunks=chunks, dims=dims)
    return made


def measure_bytes(dark: Sequence[Group], flat: Sequence[Group]) -> int:
    """Peak of `measure`: a batch in copies, one chunk, maps of every group."""
    chunk, tile = 4 * CHUNK[0] * CHUNK[1] * CHUNK[2], 8 * CHUNK[1] * CHUNK[2]
    return 6 * chunk + tile * (60 + 8 * len(dark) + 16 * len(flat))


def measure(job: Measuring, index: Index) -> None:
    """Combine the calibration frames of a column of chunks and write their statistics."""
    (y0, y1), (x0, x1) = extent(job.shape, index)
    maps = {name: np.zeros((y1 - y0, x1 - x0)) for name in STATISTICS}
    pairs = np.zeros((2, N_BINS, 3))
    levels = np.zeros(job.writers["levels"].shape[2:])
    line, noise = None, np.zeros((y1 - y0, x1 - x0))
    if job.dark:
        line, noise = _measure_dark(job, index, maps, pairs[0])
    if job.flat:
        levels[:] = _measure_flat(job, index, line, noise, maps, pairs[1])
    block = np.stack([maps[name] for name in STATISTICS])
    job.writers["maps"].write((0, y0, x0), block.astype(np.float32))
    job.writers["pairs"].write((*index, 0, 0, 0), pairs[None, None])
    job.writers["levels"].write((*index, 0, 0), levels[None, None])


def _measure_dark(
    job: Measuring, index: Index, maps: dict[str, F64], pairs: F64
) -> tuple[DarkLine, F64]:
    """Bias and dark signal; also the variance of a sample that is usual in this column (ADU²)."""
    combined = []
    for group in job.dark:
        wanted = pairs if group == job.read_series else None
        combined.append(_combine(job, group, index, None, wanted))
    times = [group.exptime for group in job.dark]
    line = dark_line([c.mean for c in combined], [c.kept for c in combined], times)
    maps["bias"], maps["dark_rate"] = line.bias, line.rate
    maps["dark_rate_error"] = np.sqrt(line.per_rate)
    dofs = [np.where(np.isfinite(c.variance), c.kept - 1, 0.0) for c in combined]
    dof = np.sum(dofs, axis=0)
    for group, found, weight in zip(job.dark, combined, dofs, strict=True):
        share = weight / np.maximum(dof, 1)
        maps["dark_variance"] += share * np.nan_to_num(found.variance)
        maps["dark_charge"] += share * np.maximum(np.nan_to_num(line.rate) * group.exptime, 0)
        maps["kurtosis"] += share * np.nan_to_num(found.excess_kurtosis)
        maps["outliers"] += found.seen - found.kept
        if group == job.read_series:
            charge = np.maximum(np.nan_to_num(line.rate) * group.exptime, 0)
            maps["read_variance"] = found.variance - charge / job.gain
    maps["dark_dof"] = dof
    missing = ~np.isfinite(line.bias) | ~np.isfinite(line.rate)
    maps["flags"][missing] += int(PixelFlag.NO_DATA)
    maps["flags"][line.bias >= job.full] += int(PixelFlag.HOT)
    usual = usual_variance(maps["dark_variance"], int(np.median(dof)))
    usual = job.read_noise**2 if np.isnan(usual) else usual
    return line, np.maximum(maps["dark_variance"], usual)


def _measure_flat(
    job: Measuring,
    index: Index,
    line: DarkLine | None,
    noise: F64,
    maps: dict[str, F64],
    pairs: F64,
) -> F64:
    """Response, and for each rung: median level (ADU), pixels, samples without weight."""
    rungs, levels = [], np.zeros((len(job.flat), 3))
    for number, group in enumerate(job.flat):
        exptime = group.exptime if job.flats_timed else 0.0
        pedestal = None if line is None else line.signal(exptime).astype(np.float32)
        found = _combine(job, group, index, pedestal, pairs)
        signal = np.where(found.seen == len(group.frames), found.mean, np.nan)
        level = median_and_sigma(signal)[0]
        levels[number] = level, signal.size, (len(group.frames) - found.seen).sum()
        # Few frames say little of one pixel's noise, and most pixels are like the others.
        usual = usual_variance(found.variance, len(group.frames) - 1)
        usual = max(level, 0) / job.gain + job.read_noise**2 if np.isnan(usual) else usual
        brighter = np.fmax(signal / level, 1) if level > 0 else 1.0
        variance = np.fmax(found.variance, usual * brighter) / len(group.frames)
        if line is not None:
            variance = variance + noise * line.variance(exptime)
        rungs.append(Rung(group.exptime, len(group.frames), signal, variance))
    maps["response"], maps["response_error"] = response_rate(rungs)
    maps["flags"][nonlinear(rungs, job.limits.nonlinear)] += int(PixelFlag.NONLINEAR)
    return levels


def _combine(
    job: Measuring, group: Group, index: Index, pedestal: F32 | None, pairs: F64 | None
) -> Combined:
    """Robust combination of a group; statistics of its pairs are added to ``pairs``."""
    lamp = group.array == "flat"
    combination = Combination(clip=job.limits.clip, lamp=lamp, quantum=job.quantum)
    for frames in _batches(job, group, index):
        if pedestal is not None:
            frames -= pedestal
        levels = combination.update(frames)
        if pairs is not None:
            pairs += _pair_sums(job, frames, levels, lamp)
    return combination.result()


def _pair_sums(job: Measuring, frames: F32, levels: F32, lamp: bool) -> F64:
    """Photon transfer of frames 0 and 1, 2 and 3, …, each made as bright as the other."""
    sums = np.zeros((N_BINS, 3))
    for n in range(0, len(frames) - 1, 2):
        (a, b), (first, second) = levels[n : n + 2], frames[n : n + 2]
        if not np.isfinite(a + b):
            continue
        gain = job.gain
        if not lamp:
            first, second, gain = first - a, second - b, np.inf
        elif abs(a - b) > _PAIR_LAMP_CHANGE * (a + b) / 2:
            continue
        else:
            first, second = first * ((a + b) / (2 * a)), second * ((a + b) / (2 * b))
        sums += bin_pairs(
            pair_statistics(
                first, second, gain=gain, read_noise=job.read_noise, quantum=job.quantum
            )
        )
    return sums


def _batches(job: Measuring, group: Group, index: Index) -> Iterator[F32]:
    """Frames (t, y, x) of a group, `BATCH` at a time, NaN where a sample cannot be used."""
    reader = ArrayReader(job.raw / group.array)
    chunk = np.empty(reader.chunks, reader.dtype)
    (y0, y1), (x0, x1) = extent(job.shape, index)
    at = -1
    for first in range(0, len(group.frames), BATCH):
        numbers = group.frames[first : first + BATCH]
        batch = np.empty((len(numbers), y1 - y0, x1 - x0), np.float32)
        for n, frame in enumerate(numbers):
            if frame // CHUNK[0] != at:
                at = frame // CHUNK[0]
                reader.read_chunk((at, *index), chunk)
            batch[n] = chunk[frame % CHUNK[0], : y1 - y0, : x1 - x0]
        batch[~(np.abs(batch) <= MOST_ADU)] = np.nan
        if group.array == "flat":
            # Only there: a pixel that is saturated without light shall be seen as hot.
            batch[batch >= job.saturation] = np.nan
        yield batch
