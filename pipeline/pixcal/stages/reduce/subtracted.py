"""Dark signal that the camera subtracts, from the noise that it leaves in frames without light.

Cameras that clamp black to their shielded pixels, or compensate for dark current, give frames
without light of one level at all exposure times. The shot noise of the dark signal stays: its
variance grows with exposure time (EMVA 1288, release 4.0, section 7: dark current by the variance
method, for cameras that compensate for it).
"""

import math

import numpy as np

from pixcal.estimators.detector.calibration import usual_variance
from pixcal.estimators.detector.emva import Measure, dark_slope
from pixcal.model.arrays import F64
from pixcal.model.errors import InputError
from pixcal.stages.reduce.dark_levels import frame_level
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.flat_survey import middle_rows, rough_gain
from pixcal.stages.reduce.ingested import Ingested

_FRAMES = 16  # of each exposure time
_CERTAIN = 6.0  # errors beyond which variance grows by more than the level explains
_GAIN_ERROR = 0.1  # of a gain that is declared, or roughly measured
_LEAST = 0.1  # smallest share of the variance of the longest darks that counts
_MOSTLY = 0.5  # least share of the dark signal that is subtracted: else the gain may be wrong


def subtracted_rate(source: Ingested, gain: float) -> Measure:
    """Dark signal (ADU/s) that the camera subtracts, and its error; zero if not detected.

    From the middle rows. Noise that is cut off at the lowest code cannot be used. ``gain``: e-/ADU;
    a declared one may be wrong, so with the gain of two flats the result must be the same.
    """
    if source.black is not None:
        return source.black.subtracted, 0.0
    if source.cut_off or not source.exposures.has_rate:
        return 0.0, 0.0
    times, levels, noise = [], [], []
    for group in source.exposures.dark:
        means, variances, samples = _of_pairs(source, group)
        times += [group.exptime] * len(means)
        levels += means
        if variances:
            variance = float(np.median(variances))
            noise.append((group.exptime, variance, variance * math.sqrt(2 / samples)))
    if len(noise) < 2:
        return 0.0, 0.0
    of_series, variance, error = np.array(noise).T
    rates = [
        subtracted_dark((np.array(times), np.array(levels)), (of_series, variance, error), one)
        for one in (gain, *_of_flats(source))
    ]
    return rates[0] if rates[0] and all(rates) else (0.0, 0.0)


def subtracted_dark(
    levels: tuple[F64, F64], noise: tuple[F64, F64, F64], gain: float
) -> Measure | None:
    """Dark signal (ADU/s) missing from frames without light, and its error; None if none is.

    levels : exposure time (s) and mean (ADU) of each frame without light
    noise : exposure time (s) of each series, variance of a usual sample (ADU²) and its error
    gain : rough, e-/ADU
    """
    times, variance, error = noise
    slope = dark_slope(*levels)
    if slope is None or len(times) < 2 or not np.ptp(times) > 0 or not error.min() > 0:
        return None
    weight = error**-2
    lever = times - weight @ times / weight.sum()
    square = float(weight @ lever**2)
    grows = gain * float(weight @ (lever * variance)) / square
    lost = grows - max(slope[0], 0.0)
    off = math.hypot(gain / math.sqrt(square), slope[1], _GAIN_ERROR * slope[0])
    seen = lost / gain * float(times.max()) > _LEAST * float(variance[np.argmax(times)])
    return (lost, off) if lost > max(_CERTAIN * off, _MOSTLY * grows) and seen else None


def _of_pairs(source: Ingested, group: Group) -> tuple[list[float], list[float], int]:
    """Mean of each frame without hot pixels, variance of each pair of frames, number of samples."""
    reader, numbers = source.arrays[group.array], group.frames[:_FRAMES]
    means: list[float] = []
    variances: list[float] = []
    samples = 0
    for first in range(0, len(numbers), 2):
        pair = [middle_rows(reader, n, n + 1).ravel() for n in numbers[first : first + 2]]
        frames: F64 = np.stack(pair).astype(float)
        frames = frames[:, np.isfinite(frames).all(axis=0)]
        if not frames.size:
            continue
        means += [frame_level(frame, source) for frame in frames]
        if len(frames) == 2:
            # A level that changes from frame to frame is no noise of samples.
            change = frames[1] - frames[0]
            variances.append(usual_variance((change - np.median(change)) ** 2 / 2, 1))
            samples += change.size
    return means, variances, samples


def _of_flats(source: Ingested) -> list[float]:
    """Rough gain (e-/ADU) from two flats, if they show shot noise."""
    if source.survey is None:
        return []
    groups = [group.frames for group in source.exposures.flat]
    try:
        return [rough_gain(source.arrays, source.survey.levels, groups)]
    except InputError:
        return []


def subtracted_warnings(subtracted: Measure, gain: float) -> list[str]:
    """A sentence on dark signal (ADU/s) that the camera subtracts. ``gain``: e-/ADU."""
    value, error = (gain * one for one in subtracted)
    if not value:
        return []
    return [
        f"the noise of frames without light grows with exposure time like that of {value:.3g} ± "
        f"{error:.2g} e-/s of dark current, but their level does not: the camera subtracts it "
        "(black-level clamp, dark-current compensation). Its noise is allowed for"
    ]
