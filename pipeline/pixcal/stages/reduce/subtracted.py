"""Dark signal that the camera subtracts, from the frames without light of a run."""

import math

import numpy as np

from pixcal.estimators.detector.calibration import usual_variance
from pixcal.estimators.detector.emva import Measure
from pixcal.estimators.detector.subtracted_dark import subtracted_dark
from pixcal.model.errors import InputError
from pixcal.stages.reduce.flat_survey import middle_rows, rough_gain
from pixcal.stages.reduce.ingested import Ingested

_FRAMES = 16  # of each exposure time
_HOT = 5.0  # errors of a sample from the median beyond which a pixel is not a usual one


def subtracted_rate(source: Ingested, gain: float) -> Measure:
    """Dark signal (ADU/s) that the camera subtracts, and its error; zero if it is not seen.

    From the middle rows. Noise that is cut off at the lowest code tells nothing. ``gain``: e-/ADU;
    as a declared one may be wrong, it must agree with that of two flats on what is subtracted.
    """
    if source.black is not None:
        return source.black.subtracted, 0.0
    if source.cut_off or not source.exposures.has_rate:
        return 0.0, 0.0
    levels, noise = [], []
    for group in source.exposures.dark:
        reader = source.arrays[group.array]
        numbers = group.frames[:_FRAMES]
        frames = np.concatenate([middle_rows(reader, n, n + 1) for n in numbers]).astype(float)
        middle = np.median(frames, axis=0)
        usual = np.abs(middle - np.median(middle)) <= _HOT * max(np.std(frames[0] - middle), 1.0)
        levels += [(group.exptime, float(frame[usual].mean())) for frame in frames]
        # A level that changes from frame to frame is no noise of samples.
        changes = [b - a for a, b in zip(frames[::2], frames[1::2], strict=False)]
        pairs = [usual_variance((c - np.median(c)) ** 2 / 2, 1) for c in changes]
        if pairs:
            variance = float(np.median(pairs))
            error = variance * math.sqrt(2 / (len(pairs) * frames[0].size))
            noise.append((group.exptime, variance, error))
    if len(noise) < 2:
        return 0.0, 0.0
    times, means = np.array(levels).T
    of_series, variance, error = np.array(noise).T
    found = [
        subtracted_dark((times, means), (of_series, variance, error), one)
        for one in (gain, *_of_flats(source))
    ]
    return found[0] if found[0] and all(found) else (0.0, 0.0)


def _of_flats(source: Ingested) -> list[float]:
    """Rough gain (e-/ADU) from two flats, if any tell it."""
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
        f"the noise of frames without light grows with exposure time as with {value:.3g} ± "
        f"{error:.2g} e-/s of dark current that their level does not show: the camera subtracts it "
        "(black-level clamp, dark-current compensation). Its noise is allowed for"
    ]
