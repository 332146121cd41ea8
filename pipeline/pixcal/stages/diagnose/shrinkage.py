"""How far the gap shrinks when the bench has some effects, with its interval."""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.expectation import Expectation
from pixcal.estimators.diagnosis.gap import Difference, Gap, compare, flagged, likelier, remaining
from pixcal.estimators.diagnosis.test_statistics import Key
from pixcal.model.arrays import F64
from pixcal.stages.diagnose.trial import Effects

MIN_LOGLIK_GAIN = 5.0  # by which an effect must raise the log-likelihood of unseen data
DRAWS = 200


@dataclass(frozen=True)
class Trial:
    """A bench held against the data."""

    effects: Effects
    expected: Expectation
    log_likelihood: float


@dataclass(frozen=True)
class Shrinkage:
    """How far the gap shrinks, with its interval (5 to 95 %)."""

    before: Mapping[Key, Difference]  # before, after: differences of the curves
    after: Mapping[Key, Difference]
    where: set[Key]  # curves that make up the gap
    gap: Gap
    interval: tuple[float, float]


def shrinkage(data: Mapping[Key, F64], nominal: Trial, other: Trial, where: set[Key]) -> Shrinkage:
    """The gap with some effects, against the nominal bench's.

    The interval comes from expectations shifted by their own scatter, of all curves: what opens
    where there was no gap counts too.
    """
    before = compare(data, nominal.expected)
    after = compare(data, other.expected)
    gap = remaining(before, after, where)
    rng = np.random.default_rng(17)
    draws = []
    for _ in range(DRAWS):
        expected = other.expected
        mean = {
            k: m + np.sqrt(expected.variance[k]) * rng.standard_normal(len(m))
            for k, m in expected.mean.items()
        }
        doubled = {k: 2 * expected.variance[k] for k in mean}
        moved = replace(expected, mean=mean, variance=doubled)
        draws.append(remaining(before, compare(data, moved), where).total if where else 0.0)
    low, high = np.quantile(draws, (0.05, 0.95))
    return Shrinkage(
        before, after, where, gap, (min(float(low), gap.total), max(float(high), gap.total))
    )


def differing(nominal: Trial, final: Trial, data: Mapping[Key, F64]) -> set[Key]:
    """Curves that make up the gap: those that differ, and those by which causes were told."""
    where = flagged(compare(data, nominal.expected))
    if not final.effects:
        return where
    gains = likelier(data, nominal.expected, final.expected)
    where |= {key for key, gain in gains.items() if gain > MIN_LOGLIK_GAIN / 2}
    # A cause that many curves tell a little each is still told by the one that does it best.
    return where or {max(gains, key=lambda key: gains[key])}
