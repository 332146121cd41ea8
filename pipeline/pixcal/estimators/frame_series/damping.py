"""Time constant of a walk that is drawn back, by the likelihood of variance components."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.frame_series.variance_components import Components

FIRST, TRIALS = 0.3, 8  # shortest time constant that is tried, in frames, and how many at first
FARTHEST = 3.0  # largest error of the logarithm of a time constant: beyond, it is not known


@dataclass(frozen=True)
class Damping:
    """Time constant of a damped walk."""

    time: float  # in frames
    log_time_error: float  # of its logarithm
    components: Components
    rms: float  # rms, rms_error: of the damped walk; the error with that of the time constant
    rms_error: float
    growth: float  # of the log-likelihood over `white`, where the walk is white
    white: Components


def best_damping(
    fit: Callable[[float, Components | None], Components], part: int, longest: float
) -> Damping:
    """Correlation of a damped walk by the likelihood of its time constant.

    Parameters
    ----------
    fit : callable
        Components for a correlation of neighbours, and where to begin.
    part : int
        The damped one.
    longest : float
        Time constant to try at most, in frames.
    """
    white = fit(0.0, None)
    times = np.geomspace(FIRST, max(longest, 1.0), TRIALS)
    fits = [white]
    for time in times:
        fits.append(fit(float(np.exp(-1 / time)), fits[-1]))
    best = 1 + int(np.argmax([found.likelihood for found in fits[1:]]))
    log_time, found = float(np.log(times[best - 1])), fits[best]
    width = float(np.log(times[1] / times[0]))
    for _ in range(3):
        # Parabola through the three, ever closer; its bend is the information of log time.
        sides = [fit(float(np.exp(-np.exp(-log_time - w))), found) for w in (-width, width)]
        below, above = (side.likelihood - found.likelihood for side in sides)
        bend = -(below + above)
        slope = float(sides[1].size[part] - sides[0].size[part]) / (2 * width)
        error = width / np.sqrt(bend) if bend > 0 else np.inf
        shift = float(np.clip((above - below) / (2 * max(bend, 1e-9)), -1, 1)) * width
        moved = fit(float(np.exp(-np.exp(-log_time - shift))), found)
        if moved.likelihood > found.likelihood:
            log_time, found = log_time + shift, moved
        width /= 2
    error = min(error, FARTHEST)
    rms, own = found.root(part)
    # What the variance owes to the time constant that it was found with.
    owed = slope * error / (2 * max(rms, own, 1e-300))
    return Damping(
        time=float(np.exp(log_time)),
        log_time_error=float(error),
        components=found,
        rms=rms,
        rms_error=float(np.hypot(own, owed)),
        growth=found.likelihood - white.likelihood,
        white=white,
    )
