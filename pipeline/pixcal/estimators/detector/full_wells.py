"""Flats with full wells, detected from their noise: a full well has no photon noise.

A well may be full far below the highest code, and read noise then spreads the samples: no code
piles up. Such samples would flatten the response and outweigh all others by their small variance.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from pixcal.estimators.detector.calibration import Rung
from pixcal.kernels.robust import lit, median_and_sigma

# Variance over the signal, in units of the least at lower levels, below which pixels are full. A
# response that bends by a fifth lessens it to 0.64.
COLLAPSED = 0.25
NEARLY = 0.02  # relative distance from a pixel's own full well within which its signal is not used


def unsaturated(rungs: Sequence[Rung]) -> list[Rung]:
    """Flats without the signal of full pixels, which becomes NaN.

    Parameters
    ----------
    rungs : sequence of Rung
        Of the same pixels, in any order.
    """
    seen = [lit(rung.signal) for rung in rungs]
    levels, noise = (
        np.array([median_and_sigma(values[s])[0] for values, s in zip(maps, seen, strict=True)])
        for maps in ([r.signal for r in rungs], [r.variance * r.frames for r in rungs])
    )
    full, least = np.zeros(len(rungs), np.bool_), np.inf
    for n in np.argsort(levels):
        if not levels[n] > 0:
            continue
        slope = noise[n] / levels[n]
        full[n] = np.isfinite(least) and slope < COLLAPSED * least
        least = least if full[n] else min(least, slope)
    if not full.any():
        return list(rungs)
    well = np.mean([rung.signal for rung, ended in zip(rungs, full, strict=True) if ended], axis=0)
    limit = np.where(np.isfinite(well), (1 - NEARLY) * well, np.inf)
    return [
        replace(rung, signal=np.where(ended | (rung.signal > limit), np.nan, rung.signal))
        for rung, ended in zip(rungs, full, strict=True)
    ]
