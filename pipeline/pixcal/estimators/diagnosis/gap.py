"""The gap between data and simulations: curve by curve, how far beyond what chance allows.

Simulations of the same bench with other random numbers show how a statistic scatters. A value of
the data is held against them by Student's distribution: with few simulations, a deviation counts
for as much as it can. Mean squares are compared through a root below their usual size and a
logarithm above it: the scatter of both is nearly normal, and the same for strong effects and weak.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from scipy.special import ndtri_exp, stdtr

from pixcal.estimators.diagnosis.test_statistics import Curve, Key
from pixcal.estimators.diagnosis.test_statistics.signature import statistic_named
from pixcal.model.arrays import F64

Curves = Mapping[Key, Curve]

TOLERANCE = 0.05  # share of what an effect does that its simulation may be wrong by
ALLOWED = 2.0  # standard deviations that a value may be off by before it counts as a gap
# standard deviations from which one value of a curve is changed, whatever the others are
STANDS_OUT = 2.5
CHANCE = 1e-3  # chance, of all statistics together, below which a difference is a gap


def scaled(values: F64, usual: F64) -> F64:
    """Mean squares over their usual size, on a scale where chance is nearly normal."""
    ratio = values / np.maximum(usual, 1e-300)
    low = 3 * (np.cbrt(np.minimum(ratio, 1.0)) - 1)
    return np.asarray(np.where(ratio > 1, np.log(np.maximum(ratio, 1.0)), low))


@dataclass(frozen=True)
class Reference:
    """What the nominal bench lets expect: simulations with different seeds, on their scales."""

    # median (n,) of each curve that is a power; None for the others
    usual: Mapping[Key, F64 | None]
    values: Mapping[Key, F64]  # (simulation, n) of each curve, in the order of the seeds
    # as how many independent values each curve's are, `independent_values`
    independent: Mapping[Key, float]

    @classmethod
    def of(cls, simulated: Sequence[Curves]) -> "Reference":
        """From simulations; curves that not all of them have are left out."""
        keys = [k for k in simulated[0] if all(k in s for s in simulated)]
        keys = [k for k in keys if len({len(s[k].value) for s in simulated}) == 1]
        usual: dict[Key, F64 | None] = {}
        values = {}
        for key in keys:
            stack = np.stack([s[key].value for s in simulated])
            power = statistic_named(key[0]).kind == "power"
            usual[key] = np.median(stack, axis=0) if power else None
            own = usual[key]
            values[key] = stack if own is None else scaled(stack, own)
        floors = {key: statistic_named(key[0]).floor for key in values}
        independent = {key: independent_values(v, floors[key]) for key, v in values.items()}
        return cls(usual, values, independent)

    def on_scale(self, curves: Curves) -> dict[Key, F64]:
        """Curves on the scales of the reference, where it has them."""
        found = {}
        for key, usual in self.usual.items():
            curve = curves.get(key)
            if curve is not None and len(curve.value) == self.values[key].shape[1]:
                found[key] = curve.value if usual is None else scaled(curve.value, usual)
        return found

    def without(self, keys: Collection[Key]) -> Self:
        """The reference of all other curves."""
        kept = self.values.keys() - set(keys)
        return type(self)(
            {key: self.usual[key] for key in self.values if key in kept},
            {key: v for key, v in self.values.items() if key in kept},
            {key: self.independent[key] for key in self.values if key in kept},
        )


@dataclass(frozen=True)
class Expectation:
    """What a bench, nominal or with effects, lets expect of every curve."""

    # mean, variance: (n,) on the reference's scales; the variance of a value of the data about the
    # mean
    mean: Mapping[Key, F64]
    variance: Mapping[Key, F64]
    noise: Mapping[Key, F64]  # variance (n,) of the nominal bench alone
    independent: Mapping[Key, float]  # as of the reference
    dof: int


def expect_nominal(reference: Reference) -> Expectation:
    """What the nominal bench lets expect."""
    mean, variance, noise, count = {}, {}, {}, 2
    for key, values in reference.values.items():
        count = len(values)
        noise[key] = _variance(values, statistic_named(key[0]).floor)
        mean[key] = values.mean(axis=0)
        variance[key] = noise[key] * (1 + 1 / count)
    return Expectation(mean, variance, noise, reference.independent, count - 1)


def expect_with(
    reference: Reference, simulated: Sequence[Curves], error: float = 0.0
) -> Expectation:
    """What a bench with effects, of this relative ``error`` of their strength, lets expect.

    The simulations have the first seeds of the reference, in the same order: what differs is due to
    effects.
    """
    nominal = expect_nominal(reference)
    scaled_ones = [reference.on_scale(s) for s in simulated]
    pairs: dict[Key, tuple[F64, F64]] = {}
    for key, values in reference.values.items():
        # An estimate may fail in a few simulations: the others tell what it is.
        having = [n for n, s in enumerate(scaled_ones) if key in s]
        if 2 * len(having) > len(simulated):
            pairs[key] = np.stack([scaled_ones[n][key] for n in having]), values[having]
    mean, variance = dict(nominal.mean), dict(nominal.variance)
    usual = _usual_scatter(pairs, nominal)
    for key, (own, same_seeds) in pairs.items():
        change, count, noise = own - same_seeds, len(own), nominal.noise[key]
        paired = change.var(axis=0, ddof=1) if count > 1 else usual * noise
        # What the same seeds do not have in common, in units of the noise: 2 is all of it.
        apart = min(float(np.mean(paired / noise)), 2.0)
        shift = change.mean(axis=0)
        certain = _certain(shift, apart * noise / count)
        mean[key] = nominal.mean[key] + certain * shift
        more = (TOLERANCE**2 + error**2) * (certain * shift) ** 2 + certain * paired / count
        if count > 1:
            # What the effects add to the scatter, beyond what few seeds have by chance.
            chance = noise * np.sqrt(4 * apart * (1 - apart / 4) / (count - 1))
            excess = own.var(axis=0, ddof=1) - same_seeds.var(axis=0, ddof=1) - chance
            more += np.maximum(excess, 0)
        variance[key] = nominal.variance[key] + more
    return replace(nominal, mean=mean, variance=variance)


def _usual_scatter(pairs: Mapping[Key, tuple[F64, F64]], nominal: Expectation) -> float:
    """Variance of changes that are chance alone, over the noise: that of most curves.

    Effects that move the light change the noise of every sample a little, and so all curves.
    """
    sizes = [
        float(np.mean((own - same) ** 2 / nominal.noise[key])) for key, (own, same) in pairs.items()
    ]
    return min(float(np.median(sizes)), 2.0) if sizes else 0.0


def _certain(shift: F64, chance: F64) -> F64:
    """Share (n,) of a curve's change that is the effects' (positive part of James and Stein).

    Of the whole curve; and of values by themselves, where one stands out.
    """
    squares = shift**2 / np.maximum(chance, 1e-300)
    whole = max(1 - 1 / max(float(np.mean(squares)), 1e-300), 0.0)
    return np.maximum(whole, 1 - STANDS_OUT**2 / np.maximum(squares, STANDS_OUT**2))


def _variance(values: F64, floor: float) -> F64:
    """Variance (n,), leaning on the other values of the curve so that none is tiny by chance."""
    own = values.var(axis=0, ddof=1)
    rounding = (1e-9 * np.abs(values).max(axis=0)) ** 2
    leaning = 0.9 * own + 0.1 * np.median(own) + rounding + 1e-300
    return np.asarray(np.maximum(leaning, floor**2))


def independent_values(values: F64, floor: float = 0.0) -> float:
    """As how many independent values those of a curve are, when the least likely one is looked at.

    Each of the simulations (simulation, n) is held against the others. Of n independent values the
    least chance u has -log(1 - u) distributed as an exponential with the mean 1 / n, whose
    likelihood gives n. The standard deviation is at least ``floor``.
    """
    count, n = values.shape
    if n == 1 or count < 3:
        return float(n)
    total = 0.0
    for number in range(count):
        others = np.delete(values, number, axis=0)
        error = np.sqrt(_variance(others, floor) * (1 + 1 / len(others)))
        chance = 2 * stdtr(count - 2, -np.abs(values[number] - others.mean(axis=0)) / error)
        total -= float(np.log1p(-min(float(chance.min()), 1 - 1e-9)))
    return float(np.clip(count / total, 1, n))


@dataclass(frozen=True)
class Difference:
    """One curve of the data against an expectation."""

    sigmas: F64  # (n,) signed; of a normal, as rare as the deviation is
    # logarithm of the chance that any of the curve's values is as far off; uniform (its
    # exponential) where there is no gap
    log_chance: float
    # squares of the deviations, as far as they are beyond `ALLOWED` standard deviations, over the
    # nominal noise
    excess: float

    @property
    def worst(self) -> int:
        """Number of the value that is furthest off."""
        return int(np.argmax(np.abs(self.sigmas)))


def compare(data: Mapping[Key, F64], expected: Expectation) -> dict[Key, Difference]:
    """Curves of the data (on the reference's scales) against an expectation."""
    keys = [key for key in expected.mean if key in data]
    if not keys:
        return {}
    # All values at once: a call takes longer than a curve.
    sizes = [len(data[key]) for key in keys]
    starts = np.cumsum([0, *sizes[:-1]])
    off = np.concatenate([data[key] - expected.mean[key] for key in keys])
    error = np.sqrt(np.concatenate([expected.variance[key] for key in keys]))
    noise = np.concatenate([expected.noise[key] for key in keys])
    with np.errstate(divide="ignore"):
        tails = np.log(stdtr(expected.dof, -np.abs(off) / error))
    sigmas = -ndtri_exp(np.minimum(tails, -1e-300)) * np.sign(off)
    least = np.minimum.reduceat(tails, starts) + np.log(2)
    any_of = _any_of(least, np.array([expected.independent[key] for key in keys]))
    beyond = np.maximum(np.abs(off) - ALLOWED * error, 0) ** 2
    excess = np.add.reduceat(beyond / noise, starts)
    return {
        key: Difference(sigmas[first : first + size], float(chance), float(more))
        for key, first, size, chance, more in zip(keys, starts, sizes, any_of, excess, strict=True)
    }


def _any_of(log_chance: F64, count: F64) -> F64:
    """Logarithm of the chance that the least of some independent chances is as small."""
    none = count * np.log1p(-np.minimum(np.exp(log_chance), 1 - 1e-15))
    tiny = log_chance < -30
    many = np.log(-np.expm1(np.where(tiny, -1.0, none)))
    return np.asarray(np.where(tiny, log_chance + np.log(count), many))


def flagged(differences: Mapping[Key, Difference]) -> set[Key]:
    """Curves that differ by more than chance, all statistics being looked at (Bonferroni)."""
    limit = np.log(CHANCE / max(len(differences), 1))
    return {key for key, d in differences.items() if d.log_chance < limit}


def sigmas_of(log_chance: float) -> float:
    """Standard deviations of a normal that are as rare, one-sided."""
    return float(-ndtri_exp(min(log_chance, -1e-300)))


def sigmas_among(log_chance: float, tested: int) -> float:
    """Significance (sigma) of one of several statistics tested, given its own log chance."""
    return max(sigmas_of(log_chance + float(np.log(max(tested, 1)))), 0.0)


def log_likelihood(data: Mapping[Key, F64], expected: Expectation) -> float:
    """Logarithm of the chance density (Student's) of the data, of all curves together."""
    return sum(_log_density(data[key], expected, key) for key in expected.mean if key in data)


def likelier(data: Mapping[Key, F64], before: Expectation, after: Expectation) -> dict[Key, float]:
    """By how much the logarithm of the chance density of each curve rises."""
    return {
        key: _log_density(data[key], after, key) - _log_density(data[key], before, key)
        for key in before.mean
        if key in data
    }


def _log_density(values: F64, expected: Expectation, key: Key) -> float:
    """Of one curve; of more than three values it counts as three, for they are not independent."""
    variance, nu = expected.variance[key], expected.dof
    square = (values - expected.mean[key]) ** 2 / variance
    terms = -(nu + 1) / 2 * np.log1p(square / nu) - np.log(variance) / 2
    return float(terms.sum()) / max(1.0, len(values) / 3)


@dataclass(frozen=True)
class Gap:
    """How much of the gap is left, against the nominal bench's."""

    total: float  # 1: all of it; 0: none
    # weights, left: of each curve: its weight, and the share of its excess that is left
    weights: Mapping[Key, float]
    left: Mapping[Key, float]

    def of_domain(self, domain: str) -> tuple[float, float]:
        """Weight of a domain, and of what is left of it, over all of the gap at the start."""
        whole = sum(self.weights.values()) or 1.0
        own = [k for k in self.left if statistic_named(k[0]).domain == domain]
        return (
            sum(self.weights.get(k, 0.0) for k in own) / whole,
            sum(self.weights.get(k, 0.0) * self.left[k] for k in own) / whole,
        )


def remaining(
    before: Mapping[Key, Difference], after: Mapping[Key, Difference], where: set[Key]
) -> Gap:
    """The gap that is left of what differed before.

    Every curve that differed (``where``) counts by the square of its significance; of it, the share
    of its excess that is left. What differs only after counts in full.
    """
    weights = {k: sigmas_of(before[k].log_chance) ** 2 for k in where}
    whole = sum(weights.values())
    left = {
        k: float(np.clip(after[k].excess / max(before[k].excess, 1e-12), 0, 2))
        for k in where
        if k in after
    }
    total = sum(weights[k] * left[k] for k in left)
    for key in flagged(after) - where:
        own = sigmas_of(after[key].log_chance) ** 2
        total += own
        left[key] = own / max(whole, 1e-12)
    return Gap(total / whole if whole else 0.0, weights, left)
