"""Hops between two levels, as a hidden Markov model: their size and rate.

Short stays on a level are hidden in the noise of the frames, and counting significant hops misses
them. Here every frame has a probability of either level, given all frames; size, rate, and the base
of each series (a ramp) with its noise have maximum likelihood, by the algorithm of Baum, Petrie,
Soules & Weiss 1970 (Ann. Math. Statist. 41, 164).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.kernels import kernel
from pixcal.kernels.robust import robust_sigma
from pixcal.model.arrays import F64

ROUNDS = 200
SETTLED = 1e-4  # growth of the log-likelihood at which they end
BASES = 33  # start values tried for the base of each series
# lower limits: noise over the size; number of hops in the whole time
MIN_NOISE, FEWEST_HOPS = 1e-3, 0.01
# step of the rate's logarithm, and of the size over the noise, for the likelihood's curvature
STEP = 0.2


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


@dataclass(frozen=True)
class _Series:
    values: F64
    time_s: F64
    base: F64
    noise: float
    second: F64
    changes: float = 0.0
    likelihood: float = 0.0

    def weighed(self, size: float, rate: float) -> "_Series":
        """With the probabilities of its states, and the likelihood."""
        off = self.values - self.base
        odds = size * (off - size / 2) / self.noise**2
        second, changes, growth = likely_states(odds, _change(rate, self.time_s))
        first = -len(off) * np.log(self.noise) - float(off @ off) / (2 * self.noise**2)
        return replace(self, second=second, changes=changes, likelihood=first + growth)

    def ramp(self, size: float) -> tuple[float, float]:
        """Slope of the base and its error, which includes uncertain hops."""
        time = self.time_s - self.time_s.mean()
        unsure = size**2 * float(np.sum(time**2 * self.second * (1 - self.second)))
        square = float(time @ time)
        slope = float(time @ self.base) / square
        return slope, float(np.sqrt(self.noise**2 / square + unsure / square**2))


def find_hopping(
    values: Sequence[F64], times_s: Sequence[F64], slopes: Sequence[float], size: float, rate: float
) -> Hopping:
    """Hops of a common ``size`` and ``rate`` (1/s) in several series ``values`` (t,).

    ``slopes``: of the bases, 1/s. All three are start values.
    """
    series = zip(values, times_s, slopes, strict=True)
    every = [_begun(*one, size, rate) for one in series]
    seconds = sum(float(np.ptp(s.time_s)) for s in every)
    last = -np.inf
    for _ in range(ROUNDS):
        every = [s.weighed(size, rate) for s in every]
        likelihood = sum(s.likelihood for s in every)
        if likelihood - last < SETTLED:
            break
        last = likelihood
        size = _size(every) or size
        every = [_settled(s, size) for s in every]
        expected = sum(float(_change(rate, s.time_s).sum()) for s in every)
        rate = max(rate * sum(s.changes for s in every) / expected, FEWEST_HOPS / seconds)

    def of_size(step: float) -> float:
        # The bases are refitted.
        moved = [
            replace(s, base=s.base - step * size * _ramp_of(s.second, s.time_s)) for s in every
        ]
        return sum(s.weighed(size * (1 + step), rate).likelihood for s in moved)

    def of_rate(step: float) -> float:
        return sum(s.weighed(size, rate * np.exp(step)).likelihood for s in every)

    step = STEP * min(s.noise for s in every) / size
    # The posterior of a rate, without prior, has one hop more: few hops do not constrain it well.
    relative = _error(of_rate, STEP)
    rate_error = rate * float(np.hypot(relative, relative**2))
    ramps, errors = np.array([s.ramp(size) for s in every]).T
    weight = errors**-2
    return Hopping(
        size,
        abs(size) * _error(of_size, step),
        rate,
        rate_error,
        tuple(s.noise for s in every),
        float(ramps @ weight / weight.sum()),
        weight.sum() ** -0.5,
    )


def _error(likelihood: Callable[[float], float], step: float) -> float:
    """One sigma, from the curvature of the log-likelihood at its maximum."""
    curvature = 2 * likelihood(0.0) - likelihood(-step) - likelihood(step)
    return abs(step) / float(np.sqrt(max(curvature, 1e-9)))


def scatter_of(values: F64) -> float:
    """Standard deviation of a series from differences of frames, as if it were only noise."""
    return robust_sigma(np.diff(values)) / float(np.sqrt(2)) or 1e-300


def _change(rate: float, time_s: F64) -> F64:
    """Probability (t - 1,) that the number of hops from a frame to the next is odd."""
    return np.asarray(-np.expm1(-2 * rate * np.diff(time_s)) / 2)


def _begun(values: F64, time_s: F64, slope: float, size: float, rate: float) -> _Series:
    """With the likeliest base on a grid."""
    ramp = slope * (time_s - time_s.mean())
    noise = max(scatter_of(values), MIN_NOISE * abs(size))
    flat = values - ramp
    bases = np.linspace(flat.min() - size / 2, flat.max() - size / 2, BASES)
    nothing = np.zeros(len(values))
    tried = [
        _Series(values, time_s, ramp + base, noise, nothing).weighed(size, rate) for base in bases
    ]
    return max(tried, key=lambda s: s.likelihood)


def _ramp_of(values: F64, time_s: F64) -> F64:
    """The part of a series that is a ramp."""
    time = time_s - time_s.mean()
    return np.asarray(values.mean() + time * (time @ values) / (time @ time))


def _size(every: Sequence[_Series]) -> float:
    """Size of the hops, with a ramp of each series free; zero where all stay on one level."""
    seen = total = 0.0
    for s in every:
        ramp = _ramp_of(s.second, s.time_s)
        total += float(s.second.sum() - s.second @ ramp) / s.noise**2
        seen += float((s.second - ramp) @ s.values) / s.noise**2
    return seen / total if total > 0 else 0.0


def _settled(s: _Series, size: float) -> _Series:
    """With base and noise refitted for its states."""
    base = _ramp_of(s.values - size * s.second, s.time_s)
    off = s.values - base
    square = off**2 - 2 * size * s.second * off + size**2 * s.second
    noise = max(float(np.sqrt(max(square.mean(), 0.0))), MIN_NOISE * abs(size))
    return replace(s, base=base, noise=noise)


@kernel()
def likely_states(odds: F64, change: F64) -> tuple[F64, float, float]:
    """Probability of the second state, expected changes, and gain in log-likelihood.

    Forward and backward through a series (Rabiner 1989, Proc. IEEE 77, 257). ``odds``: (t,)
    log-likelihood of the second state less the first. ``change``: (t - 1,) probability of a change
    to the next frame.
    """
    n = len(odds)
    ahead, second = np.empty(n), np.empty(n)
    # Forward: probability of the second state, given the frames so far. Backward: likelihood of
    # later frames for the first and the second state (one, other).
    before, likelihood = 0.5, 0.0
    for t in range(n):
        if t:
            before = ahead[t - 1] * (1.0 - change[t - 1]) + (1.0 - ahead[t - 1]) * change[t - 1]
        high = max(odds[t], 0.0)
        one, other = (1.0 - before) * np.exp(-high), before * np.exp(odds[t] - high)
        ahead[t] = other / (one + other)
        likelihood += np.log(one + other) + high
    one, other, changes = 0.5, 0.5, 0.0
    for t in range(n - 1, -1, -1):
        own_one, own_other = (1.0 - ahead[t]) * one, ahead[t] * other
        second[t] = own_other / (own_one + own_other)
        if t == 0:
            break
        high, turn = max(odds[t], 0.0), change[t - 1]
        one, other = one * np.exp(-high), other * np.exp(odds[t] - high)
        up, down = (1.0 - ahead[t - 1]) * turn * other, ahead[t - 1] * turn * one
        still = ((1.0 - ahead[t - 1]) * one + ahead[t - 1] * other) * (1.0 - turn)
        changes += (up + down) / (up + down + still)
        one, other = one + turn * (other - one), other + turn * (one - other)
        total = one + other
        one, other = one / total, other / total
    return second, changes, likelihood
