"""The gap between data and simulations: curve by curve, the difference beyond chance.

Values are compared with simulations of the same bench by Student's distribution, which allows for
few simulations. Mean squares are compared by a root below their usual size and a logarithm above
it, whose scatter is nearly normal.

With few simulations a significance is limited to about ten sigma, so a strong effect would count no
more than a weak one. Effect sizes have no such limit, and grow with the strength of an effect:
powers are compared as amplitudes, and significances without their logarithm.
"""

from collections.abc import Mapping, Set
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri_exp, stdtr

from pixcal.estimators.test_statistics import Key
from pixcal.estimators.test_statistics.expectation import (
    Expectation,
    is_signature,
    statistic_named,
    straight_significance,
)
from pixcal.kernels.significance import log_of_any
from pixcal.model.arrays import F64

ALLOWED = 2.0  # standard deviations of a value that do not count as a gap
# p-value, for all statistics together, below which a difference is a gap
FALSE_ALARM_RATE = 1e-3

_HIGHEST = 200.0  # largest logarithm of a power
# least scatter of an amplitude, relative; largest size: numerical limits that no bench reaches
_LEAST, _LARGEST = 1e-4, 1e9
_LEFT = 2.0  # a statistic counts at most this many times its initial gap


@dataclass(frozen=True)
class Difference:
    """One curve of the data against an expectation."""

    sigmas: F64  # (n,) signed, equivalent deviations of a normal
    # logarithm of the p-value of the curve's largest deviation; the p-value is uniform without a
    # gap
    log_chance: float
    # squares of the deviations beyond `ALLOWED` standard deviations, over the nominal noise
    excess: float

    @property
    def worst(self) -> int:
        """Number of the value with the largest deviation."""
        return int(np.argmax(np.abs(self.sigmas)))


def compare(data: Mapping[Key, F64], expected: Expectation) -> dict[Key, Difference]:
    """Curves of the data (on the reference's scales) against an expectation."""
    keys = [key for key in expected.mean if key in data]
    if not keys:
        return {}
    # All values in one call, as the call is slow.
    sizes = [len(data[key]) for key in keys]
    starts = np.cumsum([0, *sizes[:-1]])
    off = np.concatenate([data[key] - expected.mean[key] for key in keys])
    error = np.sqrt(np.concatenate([expected.variance[key] for key in keys]))
    noise = np.concatenate([expected.noise[key] for key in keys])
    with np.errstate(divide="ignore"):
        tails = np.log(stdtr(expected.dof, -np.abs(off) / error))
    sigmas = -ndtri_exp(np.minimum(tails, -1e-300)) * np.sign(off)
    least = np.minimum.reduceat(tails, starts) + np.log(2)
    beyond = np.maximum(np.abs(off) - ALLOWED * error, 0) ** 2
    excess = np.add.reduceat(beyond / noise, starts)
    return {
        key: Difference(
            sigmas[first : first + size],
            log_of_any(min(float(chance), -1e-15), expected.independent[key]),
            float(more),
        )
        for key, first, size, chance, more in zip(keys, starts, sizes, least, excess, strict=True)
    }


def flagged(differences: Mapping[Key, Difference]) -> set[Key]:
    """Curves that differ by more than chance, for all statistics together (Bonferroni)."""
    limit = np.log(FALSE_ALARM_RATE / max(len(differences), 1))
    return {key for key, d in differences.items() if d.log_chance < limit}


def sigmas_of(log_chance: float) -> float:
    """Standard deviations of a normal that are as rare, one-sided."""
    return float(-ndtri_exp(min(log_chance, -1e-300)))


def sigmas_among(log_chance: float, tested: int) -> float:
    """Significance (sigma) of one of several statistics tested, given its own log chance."""
    return max(sigmas_of(log_chance + float(np.log(max(tested, 1)))), 0.0)


def log_likelihood(data: Mapping[Key, F64], expected: Expectation) -> float:
    """Log probability density (Student's) of the data, for all curves together."""
    return sum(_log_density(data[key], expected, key) for key in expected.mean if key in data)


def likelier(data: Mapping[Key, F64], before: Expectation, after: Expectation) -> dict[Key, float]:
    """Rise of the log probability density of each curve."""
    return {
        key: _log_density(data[key], after, key) - _log_density(data[key], before, key)
        for key in before.mean
        if key in data
    }


def _log_density(values: F64, expected: Expectation, key: Key) -> float:
    """Of one curve; more than three values count as three, as they are not independent."""
    variance, nu = expected.variance[key], expected.dof
    square = (values - expected.mean[key]) ** 2 / variance
    terms = -(nu + 1) / 2 * np.log1p(square / nu) - np.log(variance) / 2
    return float(terms.sum()) / max(1.0, len(values) / 3)


@dataclass(frozen=True)
class Gap:
    """Remaining gap, relative to that of the nominal bench."""

    total: float  # 1: all of it; 0: none
    # weights, left: of each curve: its weight, and the share of its excess that remains
    weights: Mapping[Key, float]
    left: Mapping[Key, float]

    def of_domain(self, domain: str) -> tuple[float, float]:
        """Weight of a domain, and of its remaining part, over the whole initial gap."""
        whole = sum(self.weights.values()) or 1.0
        keys = [k for k in self.left if statistic_named(k[0]).domain == domain]
        return (
            sum(self.weights.get(k, 0.0) for k in keys) / whole,
            sum(self.weights.get(k, 0.0) * self.left[k] for k in keys) / whole,
        )


def remaining(
    before: Mapping[Key, Difference], after: Mapping[Key, Difference], where: set[Key]
) -> Gap:
    """Remaining gap: curves ``where`` weighted by squared significance, new ones in full."""
    weights = {k: sigmas_of(before[k].log_chance) ** 2 for k in where}
    left = {
        k: float(np.clip(after[k].excess / max(before[k].excess, 1e-12), 0, 2))
        for k in where
        if k in after
    }
    new = {k: sigmas_of(after[k].log_chance) ** 2 for k in flagged(after) - where}
    return gap_of(weights, left, new)


def gap_of(
    weights: Mapping[Key, float], left: Mapping[Key, float], new: Mapping[Key, float]
) -> Gap:
    """Remaining gap: shares ``left`` of weighted curves, and the weights of ``new`` curves."""
    whole = sum(weights.values())
    total = sum(weights[k] * left[k] for k in left)
    for size in new.values():
        total += size
    every = {**left, **{k: size / max(whole, 1e-12) for k, size in new.items()}}
    return Gap(total / whole if whole else 0.0, weights, every)


# Differences in units of the simulated scatter


@dataclass(frozen=True)
class EffectSizes:
    """Differences of the curves of the data from an expectation."""

    # signed, of the most significant value of each curve, in standard deviations of the nominal
    # simulations
    size: Mapping[Key, float]
    # sum of the squared sizes of what exceeds `ALLOWED` standard deviations of the expectation
    beyond: Mapping[Key, float]


class SizeScale:
    """Scale of effect sizes: curves of the data, and their scatter in nominal simulations.

    data : curves on the scales of the reference
    """

    def __init__(self, data: Mapping[Key, F64], nominal: Expectation) -> None:
        self._keys = [key for key in nominal.mean if key in data]
        sizes = [len(data[key]) for key in self._keys]
        self._starts = np.cumsum([0, *sizes[:-1]])
        kinds = [(statistic_named(k[0]).kind == "power", is_signature(k)) for k in self._keys]
        self._power, self._signature = np.repeat(np.array(kinds, bool).reshape(-1, 2), sizes, 0).T
        self._data = self._joined(data)
        middle, spread = self._joined(nominal.mean), np.sqrt(self._joined(nominal.noise))
        unit = (self._linear(middle + spread) - self._linear(middle - spread)) / 2
        self._unit = np.where(self._power, np.maximum(unit, _LEAST), unit)
        self._own = self._linear(self._data)

    def compared(self, expected: Expectation) -> EffectSizes:
        """Effect sizes of the differences from an expectation."""
        if not self._keys:
            return EffectSizes({}, {})
        mean, error = self._joined(expected.mean), np.sqrt(self._joined(expected.variance))
        sizes = self._sizes(mean)
        nearest = np.clip(self._data, mean - ALLOWED * error, mean + ALLOWED * error)
        beyond = np.add.reduceat(self._sizes(nearest) ** 2, self._starts)
        sigmas = np.split(np.abs(self._data - mean) / error, self._starts[1:])
        worst = self._starts + [int(np.argmax(own)) for own in sigmas]
        return EffectSizes(
            dict(zip(self._keys, sizes[worst].tolist(), strict=True)),
            dict(zip(self._keys, beyond.tolist(), strict=True)),
        )

    def _joined(self, curves: Mapping[Key, F64]) -> F64:
        # All values in one array: a few calls instead of some for each curve.
        return np.concatenate([curves[key] for key in self._keys] or [np.zeros(0)])

    def _sizes(self, values: F64) -> F64:
        with np.errstate(divide="ignore", invalid="ignore"):
            sizes = np.nan_to_num((self._own - self._linear(values)) / self._unit)
        return np.clip(sizes, -_LARGEST, _LARGEST)

    def _linear(self, values: F64) -> F64:
        """Values on scales that grow with the strength of an effect."""
        rising = np.exp(np.clip(values, 0, _HIGHEST) / 2)
        amplitude = np.where(values > 0, rising, np.maximum(1 + values / 3, 0) ** 1.5)
        straight = np.where(self._signature, straight_significance(values), values)
        return np.where(self._power, amplitude, straight)


def gap_of_sizes(before: EffectSizes, after: EffectSizes, where: Set[Key], new: Set[Key]) -> Gap:
    """Remaining gap: curves ``where`` weighted by their size, ``new`` ones in full."""
    # A statistic that identified a cause may itself deviate by no more than its scatter.
    weights = {key: max(abs(before.size[key]), 1.0) for key in sorted(where)}
    left = {key: min(after.beyond[key] / max(before.beyond[key], 1e-12), _LEFT) for key in weights}
    return gap_of(weights, left, {key: abs(after.size[key]) for key in sorted(new - where)})
