"""Dark signal that a camera subtracts, as its noise still shows it.

Cameras that clamp black to their shielded pixels, or compensate for dark current, give frames
without light of one level at all exposure times. The shot noise of the dark signal stays: its
variance grows with exposure time (EMVA 1288, release 4.0, section 7: dark current by the variance
method, for cameras that compensate for it).
"""

import math

import numpy as np

from pixcal.estimators.detector.emva import Measure, dark_slope
from pixcal.model.arrays import F64

_CERTAIN = 6.0  # errors beyond which variance grows by more than the level explains
_GAIN_ERROR = 0.1  # of a gain that is declared, or roughly measured
_LEAST = 0.1  # smallest share of the variance of the longest darks that counts
_MOSTLY = 0.5  # least share of the dark signal that is subtracted: else the gain may be wrong


def subtracted_dark(
    levels: tuple[F64, F64], noise: tuple[F64, F64, F64], gain: float
) -> Measure | None:
    """Dark signal (ADU/s) that frames without light lack, and its error; None if they lack none.

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
