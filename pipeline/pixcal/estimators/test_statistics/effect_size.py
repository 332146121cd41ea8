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
    is_signature,
    statistic_named,
    straight_significance,
)
from pixcal.estimators.test_statistics.gap import ALLOWED, Gap, gap_of
from pixcal.model.arrays import F64

_HIGHEST = 200.0  # largest logarithm of a power
# least scatter of an amplitude, relative; largest size: numerical limits that no bench reaches
_LEAST, _LARGEST = 1e-4, 1e9
_LEFT = 2.0  # a statistic counts at most this many times its initial gap


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
