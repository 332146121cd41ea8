"""The response of a detector by the levels of flats of several exposure times and one lamp."""

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.evidence import Evidence

F64 = NDArray[np.float64]

MIN_RUNGS = 3  # fewest levels of flats that tell a curve from a line through nothing

_TURNS = 30


def ladder_response(evidence: Evidence, level_e: float) -> tuple[F64, F64] | None:
    """Relative deviations of the response from a straight line, by a ladder of flats.

    Parameters
    ----------
    level_e : float
        Where the deviations are given, e-.

    Returns
    -------
    sizes, covariance : (2,), (2, 2) float64
        From the first and the second power of the level; None with too few levels, or several
        lamps.
    """
    if not evidence.steady_lamp or not evidence.dithered:
        return None
    times, means, counts, scatter = [], [], [], []
    for stack in evidence.ladder:
        light = (stack.adu - evidence.bias) * evidence.gain
        light -= evidence.dark_rate * stack.exptime_s
        levels = light[:, evidence.good].mean(axis=1)
        times.append(stack.exptime_s)
        means.append(levels.mean())
        counts.append(len(levels))
        scatter.append(((levels / levels.mean() - 1) ** 2).sum())
    freedom = sum(counts) - len(counts)
    if len(times) < MIN_RUNGS or min(means) <= 0 or freedom < 1:
        return None
    time, mean, count = np.array(times), np.array(means), np.array(counts)
    # The scatter of few frames is known from all levels together, never below that of photons.
    photons = (mean + evidence.read_noise**2) / mean**2 / np.count_nonzero(evidence.good)
    information = count / np.maximum(sum(scatter) / freedom, photons)
    # Where the flat varies, bright pixels bend more than the mean does.
    flat = evidence.flat[evidence.good] / evidence.flat[evidence.good].mean()
    square, cube = (flat**2).mean() / level_e, (flat**3).mean() / level_e**2
    rate, sizes = float((mean / time).mean()), np.zeros(2)
    for _ in range(_TURNS):
        linear = rate * time
        terms = np.stack([linear * square, linear**2 * cube])
        bent = 1 + sizes @ terms
        design = np.stack([np.ones_like(time), *(terms / bent)])
        covariance = np.linalg.inv((design * information) @ design.T)
        step = covariance @ (design @ (information * (mean / (linear * bent) - 1)))
        rate, sizes = rate * (1 + step[0]), sizes + step[1:]
    return sizes, covariance[1:, 1:]
