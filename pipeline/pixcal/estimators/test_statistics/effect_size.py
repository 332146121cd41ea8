"""Differences from simulations as effect sizes: deviations in units of the simulated scatter.

Few simulations limit a significance to some ten sigma, so a strong effect would count no more than
a weak one. An effect size has no such limit, and grows with the strength of an effect: powers are
compared as amplitudes, and significances without their logarithm.
"""

from collections.abc import Mapping, Set
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.test_statistics import Key
from pixcal.estimators.test_statistics.expectation import (
    Expectation,
    statistic_named,
    straight_significance,
)
from pixcal.estimators.test_statistics.gap import ALLOWED, Gap
from pixcal.model.arrays import F64

_LARGEST = 200.0  # largest logarithm of a power: no effect size overflows
_LEFT = 2.0  # a statistic counts at most this often the gap that it had at the start


@dataclass(frozen=True)
class EffectSize:
    """Difference of one curve of the data from an expectation."""

    sizes: F64  # (n,) signed, in standard deviations of the nominal simulations
    # sum of the squared sizes of what exceeds `ALLOWED` standard deviations of the expectation
    beyond: float

    @property
    def largest(self) -> float:
        """Size of the largest deviation."""
        return float(np.abs(self.sizes).max())


def effect_sizes(
    data: Mapping[Key, F64], expected: Expectation, nominal: Expectation
) -> dict[Key, EffectSize]:
    """Effect size of every curve of the data (on the reference's scales)."""
    found = {}
    for key in expected.mean.keys() & data.keys():
        mean, error, scatter = expected.mean[key], expected.variance[key], nominal.noise[key]
        margin, middle, spread = ALLOWED * np.sqrt(error), nominal.mean[key], np.sqrt(scatter)
        nearest = np.clip(data[key], mean - margin, mean + margin)
        ends = np.stack([data[key], mean, nearest, middle + spread, middle - spread])
        own, plain, allowed, high, low = _linear(key, ends)
        unit = (high - low) / 2
        beyond = float(np.sum(((own - allowed) / unit) ** 2))
        found[key] = EffectSize((own - plain) / unit, beyond)
    return found


def gap_of_sizes(
    before: Mapping[Key, EffectSize],
    after: Mapping[Key, EffectSize],
    where: Set[Key],
    new: Set[Key],
) -> Gap:
    """Remaining gap: curves ``where`` weighted by their squared size, ``new`` ones in full."""
    # A statistic that identified a cause may itself deviate by no more than its scatter.
    weights = {key: max(before[key].largest, 1.0) ** 2 for key in where}
    whole = sum(weights.values())
    left = {
        key: min(after[key].beyond / max(before[key].beyond, 1e-12), _LEFT)
        for key in where
        if key in after
    }
    total = sum(weights[key] * left[key] for key in left)
    for key in new - where:
        own = after[key].largest ** 2
        total += own
        left[key] = own / max(whole, 1e-12)
    return Gap(total / whole if whole else 0.0, weights, left)


def _linear(key: Key, values: F64) -> F64:
    """Values of a curve on a scale that grows with the strength of an effect."""
    if statistic_named(key[0]).kind == "power":
        rising = np.exp(np.clip(values, 0, _LARGEST) / 2)
        return np.asarray(np.where(values > 0, rising, np.maximum(1 + values / 3, 0) ** 1.5))
    return straight_significance(key, values)
