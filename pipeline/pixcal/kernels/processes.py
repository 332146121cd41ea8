"""Random and periodic processes, sampled at equal steps."""

from collections.abc import Callable

import numpy as np

from pixcal.kernels import kernel
from pixcal.model.arrays import F64

HOUR_S = 3600.0
SPAN = 4  # longest period of flicker noise, over the length of the line


def flicker(rng: np.random.Generator, count: int) -> F64:
    """One line of flicker noise (count,) of unit variance per octave, minus its mean."""
    period = _period(count)
    variance = _variance(period)
    drawn = rng.standard_normal((2, len(variance)))
    modes = period / 2 * np.sqrt(variance) * (drawn[0] - 1j * drawn[1])
    line = np.fft.irfft(modes, period)[:count]
    return np.asarray(line - line.mean())


def flicker_power(count: int) -> F64:
    """Mean square of the orthonormal Fourier modes (count // 2 + 1) of `flicker`; exact."""
    period = _period(count)
    covariance = np.fft.irfft(period / 2 * _variance(period), period)[:count]
    # Pairs of samples at each distance; both directions contribute to the same mode.
    pairs = covariance * (1 - np.arange(count) / count)
    pairs[1:] += pairs[:0:-1]
    power = np.fft.rfft(pairs).real
    power[0] = 0.0
    return np.asarray(power)


def _period(count: int) -> int:
    return 1 << (SPAN * count - 1).bit_length()


def _variance(period: int) -> F64:
    """Variance of the cosine and of the sine of each mode of a periodic line."""
    mode = np.arange(period // 2 + 1)
    variance = np.zeros(len(mode))
    variance[1:-1] = 1 / (np.log(2) * mode[1:-1])
    return variance


# longest time of `brownian`, s (half a year), and the number of its halvings (to 16 ms)
HORIZON, LEVELS = 2.0**24, 30


def autoregression(normals: F64, keep: float) -> F64:
    """First-order autoregression of unit variance: a random walk with a restoring force to zero.

    From independent standard normals (t,); ``keep`` is the correlation of neighbours, 0 to below 1.
    """
    if not keep or not len(normals):
        return normals
    walk = np.empty(len(normals))
    _walk(np.ascontiguousarray(normals, float), keep, np.sqrt(1 - keep**2), walk)
    return walk


# Not scipy.signal's filter, which is slow to import (most of a second) and on such short lines.
@kernel()
def _walk(normals: F64, keep: float, step: float, walk: F64) -> None:
    at = (1 - step) * normals[0]
    for n in range(len(normals)):
        walk[n] = step * normals[n] + at
        at = keep * walk[n]


def mean_sine(time_s: F64, hz: float, phase: float, exptime_s: float = 0.0) -> F64:
    """Mean of a sine over exposures starting at times (t,), s; ``phase`` (rad) at time 0."""
    middle = 2 * np.pi * hz * (time_s + exptime_s / 2) + phase
    return np.asarray(np.sinc(hz * exptime_s) * np.sin(middle))


def brownian(time: float, normal: Callable[[int, int], float]) -> float:
    """Random walk of unit variance per unit of time, at one time from 0 to `HORIZON`.

    Lévy's construction from ever finer hat functions, so that any time can be computed separately;
    linear between multiples of ``HORIZON / 2**LEVELS``. ``normal`` gives the standard normal of a
    level and a place in it, the same at every call.
    """
    at = min(max(time / HORIZON, 0.0), 1.0)
    value = at * normal(0, 0)
    for level in range(LEVELS):
        place, inside = divmod(at * 2**level, 1.0)
        height = 0.5 - abs(inside - 0.5)
        if height:
            value += 2 ** (-level / 2) * height * normal(level + 1, int(place))
    return float(np.sqrt(HORIZON) * value)


RAMP = 0.8  # least mean of exp(i step) of a ramp; for random phases it is near zero


def ramp_step(phase: F64) -> float:
    """Step (rad) of phases (t,) in equal steps; zero if they are not a ramp."""
    mean = np.exp(1j * np.diff(phase)).mean() if len(phase) > 1 else 0.0
    return float(np.angle(mean)) if abs(mean) > RAMP else 0.0
