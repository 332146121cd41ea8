"""Mean dark signal of a detector, and the part that clipping of outliers removes.

From the levels of single frames without light, and the charge left there by earlier light.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.detector import emva
from pixcal.estimators.detector.persistence import Persistence, released_late
from pixcal.estimators.diagnosis.evidence import Stack
from pixcal.model.arrays import F64, Mask
from pixcal.report.text import number
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.halves import frames_of
from pixcal.stages.reduce.ingested import Ingested, starts_of
from pixcal.stages.reduce.measuring import Measuring
from pixcal.stages.tiles import Part
from pixcal.storage.artefact import Build
from pixcal.storage.cube import CHUNK
from pixcal.storage.cube_reader import ArrayReader

_NO_ERROR = 1e-9  # ADU/s: below it all samples have one code
# relative error of the change of dark current by correcting noise that is cut off: it is not known
# which distribution the noise had
_OF_CORRECTION = 0.5
# least signal in outliers that is reported: errors, and share of the whole
_SURE, _NOTABLE = 5.0, 0.05
_GONE = 5  # decays after which hardly any charge is left
_ROUNDS = 5  # of levels of frames and pixels in turn
_NO_SAMPLES = np.zeros((0, 0, 0), np.float32)


class DarkCurrent(NamedTuple):
    """Mean dark signal of good pixels."""

    measure: tuple[float, float | None]
    unit: str
    note: str
    warnings: tuple[str, ...]


def dark_current(
    made: Build,
    source: Ingested,
    job: Measuring,
    conversion: tuple[float, float | None],
    scale: float,
    middle: Part,
) -> DarkCurrent | None:
    """The dark current; its error is from frames, bias drift included. None if it is unknown.

    Excludes charge left by light before the darks, if the frames separate it from a drift of the
    bias; a warning names either. ``conversion``: gain with its error (e-/ADU); ``scale``: over the
    gain used for the maps.
    """
    if not source.exposures.has_rate:
        return None
    folder = made.folder / "calibration.zarr"
    good = ArrayReader(folder / "mask").read(*middle) == 0
    if not good.any():
        return None
    rates = scale * ArrayReader(folder / "dark_rate").read(*middle)
    gain, of_gain = conversion[0], (conversion[1] or 0.0) / conversion[0]
    rows = middle_rows(middle)
    levels = DarkLevels.of(source, middle, good)
    slope = emva.dark_slope(levels.times, levels.means)
    error = gain * slope[1] if slope is not None and slope[1] > _NO_ERROR else None
    arrays = {group.array for group in source.exposures.dark}
    timed = any(any(source.tables[array]["exptime_s"]) for array in arrays)
    unit = "e-/s" if timed else "e-/exposure"
    notes = []
    if error is not None and slope is not None:
        left_out = gain * slope[0] - float(rates[rows][good[rows]].mean(dtype=float))
        if source.cut_off:
            error = math.hypot(error, _OF_CORRECTION * left_out)
        elif not job.subtracted[0] and left_out > max(_SURE * error, _NOTABLE * gain * slope[0]):
            notes.append(
                f"excludes outliers, which hold {left_out:.2g} {unit} more: particles, or the "
                "tail of an electron multiplier"
            )
    note, rate = _temperature(source.tables), float(rates[good].mean(dtype=float))
    subtracted, off = job.subtracted
    if subtracted:
        # A variance in electrons goes with the square of the gain; that was found by a rough one.
        better = gain / job.gain
        rate = better * (rate + gain * subtracted)
        error = math.hypot(better * gain * off, rate * of_gain)
        note = f"by the noise of dark frames: the camera subtracts it from their level; {note}"
    given = not (subtracted or source.cut_off)  # whether the rate is that of the level
    late = late_rate(source, levels, gain, gain * job.read_noise) if given else None
    if late is not None and late.sure:
        rate, error = rate - late.rate, late.error
        notes.append(f"excludes {late.rate:.2g} {unit} of charge left by light before the darks")
    warnings = () if late is None else (late.warning(unit),)
    return DarkCurrent((rate, error), unit, "; ".join([note, *notes]), warnings)


def _temperature(tables: Mapping[str, Mapping[str, Any]]) -> str:
    """Temperature of the frames without light, if in their headers."""
    known = [
        t
        for kind in ("dark", "bias")
        for t in tables.get(kind, {}).get("temperature_c", ())
        if t is not None
    ]
    if not known:
        return "temperature not in the headers"
    low, high = min(known), max(known)
    return f"at {low:.1f} °C" if high - low < 0.05 else f"at {low:.1f} to {high:.1f} °C"


# Levels of frames, and charge from before them


@dataclass(frozen=True)
class DarkLevels:
    """Series of frames without light, and flats, in the middle rows of a window."""

    groups: tuple[Group, ...]
    levels: tuple[F64, ...]  # mean (ADU) of each frame of each group
    pixels: int  # that a mean is of

    @classmethod
    def of(cls, source: Ingested, middle: Part, good: Mask) -> "DarkLevels":
        """Read the frames; ``good``: (y, x) pixels of the window that count."""
        # Samples that are not finite do not count, nor do frames and groups without any others.
        (y0, _), columns = middle
        rows = middle_rows(middle)
        window, pixels = ((y0 + rows.start, y0 + rows.stop), columns), good[rows]
        flats = source.exposures.flat if _follows_light(source) else []
        groups, levels = [], []
        for group in (*source.exposures.dark, *flats) if pixels.any() else ():
            means = _frame_levels(partial(_samples, source, group, window, pixels))
            kept = tuple(n for n, one in zip(group.frames, means, strict=True) if np.isfinite(one))
            if kept:
                groups.append(replace(group, frames=kept))
                levels.append(means[np.isfinite(means)])
        return cls(tuple(groups), tuple(levels), int(pixels.sum()))

    @property
    def times(self) -> F64:
        """Exposure time of each frame without light, s."""
        dark = [[g.exptime] * len(g.frames) for g in self.groups if g.array != "flat"]
        return np.concatenate([*dark, []])

    @property
    def means(self) -> F64:
        """Mean of each frame without light, ADU."""
        pairs = zip(self.groups, self.levels, strict=True)
        return np.concatenate([*(level for g, level in pairs if g.array != "flat"), []])


def _frame_levels(read: Callable[[], Iterable[NDArray[Any]]]) -> F64:
    """Mean (t,) of the pixels of each frame, as if none were missing; NaN without any sample."""
    with np.errstate(invalid="ignore"):
        levels = np.array([samples.mean(dtype=float) for samples in read()])
    if np.isfinite(levels).all():
        return levels
    # Pixels differ by their own levels: which ones are missing must not shift a mean.
    pixel = count = np.zeros(1)
    for _ in range(_ROUNDS):
        total, count = np.zeros(1), np.zeros(1)
        for n, samples in enumerate(read()):
            there = np.isfinite(samples)
            levels[n] = (samples - pixel)[there].mean(dtype=float) if there.any() else np.nan
            if there.any():
                total = total + np.where(there, samples - levels[n], 0)
                count = count + there
        pixel = total / np.maximum(count, 1)
    return levels + (pixel[count > 0].mean() if count.any() else 0)


def _samples(source: Ingested, group: Group, window: Part, pixels: Mask) -> Iterator[NDArray[Any]]:
    """Samples (pixel,) of each frame of a group."""
    return (frame[pixels] for frame in frames_of(source, group.array, group.frames, window))


def middle_rows(middle: Part) -> slice:
    """Rows of the central chunk of a window, counted from its first row."""
    height = middle[0][1] - middle[0][0]
    first = height // CHUNK[1] // 2 * CHUNK[1]
    return slice(first, min(first + CHUNK[1], height))


@dataclass(frozen=True)
class LateRate:
    """Charge left in dark frames by earlier light, as if it were dark signal."""

    rate: float  # e-/s, or e-/exposure
    error: float  # of the dark signal without it
    lag: Persistence
    sure: bool  # whether it is distinguished from a drift of the bias

    def warning(self, unit: str) -> str:
        """Its consequence for the map of the dark signal; ``unit``: of the rates."""
        of_time = "s" if self.lag.in_seconds else "frames"
        decays = [self.lag.decay, self.lag.slow] if self.lag.slow_part else [self.lag.decay]
        decay = " and ".join(f"{number(one, 2)} {of_time}" for one in decays)
        gone = f"{number(_GONE * decays[-1], 2)} {of_time}"
        if not self.sure:
            return (
                "the level of the darks falls: charge from light before them, or a drift of the "
                f"bias; record darks before the light, or {gone} or more after it"
            )
        return (
            f"the darks hold charge left by earlier light, which decays over {decay}: the "
            f"map of the dark signal holds {number(self.rate, 2)} {unit} of it on average; record "
            f"darks {gone} or more after light"
        )


def late_rate(
    source: Ingested, levels: DarkLevels, gain: float, read_noise: float
) -> LateRate | None:
    """Charge left in the darks by light, from the fit of the diagnosis; None if insignificant.

    ``gain``: e-/ADU; ``read_noise``: e-. Not if the light includes fringes.
    """
    if not any(g.array == "flat" for g in levels.groups) or len(levels.times) < 3:
        return None
    unlit = levels.means[levels.times == levels.times.min()].mean()
    series = []
    for group, level in zip(levels.groups, levels.levels, strict=True):
        frames, start = np.array(group.frames), starts_of(source.tables)[group.array]
        time = np.array(source.tables[group.array]["time_s"], float)[frames]
        stack = Stack(group.array, group.exptime, frames, time, _NO_SAMPLES, start)
        series.append((stack, gain * (level - unlit)))
    found = released_late(series, read_noise**2 / levels.pixels)
    if found is None:
        return None
    pairs = zip(levels.groups, found.late, strict=True)
    dark = np.concatenate([charge for g, charge in pairs if g.array != "flat"])
    slope = emva.dark_slope(levels.times, gain * levels.means - dark)
    of_late = emva.dark_slope(levels.times, dark)
    if slope is None or of_late is None:
        return None
    lag = found.lag
    error = float(np.hypot(slope[1], of_late[0] * lag.share_error / lag.share))
    return LateRate(of_late[0], error, lag, found.sure)


def _follows_light(source: Ingested) -> bool:
    """Whether darks follow flats, which are all the light there is."""
    starts = starts_of(source.tables)
    if not {"dark", "flat"} <= set(starts) or source.exposures.fringes:
        return False
    last = starts["dark"] + float(np.max(np.array(source.tables["dark"]["time_s"], float)))
    return bool(starts["flat"] < last)
