"""Expectation of every curve for a bench, from simulations with different random numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr

from pixcal.estimators.test_statistics import DETECTOR, Curve, Key, Statistic, known_statistics
from pixcal.model.arrays import F64

STRAIGHT = 10.0  # standard deviations beyond which they count by their logarithm
_FARTHEST = 30.0  # largest value of a signature, over `STRAIGHT`, whose logarithm is undone
_PREFIX, _INFIX = "estimate_of_", "_in_"
Curves = Mapping[Key, Curve]

TOLERANCE = 0.05  # relative error of a simulated effect
# standard deviations from which a value of a curve has changed, independently of the others
STANDS_OUT = 2.5


def signature_key(effect: str, domain: str) -> Key:
    """Key of an effect's signature in one domain."""
    return f"{_PREFIX}{effect}{_INFIX}{domain}", DETECTOR


def signature_curve(significance: float) -> Curve:
    """The curve, of one value."""
    size = abs(significance)
    if size > STRAIGHT:
        size = STRAIGHT * (1 + float(np.log(size / STRAIGHT)))
    return Curve.numbered([float(np.copysign(size, significance))])


def is_signature(key: Key) -> bool:
    """Whether a curve is the detection significance of an effect."""
    return key[0].startswith(_PREFIX)


def straight_significance(values: F64) -> F64:
    """Significances of signatures without the logarithm of `signature_curve`."""
    size = np.clip(np.abs(values), STRAIGHT, _FARTHEST * STRAIGHT)
    far = np.copysign(STRAIGHT * np.exp(size / STRAIGHT - 1), values)
    return np.asarray(np.where(np.abs(values) > STRAIGHT, far, values))


def statistic_named(name: str) -> Statistic:
    """A statistic of the test statistics, or the signature of an effect."""
    if name in known_statistics():
        return known_statistics()[name]
    effect, _, domain = name.removeprefix(_PREFIX).rpartition(_INFIX)
    title = f"detection significance of {effect}"
    return Statistic(
        name, title, domain, "significance", "σ", "", "linear", False, False, FLOOR, lambda _: None
    )


FLOOR = 0.7  # of a significance, by chance, at least


def scaled(values: F64, usual: F64) -> F64:
    """Mean squares over their usual size, on a scale where chance is nearly normal."""
    ratio = values / np.maximum(usual, 1e-300)
    low = 3 * (np.cbrt(np.minimum(ratio, 1.0)) - 1)
    return np.asarray(np.where(ratio > 1, np.log(np.maximum(ratio, 1.0)), low))


@dataclass(frozen=True)
class Reference:
    """Simulations of the nominal bench with different seeds, on their scales."""

    # median (n,) of each curve that is a power; None for the others
    usual: Mapping[Key, F64 | None]
    values: Mapping[Key, F64]  # (simulation, n) of each curve, in the order of the seeds
    # effective number of independent values of each curve, `independent_values`
    independent: Mapping[Key, float]

    @classmethod
    def of(cls, simulated: Sequence[Curves]) -> "Reference":
        """From simulations; only curves that all of them have."""
        keys = [k for k in simulated[0] if all(k in s for s in simulated)]
        keys = [k for k in keys if len({len(s[k].value) for s in simulated}) == 1]
        usual: dict[Key, F64 | None] = {}
        values = {}
        for key in keys:
            stack = np.stack([s[key].value for s in simulated])
            power = statistic_named(key[0]).kind == "power"
            usual[key] = np.median(stack, axis=0) if power else None
            scale = usual[key]
            values[key] = stack if scale is None else scaled(stack, scale)
        floors = {key: statistic_named(key[0]).floor for key in values}
        independent = {key: independent_values(v, floors[key]) for key, v in values.items()}
        return cls(usual, values, independent)

    def on_scale(self, curves: Curves) -> dict[Key, F64]:
        """Curves on the scales of the reference, where it has them."""
        rescaled = {}
        for key, usual in self.usual.items():
            curve = curves.get(key)
            if curve is not None and len(curve.value) == self.values[key].shape[1]:
                rescaled[key] = curve.value if usual is None else scaled(curve.value, usual)
        return rescaled


@dataclass(frozen=True)
class Expectation:
    """Expectation of every curve for a bench, nominal or with effects."""

    # mean, variance: (n,) on the reference's scales; the variance of a value of the data about the
    # mean
    mean: Mapping[Key, F64]
    variance: Mapping[Key, F64]
    noise: Mapping[Key, F64]  # variance (n,) of the nominal bench alone
    independent: Mapping[Key, float]  # as in the reference
    dof: int


def expect_nominal(reference: Reference) -> Expectation:
    """Expectation for the nominal bench."""
    mean, variance, noise, count = {}, {}, {}, 2
    for key, values in reference.values.items():
        count = len(values)
        noise[key] = _variance(values, statistic_named(key[0]).floor)
        mean[key] = values.mean(axis=0)
        variance[key] = noise[key] * (1 + 1 / count)
    return Expectation(mean, variance, noise, reference.independent, count - 1)


def expect_with(
    reference: Reference,
    simulated: Sequence[Curves],
    error: float = 0.0,
    beside: Expectation | None = None,
) -> Expectation:
    """Expectation for a bench with effects, from simulations with the reference's first seeds.

    ``error``: relative error of the strength of what is new on top of ``beside`` (default: the
    nominal bench).
    """
    nominal = expect_nominal(reference)
    scaled_ones = [reference.on_scale(s) for s in simulated]
    pairs: dict[Key, tuple[F64, F64]] = {}
    for key, values in reference.values.items():
        # An estimate may fail in a few simulations: the others are used.
        having = [n for n, s in enumerate(scaled_ones) if key in s]
        if 2 * len(having) > len(simulated):
            pairs[key] = np.stack([scaled_ones[n][key] for n in having]), values[having]
    mean, variance = dict(nominal.mean), dict(nominal.variance)
    usual = _usual_scatter(pairs, nominal)
    for key, (stack, same_seeds) in pairs.items():
        change, count, noise = stack - same_seeds, len(stack), nominal.noise[key]
        paired = change.var(axis=0, ddof=1) if count > 1 else usual * noise
        # Variance not shared between equal seeds, over the noise: 2 if none is shared.
        apart = min(float(np.mean(paired / noise)), 2.0)
        shift = change.mean(axis=0)
        certain = _certain(shift, apart * noise / count)
        mean[key] = nominal.mean[key] + certain * shift
        added = mean[key] - (beside or nominal).mean[key]
        more = (TOLERANCE * certain * shift) ** 2 + (error * added) ** 2 + certain * paired / count
        if count > 1:
            # Scatter added by the effects, beyond the sampling error of few seeds.
            chance = noise * np.sqrt(4 * apart * (1 - apart / 4) / (count - 1))
            excess = stack.var(axis=0, ddof=1) - same_seeds.var(axis=0, ddof=1) - chance
            more += np.maximum(excess, 0)
        variance[key] = nominal.variance[key] + more
    return replace(nominal, mean=mean, variance=variance)


def _usual_scatter(pairs: Mapping[Key, tuple[F64, F64]], nominal: Expectation) -> float:
    """Variance of chance changes over the noise, from most curves."""
    # Effects on the light change the noise of every sample a little, and so all curves.
    sizes = [
        float(np.mean((own - same) ** 2 / nominal.noise[key])) for key, (own, same) in pairs.items()
    ]
    return min(float(np.median(sizes)), 2.0) if sizes else 0.0


def _certain(shift: F64, chance: F64) -> F64:
    """Share (n,) of a curve's change that is due to effects (positive-part James-Stein)."""
    # For the whole curve, and for single values that are significant.
    squares = shift**2 / np.maximum(chance, 1e-300)
    whole = max(1 - 1 / max(float(np.mean(squares)), 1e-300), 0.0)
    return np.maximum(whole, 1 - STANDS_OUT**2 / np.maximum(squares, STANDS_OUT**2))


def _variance(values: F64, floor: float) -> F64:
    """Variance (n,), shrunk towards that of the curve so that none is tiny by chance."""
    scatter = values.var(axis=0, ddof=1)
    rounding = (1e-9 * np.abs(values).max(axis=0)) ** 2
    leaning = 0.9 * scatter + 0.1 * np.median(scatter) + rounding + 1e-300
    return np.asarray(np.maximum(leaning, floor**2))


def independent_values(values: F64, floor: float = 0.0) -> float:
    """Effective number of independent values of a curve, for its least likely value."""
    # Each simulation (simulation, n) is compared with the others. For the least p-value u of n,
    # -log(1 - u) has an exponential distribution of mean 1 / n, whose likelihood gives n.
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
