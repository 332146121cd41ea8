"""Random and periodic processes, sampled at equal steps; more samples leave the first ones."""

from collections.abc import Callable

import numpy as np

from pixcal.model.arrays import F64

# longest time of `brownian`, s (half a year), and its halvings (to 16 ms)
HORIZON, LEVELS = 2.0**24, 30


def damped_walk(normals: F64, keep: float) -> F64:
    """First-order autoregression of unit variance: a random walk that is drawn back to zero.

    From independent standard normals (t,); ``keep`` is the correlation of neighbours, 0 to below 1.
    """
    if not keep or not len(normals):
        return normals
    # Here: scipy.signal takes most of a second to import, and few runs need it.
    from scipy.signal import lfilter

    step = np.sqrt(1 - keep**2)
    walk, _ = lfilter([step], [1.0, -keep], normals, zi=[(1 - step) * normals[0]])
    return np.asarray(walk)


def swing(time_s: F64, hz: float, phase: float, exptime_s: float = 0.0) -> F64:
    """Sine of unit amplitude, as its mean over an exposure that starts at each time (t,), s.

    ``phase`` is that at time zero, rad.
    """
    middle = 2 * np.pi * hz * (time_s + exptime_s / 2) + phase
    return np.asarray(np.sinc(hz * exptime_s) * np.sin(middle))


def brownian(time: float, normal: Callable[[int, int], float]) -> float:
    """Random walk of unit variance a unit of time, at one time from 0 to `HORIZON`.

    Lévy's construction by ever finer hats: any time can be asked for by itself. Straight between
    multiples of ``HORIZON / 2**LEVELS``.

    Parameters
    ----------
    normal : callable
        Standard normal of a level and a place in it, the same whenever it is asked for.
    """
    at = min(max(time / HORIZON, 0.0), 1.0)
    value = at * normal(0, 0)
    for level in range(LEVELS):
        place, inside = divmod(at * 2**level, 1.0)
        height = 0.5 - abs(inside - 0.5)
        if height:
            value += 2 ** (-level / 2) * height * normal(level + 1, int(place))
    return float(np.sqrt(HORIZON) * value)


RAMP = 0.8  # mean of exp(i step) from which phases are a ramp; of random phases it is near zero


def ramp_step(phase: F64) -> float:
    """Step (rad) of phases (t,) that rise by equal steps; zero where they do not."""
    mean = np.exp(1j * np.diff(phase)).mean() if len(phase) > 1 else 0.0
    return float(np.angle(mean)) if abs(mean) > RAMP else 0.0
