"""Compare simulated benches with the held-out frames; how much of the gap effects close."""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.test_statistics import DETECTOR, Curve, Key, known_statistics
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
    sigmas_among,
    sigmas_of,
)
from pixcal.model.arrays import F64
from pixcal.simulation.effect import DOMAINS
from pixcal.stages.diagnose.thresholds import LAW_ERROR, MAX_RESIDUAL_GAP, MIN_LOGLIK_GAIN
from pixcal.stages.diagnose.trial import Curves, Effects

DRAWS = 200
CHANGED = 3.0  # standard deviations by which a cause must change a statistic that tests it


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


def _squares(differences: Mapping[Key, Difference], where: set[Key]) -> float:
    return sum(sigmas_of(differences[key].log_chance) ** 2 for key in where)


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

    def gain_where_differing(self, start: Trial, trial: Trial, key: Key) -> float:
        """Rise of the log-likelihood in curves that differ in ``start``, and in ``key``."""
        gains = likelier(self.data, start.expected, trial.expected)
        differences = compare(self.data, start.expected)
        where = flagged(differences)
        if key in differences and differences[key].log_chance < np.log(FALSE_ALARM_RATE):
            where.add(key)
        return sum(gains[key] for key in where)

    def differs(self, trial: Trial) -> bool:
        """Whether any test statistic of the data differs significantly from a bench."""
        return bool(flagged(compare(self.data, trial.expected)))

    def residual(self, trial: Trial, where: set[Key], apart: Set[Key] = frozenset()) -> float:
        """Residual fraction of the gap, in the test statistics ``where``, with a bench.

        Those ``apart`` do not count.
        """
        before, after = (
            {k: d for k, d in compare(self.data, bench.expected).items() if k not in apart}
            for bench in (self.nominal, trial)
        )
        return remaining(before, after, where - apart).total

    def residual_size(self, trial: Trial, where: set[Key]) -> float:
        """The same by effect sizes, as in the reported gap, instead of significances."""
        return shrinkage(self.data, self.nominal, trial, where).gap.total

    def gap_of(self, *trials: Trial) -> set[Key]:
        """Test statistics that make up the gap for any of these benches."""
        return set().union(*(differing(self.nominal, trial, self.data) for trial in trials))

    def settles(self, key: Key, fewer: Trial, trial: Trial) -> bool:
        """Whether the data show all that a cause, added to ``fewer``, changes in simulations.

        It leaves almost no difference and causes almost no new one. Not only ``key``, its
        significance, differed: fitted and held-out frames agree in that, whatever the true cause.
        """
        moved = compare(trial.expected.mean, fewer.expected)
        changed = {key for key, one in moved.items() if abs(one.sigmas[one.worst]) > CHANGED}
        # Nor relative to the nominal bench: causes may only compensate each other.
        nominal, before, after = (
            {k: d for k, d in compare(self.data, bench.expected).items() if k in changed}
            for bench in (self.nominal, fewer, trial)
        )
        left = _squares(after, flagged(after))
        return all(
            (where := flagged(old)) - {key} and left <= MAX_RESIDUAL_GAP * _squares(old, where)
            for old in (nominal, before)
        )

    def replay_fits_better(self, replay: Trial, law: Trial) -> bool:
        """Whether a replay is likelier than the law, or leaves a smaller residual gap."""
        if replay.log_likelihood > law.log_likelihood:
            return True
        where = self.gap_of(replay, law)
        return self.residual(replay, where) < self.residual(law, where)

    def _trial(self, effects: Effects, expected: Expectation) -> Trial:
        return Trial(effects, expected, log_likelihood(self.data, expected))


# In the words and numbers of the results


def by_domain(
    before: Mapping[Key, Difference], after: Mapping[Key, Difference]
) -> dict[str, list[float]]:
    """Largest deviation (sigma, at least 0) in each domain, before and after."""
    largest = {}
    for domain in DOMAINS:
        keys = [k for k in before if statistic_named(k[0]).domain == domain]
        largest[domain] = [
            rounded(sigmas_among(min(one[k].log_chance for k in keys), len(keys))) if keys else 0.0
            for one in (before, after)
        ]
    return largest


def not_compared(measured: Mapping[Key, Curve], data: Mapping[Key, F64]) -> list[str]:
    """Titles of measured statistics that simulations lack, or have in another form."""
    # Estimates used as statistics are left out: simulations compute some of them only when needed.
    known = known_statistics()
    return [
        statistic_named(name).title + ("" if of == DETECTOR else f" of {of}")
        for name, of in sorted(set(measured) - set(data))
        if name in known
    ]


def rounded(value: float) -> float:
    """To four digits."""
    return float(f"{value:.4g}")
