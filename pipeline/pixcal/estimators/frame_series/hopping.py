"""Hops between two levels, as a hidden Markov model: their size and rate.

Short stays on a level are hidden in the noise of the frames, and counting significant hops misses
them. The likelihood of a series is therefore a sum over all sequences of levels (Rabiner 1989,
Proc. IEEE 77, 257). It is maximised by size, rate, and base (a ramp) and noise of each series; its
curvature gives their errors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from pixcal.kernels import kernel
from pixcal.kernels.medians import robust_sigma
from pixcal.model.arrays import F64

BASES = 33  # start values tried for the base of each series
# lower limits: noise over the size; number of hops in the whole time
MIN_NOISE, FEWEST_HOPS = 1e-3, 0.01
STEP = 1e-3  # of the numbers, in their errors, for slopes of the likelihood
FLAT = 1e-9  # least curvature


@dataclass(frozen=True)
class Hopping:
    """Two levels and the hops between them."""

    size: float  # size, error: of a hop, in the series' unit
    error: float
    rate: float  # rate, rate_error: of hops, 1/s
    rate_error: float
    # standard deviation of each series about its levels, if fitted; and the ramp common to their
    # bases, 1/s
    noise: tuple[float, ...] = ()
    ramp: float = 0.0
    ramp_error: float = np.inf


def find_hopping(
    values: Sequence[F64], times_s: Sequence[F64], slopes: Sequence[float], size: float, rate: float
) -> Hopping:
    """Hops of a common ``size`` and ``rate`` (1/s) in several series ``values`` (t,).

    ``slopes``: of the bases, 1/s. All three are start values.
    """
    times = [time - time.mean() for time in times_s]
    seconds = sum(float(np.ptp(time)) for time in times)
    # Size and logarithm of the rate; of each series base, ramp and logarithm of the noise.
    start, usual = [size, np.log(rate)], [np.inf, (rate * seconds + 1) ** -0.5]
    least = [-np.inf, np.log(FEWEST_HOPS / seconds)]
    for v, time, slope in zip(values, times, slopes, strict=True):
        noise = max(scatter_of(v), MIN_NOISE * abs(size))
        base = _likeliest_base(v, time, slope, noise, size, rate)
        error = noise * len(v) ** -0.5
        start += [base, slope, np.log(noise)]
        usual += [error, error / max(float(time.std()), 1e-300), (2 * len(v)) ** -0.5]
        least += [-np.inf, -np.inf, np.log(MIN_NOISE * abs(size))]
    usual[0] = min(usual[2::3])
    begin, unit = np.array(start), np.array(usual)

    def loss(steps: F64) -> float:
        (size, log_rate), of_series = np.split(begin + steps * unit, [2])
        every = zip(values, times, of_series.reshape(-1, 3), strict=True)
        return -sum(_likelihood(v, t, size, np.exp(log_rate), *numbers) for v, t, numbers in every)

    limits = [(low, None) for low in (np.array(least) - begin) / unit]
    options = {"eps": STEP, "maxiter": 1000}
    best = minimize(loss, np.zeros(len(begin)), method="L-BFGS-B", bounds=limits, options=options).x
    fitted, errors = begin + best * unit, unit * _errors(loss, best)
    # The posterior of a rate, without prior, has one hop more: few hops do not constrain it well.
    rate, relative = float(np.exp(fitted[1])), float(errors[1])
    weight = errors[3::3] ** -2
    return Hopping(
        float(fitted[0]),
        float(errors[0]),
        rate,
        rate * float(np.hypot(relative, relative**2)),
        tuple(np.exp(fitted[4::3]).tolist()),
        float(fitted[3::3] @ weight / weight.sum()),
        float(weight.sum() ** -0.5),
    )


def scatter_of(values: F64) -> float:
    """Standard deviation of a series from differences of frames, assuming noise alone."""
    return robust_sigma(np.diff(values)) / float(np.sqrt(2)) or 1e-300


def _likelihood(
    values: F64, time_s: F64, size: float, rate: float, base: float, ramp: float, log_noise: float
) -> float:
    """Log-likelihood of a series, for a logarithm of its noise."""
    off = (values - base - ramp * time_s) * np.exp(-log_noise)
    jump = size * np.exp(-log_noise)
    # Probability that the number of hops from a frame to the next is odd.
    change = -np.expm1(-2 * rate * np.diff(time_s)) / 2
    rest = float(off @ off) / 2 + len(off) * log_noise
    return float(log_growth(jump * (off - jump / 2), change)) - rest


def _likeliest_base(
    values: F64, time_s: F64, slope: float, noise: float, size: float, rate: float
) -> float:
    """Of a grid."""
    flat = values - slope * time_s
    bases = np.linspace(flat.min() - size / 2, flat.max() - size / 2, BASES)
    log = np.log(noise)
    return float(
        max(bases, key=lambda base: _likelihood(values, time_s, size, rate, base, slope, log))
    )


def _errors(loss: Callable[[F64], float], best: F64) -> F64:
    """Errors (n,) of numbers from the curvature of the loss, over steps of one about the best."""
    steps = np.eye(len(best)) / 2
    curvature = np.array(
        [
            [
                sum(s * t * loss(best + s * one + t * other) for s in (1, -1) for t in (1, -1))
                for other in steps
            ]
            for one in steps
        ]
    )
    size, axes = np.linalg.eigh(curvature)
    return np.asarray(np.sqrt(axes**2 @ (1 / np.maximum(size, FLAT))))


@kernel()
def log_growth(odds: F64, change: F64) -> float:
    """Gain in log-likelihood by two states, over all sequences of them.

    ``odds``: (t,) log-likelihood of the second state less the first. ``change``: (t - 1,)
    probability of a change to the next frame.
    """
    second, gain = 0.5, 0.0
    for t in range(len(odds)):
        if t:
            second = second * (1.0 - change[t - 1]) + (1.0 - second) * change[t - 1]
        high = max(odds[t], 0.0)
        one, other = (1.0 - second) * np.exp(-high), second * np.exp(odds[t] - high)
        second = other / (one + other)
        gain += np.log(one + other) + high
    return gain
