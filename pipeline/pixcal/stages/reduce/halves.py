"""Averages of the even and of the odd frames of a series: their common part is fixed pattern."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.run import Runtime, run_tasks
from pixcal.estimators.detector.emva import Measure
from pixcal.model.arrays import F64, Mask
from pixcal.model.flags import PixelFlag
from pixcal.stages.reduce.detector_summary import Summary
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.tiles import Part
from pixcal.storage.artefact import Build
from pixcal.storage.cube import CHUNK
from pixcal.storage.cube_reader import ArrayReader

SIDE = 1024  # longest side of the middle of the detector whose nonuniformity is measured
_MIN_PIXELS = 16
_FRAMES = 64  # most frames of a series that are read


@dataclass(frozen=True)
class Halves:
    """Averages of the even and of the odd frames over the middle of the detector (ADU)."""

    dark: F64 | None  # (2, y, x) without light, shortest exposure
    flat: F64 | None  # (2, y, x) near half of saturation, ``dark`` subtracted
    good: Mask  # (y, x)


def middle_of(shape: tuple[int, int]) -> Part:
    """Rows and columns of the middle of the detector, starting at chunk borders."""
    ends = []
    for n, chunk in zip(shape, CHUNK[1:], strict=True):
        first = max(0, (n - SIDE) // 2 // chunk * chunk)
        ends.append((first, min(first + SIDE, n)))
    return ends[0], ends[1]


def read_halves(
    made: Build,
    source: Ingested,
    summary: Summary,
    top: Measure | None,
    middle: Part,
    gain: float,
    runtime: Runtime,
) -> Halves:
    """Read the bias frames and the flats near half of the saturation ``top`` (ADU above bias).

    ``gain``: of the dark signal's map, e-/ADU.
    """
    dark, flat = source.exposures.read_series, _half_full(source, summary, top)
    mask = ArrayReader(made.folder / "calibration.zarr" / "mask").read(*middle)
    # Nonlinearity depends on response: without these pixels, it would look more uniform.
    good = mask & ~np.uint8(PixelFlag.NONLINEAR) == 0
    series = [group for group in (dark, flat) if group is not None]
    if not series or good.sum() < _MIN_PIXELS or min(good.shape) < 2:
        return Halves(None, None, good)
    (y0, y1), columns = middle
    bands = [((y, min(y + CHUNK[1], y1)), columns) for y in range(y0, y1, CHUNK[1])]
    parts = run_tasks(
        partial(_averages, source, tuple(series)), bands, runtime, label="nonuniformity"
    )
    whole = np.concatenate(parts, axis=1)
    # A pixel that is missing in any frame is not used.
    good &= np.isfinite(whole).all(axis=0)
    if good.sum() < _MIN_PIXELS:
        return Halves(None, None, good)
    maps = made.folder / "calibration.zarr"
    if dark is None:
        return Halves(None, whole - ArrayReader(maps / "bias").read(*middle), good)
    if flat is None:
        return Halves(whole, None, good)
    seconds = flat.exptime * source.exposures.known - dark.exptime
    rate = ArrayReader(maps / "dark_rate").read(*middle) / gain
    return Halves(whole[:2], whole[2:] - whole[:2] - seconds * rate, good)


def _half_full(source: Ingested, summary: Summary, top: Measure | None) -> Group | None:
    """Flats whose level is nearest to half of the saturation."""
    if top is None:
        return None
    offers = [
        (abs(level - top[0] / 2), n)
        for n, level in enumerate(summary.levels)
        if summary.usable[n] and len(source.exposures.flat[n].frames) > 1
    ]
    return source.exposures.flat[min(offers)[1]] if offers else None


def _averages(source: Ingested, series: tuple[Group, ...], window: Part) -> F64:
    """Averages of the even and of the odd frames of each series, (2 series, y, x)."""
    (y0, y1), (x0, x1) = window
    made = np.zeros((2 * len(series), y1 - y0, x1 - x0))
    for n, group in enumerate(series):
        used = group.frames[: min(_FRAMES, len(group.frames)) // 2 * 2]
        for number, samples in enumerate(frames_of(source, group.array, used, window)):
            made[2 * n + number % 2] += samples
        made[2 * n : 2 * n + 2] /= len(used) / 2
    return made


def frames_of(
    source: Ingested, array: str, numbers: Sequence[int], window: Part
) -> Iterator[NDArray[Any]]:
    """Samples (y, x) of given frames, read in the blocks in which they are stored."""
    for block, held in groupby(numbers, key=lambda number: number // CHUNK[0]):
        first = block * CHUNK[0]
        samples = source.arrays[array].read((first, first + CHUNK[0]), *window)
        for number in held:
            yield samples[number - first]
