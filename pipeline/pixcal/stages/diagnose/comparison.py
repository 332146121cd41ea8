"""Compare simulated benches with the held-out frames; how much of the gap effects close."""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.test_statistics import Key
from pixcal.estimators.test_statistics.expectation import (
    Expectation,
    Reference,
    expect_nominal,
    expect_with,
    statistic_named,
)
from pixcal.estimators.test_statistics.gap import (
    FALSE_ALARM_RATE,
    Difference,
    EffectSizes,
    Gap,
    SizeScale,
    compare,
    flagged,
    gap_of_sizes,
    likelier,
    log_likelihood,
    remaining,
)
from pixcal.model.arrays import F64
from pixcal.stages.diagnose.thresholds import LAW_ERROR, MAX_RESIDUAL_GAP, MIN_LOGLIK_GAIN, STAYS
from pixcal.stages.diagnose.trial import Curves, Effects

DRAWS = 200


@dataclass(frozen=True)
class Trial:
    """A simulated bench compared with the data."""

    effects: Effects
    expected: Expectation
    log_likelihood: float


@dataclass(frozen=True)
class Shrinkage:
    """How much of the gap effects close."""

    # before, after: differences of the curves
    before: Mapping[Key, Difference]
    after: Mapping[Key, Difference]
    scale: SizeScale
    sizes: EffectSizes  # before
    where: set[Key]  # curves that make up the gap
    gap: Gap  # by effect sizes
    significant: Gap  # by significances

    def with_expectation(self, data: Mapping[Key, F64], expected: Expectation) -> Gap:
        """The gap, by effect sizes, with another expectation of the curves."""
        new = flagged(compare(data, expected))
        return gap_of_sizes(self.sizes, self.scale.compared(expected), self.where, new)


def shrinkage(data: Mapping[Key, F64], nominal: Trial, other: Trial, where: set[Key]) -> Shrinkage:
    """The gap with the effects of a bench, relative to that of the nominal bench."""
    before, after = (compare(data, trial.expected) for trial in (nominal, other))
    scale = SizeScale(data, nominal.expected)
    sizes = scale.compared(nominal.expected)
    gap = gap_of_sizes(sizes, scale.compared(other.expected), where, flagged(after))
    return Shrinkage(before, after, scale, sizes, where, gap, remaining(before, after, where))


def gap_interval(data: Mapping[Key, F64], shrunk: Shrinkage, other: Trial) -> tuple[float, float]:
    """Interval (5 to 95 %) of the residual gap over all curves, from their scatter."""
    total = shrunk.gap.total
    if not shrunk.where:
        return min(0.0, total), total
    expected, rng = other.expected, np.random.default_rng(17)
    error = np.sqrt(np.concatenate([expected.variance[key] for key in expected.mean]))
    ends = np.cumsum([len(mean) for mean in expected.mean.values()])[:-1]
    wider = replace(expected, variance={k: 2 * own for k, own in expected.variance.items()})
    draws = []
    for _ in range(DRAWS):
        shifts = np.split(error * rng.standard_normal(len(error)), ends)
        mean = {k: m + own for (k, m), own in zip(expected.mean.items(), shifts, strict=True)}
        shifted = replace(wider, mean=mean)
        draws.append(shrunk.with_expectation(data, shifted).total)
    low, high = np.quantile(draws, (0.05, 0.95))
    return min(float(low), total), max(float(high), total)


def differing(nominal: Trial, final: Trial, data: Mapping[Key, F64]) -> set[Key]:
    """Curves that make up the gap: those that differ, and those that identified causes."""
    where = flagged(compare(data, nominal.expected))
    if not final.effects:
        return where
    gains = likelier(data, nominal.expected, final.expected)
    where |= {key for key, gain in gains.items() if gain > MIN_LOGLIK_GAIN / 2}
    # If each of many curves favours a cause only slightly, the one that favours it most counts.
    return where or {max(gains, key=lambda key: gains[key])}


class Comparison:
    """Likelihoods and residual gaps of simulated benches, on the scales of the nominal bench."""

    def __init__(self, reference: Reference, data: Mapping[Key, F64]) -> None:
        self.reference, self.data = reference, data
        self.nominal = self._trial((), expect_nominal(reference))

    def trial(
        self,
        effects: Effects,
        curves: Sequence[Curves],
        significance: float = np.inf,
        beside: Trial | None = None,
    ) -> Trial:
        """A bench with effects, from the curves of its simulations.

        The effect added to ``beside`` has a relative error of 1 / ``significance`` in strength.
        """
        error = 1 / max(significance, 1.0)
        start = None if beside is None else beside.expected
        return self._trial(effects, expect_with(self.reference, curves, error, start))

    def allowing_for_laws(self, trial: Trial, accepted: Trial) -> Trial:
        """A trial that allows for other laws of the previously accepted effects."""
        if not accepted.effects:
            return trial
        nominal, variance = self.nominal.expected.mean, dict(trial.expected.variance)
        for key, mean in accepted.expected.mean.items():
            variance[key] = variance[key] + (LAW_ERROR * (mean - nominal[key])) ** 2
        return self._trial(trial.effects, replace(trial.expected, variance=variance))

    def gain_over(self, fewer: Trial, trial: Trial) -> float:
        """Rise of the log-likelihood by a cause, allowing for other laws of the other causes."""
        with_it, without = (self.allowing_for_laws(t, fewer) for t in (trial, fewer))
        return with_it.log_likelihood - without.log_likelihood

    def gain_where_differing(self, start: Trial, trial: Trial, own: Key) -> float:
        """Rise of the log-likelihood in curves that differ in ``start``, and in ``own``."""
        gains = likelier(self.data, start.expected, trial.expected)
        differences = compare(self.data, start.expected)
        where = flagged(differences)
        if own in differences and differences[own].log_chance < np.log(FALSE_ALARM_RATE):
            where.add(own)
        return sum(gains[key] for key in where)

    def differs(self, trial: Trial) -> bool:
        """Whether any test statistic of the data differs significantly from a bench."""
        return bool(flagged(compare(self.data, trial.expected)))

    def residual(self, trial: Trial, where: set[Key]) -> float:
        """Residual fraction of the gap, in the test statistics ``where``, with a bench."""
        before = compare(self.data, self.nominal.expected)
        return remaining(before, compare(self.data, trial.expected), where).total

    def residual_size(self, trial: Trial, where: set[Key]) -> float:
        """The same by effect sizes, as in the reported gap, instead of significances."""
        return shrinkage(self.data, self.nominal, trial, where).gap.total

    def gap_of(self, *trials: Trial) -> set[Key]:
        """Test statistics that make up the gap for any of these benches."""
        return set().union(*(differing(self.nominal, trial, self.data) for trial in trials))

    def strongest_stays(self, trial: Trial) -> bool:
        """Whether the largest difference from the nominal bench keeps over half of its size."""
        before = compare(self.data, self.nominal.expected)
        after = compare(self.data, trial.expected)
        where = self.gap_of(trial) & after.keys()
        sizes = {key: float(np.abs(before[key].sigmas).max()) for key in where}
        top = max(sizes, key=lambda key: sizes[key], default=None)
        if top is None:
            return False
        left = abs(float(after[top].sigmas[before[top].worst]))
        return left > STAYS * sizes[top]

    def settles(self, domains: Container[str], fewer: Trial, trial: Trial) -> bool:
        """Whether a cause, added to ``fewer``, leaves almost nothing open in its own domains."""
        # Nor relative to the nominal bench: causes may only compensate each other.
        nominal, before, after = (
            {
                key: one
                for key, one in compare(self.data, bench.expected).items()
                if statistic_named(key[0]).domain in domains
            }
            for bench in (self.nominal, fewer, trial)
        )
        return all(
            (where := flagged(start)) and remaining(start, after, where).total <= MAX_RESIDUAL_GAP
            for start in (nominal, before)
        )

    def replay_fits_better(self, replay: Trial, law: Trial) -> bool:
        """Whether a replay is likelier than the law, or leaves a smaller residual gap."""
        if replay.log_likelihood > law.log_likelihood:
            return True
        where = self.gap_of(replay, law)
        return self.residual(replay, where) < self.residual(law, where)

    def _trial(self, effects: Effects, expected: Expectation) -> Trial:
        return Trial(effects, expected, log_likelihood(self.data, expected))
