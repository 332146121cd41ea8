"""Deviations of an acquisition from the nominal bench, and how forward models change them.

A change is the difference between frames simulated with and without a model. Two draws of
everything random are made. Their mean estimates the change; half their difference is kept too, so
that the contribution of chance can be subtracted from sums of squares.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.arrays import F32, F64, Mask
from pixcal.simulation.deviations import LINEAR, Change, SetDeviations, StackDeviations
from pixcal.simulation.forward import ForwardModel, Stage
from pixcal.simulation.map_deviation import Deviation, common_precision, is_smooth
from pixcal.simulation.replica import Replica

Key = tuple[str | int, str]  # fringe set or number of a stack, and name of its deviation
Draw = dict[Key, NDArray[Any]]

SEEDS = (1, 2)
SCATTER_SEEDS = range(3, 11)  # seeds of the draws that measure the scatter of a change
FRAMES = 4  # calibration frames of an exposure time that are used
MIXED = 64  # frames of a recording that test how a model changes the noise
COMMON = 0.5  # least share common to two draws of a change that is not random
MOMENTS = {"pairs": "residual", "power": "frames"}  # quadratic deviations, and of what they are
# share of a change of frames without light that is no level, up to which it is of whole frames
EVEN = 0.1


@dataclass(frozen=True)
class Response:
    """How the effect of a model appears in the deviations."""

    random: bool  # its change depends on the random numbers, and is zero on average
    mixes: bool  # it correlates the noise of samples
    keys: tuple[Key, ...]  # deviations that it changes


@dataclass(frozen=True)
class Template:
    """Change of deviations: mean of two draws, and half their difference if they differ."""

    mean: Mapping[Key, NDArray[Any]]
    half: Mapping[Key, NDArray[Any]]

    @classmethod
    def of(cls, one: Draw, other: Draw) -> "Template":
        """From two draws; values identical in both are not random."""
        drawn = [k for k in one if one[k] is not other[k]]
        mean = {k: (one[k] + other[k]) / 2 if k in drawn else one[k] for k in one}
        return cls(mean, {k: (one[k] - other[k]) / 2 for k in drawn})

    def only(self, keys: Sequence[Key]) -> "Template":
        """The template of given deviations."""
        return Template(
            *({k: v for k, v in d.items() if k in keys} for d in (self.mean, self.half))
        )

    def slope(self, other: "Template", step: float) -> "Template":
        """Derivative, from this template and ``other``, after a step of a parameter."""
        return Template(
            {k: (v - self.mean[k]) / step for k, v in other.mean.items()},
            {k: (v - self.half[k]) / step for k, v in other.half.items()},
        )


class Changes:
    """Deviations of evidence, and their changes by forward models."""

    def __init__(self, evidence: Evidence) -> None:
        self._evidence, self._replica = evidence, Replica(evidence)
        self._looks: dict[str | int, SetDeviations | StackDeviations] = {
            n: StackDeviations(evidence, stack)
            for n, stack in enumerate(evidence.stacks)
            if stack.kind in ("bias", "dark") and len(stack.adu) >= FRAMES
        }
        self._looks |= {n: SetDeviations(evidence, s) for n, s in evidence.fringes.items()}
        self._plain: dict[str | int, F32] = {}
        self._precisions: dict[tuple[Key, ...], tuple[F64, Mask]] = {}
        flat = np.where(evidence.flat > 0, evidence.flat, 1.0)
        self._flat = np.asarray(flat, float)
        self._per_adu = (evidence.gain / self._flat).astype(np.float32)

    def measured(self, key: Key) -> Deviation:
        """A deviation of the data."""
        return self._looks[key[0]].measured(key[1])

    def product(
        self, keys: Sequence[Key], a: Mapping[Key, NDArray[Any]], b: Mapping[Key, NDArray[Any]]
    ) -> float:
        """Sum of products of changes over their noise, which is correlated between maps."""
        maps = tuple(k for k in keys if k[1] == "maps")
        total = sum(dot(self.measured(k).weight, a[k], b[k]) for k in keys if k not in maps)
        if maps:
            precision, there = self._precision(maps)
            one, other = (np.concatenate([v[k] for k in maps])[:, there] for v in (a, b))
            total += float(np.einsum("ij,in,jn->", precision, one, other, optimize=True))
        return total

    def _precision(self, maps: tuple[Key, ...]) -> tuple[F64, Mask]:
        """Inverse covariance of maps, and the pixels common to all of them."""
        if maps not in self._precisions:
            measured = [self.measured(key) for key in maps]
            value, weight = (
                np.concatenate([getattr(m, name) for m in measured]) for name in ("value", "weight")
            )
            precision = common_precision(np.where(weight > 0, value, np.nan))
            self._precisions[maps] = precision, np.all(weight > 0, axis=0)
        return self._precisions[maps]

    def fits(self, template: Template) -> bool:
        """Whether a template matches these deviations in keys and shapes."""
        return all(
            of in self._looks and self.measured((of, name)).value.shape == value.shape
            for (of, name), value in template.mean.items()
        )

    def response(self, model: ForwardModel) -> Response:
        """How the effect of a model appears in the deviations."""
        every = [(of, name) for of in self._looks for name in LINEAR]
        draws = [self._linear(model, seed, every) for seed in SEEDS]
        keys = [key for key in every if self._is_sound(key, draws[0])]
        draws = [{k: v for k, v in draw.items() if k in keys} for draw in draws]
        random = not self._repeats(*draws)
        if random:
            keys = [
                (n, name) for n in self._looks for name, of in MOMENTS.items() if (n, of) in keys
            ]
        pairs = [(of, "pairs") for of in self._looks]
        mixes = model.acts_at >= Stage.CHARGE and self._repeats(
            *(self._mixed(model, seed, pairs) for seed in SEEDS)
        )
        return Response(random, mixes, tuple(dict.fromkeys([*keys, *(pairs if mixes else ())])))

    def _is_sound(self, key: Key, draw: Draw) -> bool:
        """Whether a change of a deviation is more than a common change of other origin."""
        # Offsets scatter from pixel to pixel in maps. Levels of frames without light drift; they
        # count for a model of whole frames alone.
        of, name = key
        if name == "maps":
            return is_smooth(draw[key], self.measured(key).weight)
        if name != "frames" or of in self._evidence.fringes:
            return True
        uneven, level = (float((draw[of, n] ** 2).mean()) for n in ("residual", "frames"))
        return uneven < EVEN * level

    def _repeats(self, one: Draw, other: Draw) -> bool:
        """Whether most of a change is common to two draws."""
        keys = tuple(one)
        return self.product(keys, one, other) > COMMON * self.product(keys, one, one)

    def template(self, model: ForwardModel, response: Response) -> Template:
        """Change of deviations by a model, given how it shows."""
        linear = [key for key in response.keys if key[1] in LINEAR]
        pairs = [key for key in response.keys if key[1] == "pairs"]
        one = other = self._linear(model, SEEDS[0], linear)
        if response.random:
            one, other = (self._second_moments(model, seed, response.keys) for seed in SEEDS)
        if response.mixes:
            a, b = (self._mixed(model, seed, pairs) for seed in SEEDS)
            one = {**one, **{k: one.get(k, 0) + v for k, v in a.items()}}
            other = {**other, **{k: other.get(k, 0) + v for k, v in b.items()}}
        return Template.of(one, other)

    def draws(self, model: ForwardModel, response: Response) -> Iterator[Draw]:
        """Second moments that single draws of a random model add."""
        for seed in SCATTER_SEEDS:
            yield self._second_moments(model, seed, response.keys)

    def _simulated(self, of: str | int) -> F32:
        if of not in self._plain:
            self._plain[of] = self._replica.simulated_samples(of)
        return self._plain[of]

    def _linear(self, model: ForwardModel, seed: int, keys: Iterable[Key]) -> Draw:
        """Change of linear deviations."""
        names: dict[str | int, list[str]] = {}
        for of, name in keys:
            names.setdefault(of, []).append(name)
        draw: Draw = {}
        e, stacks = self._evidence, range(len(self._evidence.stacks))
        bias = rate = relative = np.zeros(e.good.shape)
        maps = any("maps" in own for own in names.values())
        for of in [n for n in stacks if maps or n in names]:
            samples = self._replica.simulated_samples(of, [model], seed=seed) - self._simulated(of)
            look, stack = self._looks.get(of), e.stacks[of]
            if of in names and isinstance(look, StackDeviations):
                draw |= _named(of, look.change(samples, bias, names[of]))
            mean, seconds = samples.mean(axis=0).astype(float), np.nan_to_num(stack.exptime_s)
            if stack.kind == "bias":
                bias = mean
            elif stack.kind == "dark" and seconds > 0:
                rate = (mean - bias) * e.gain / seconds
            elif stack.kind == "flat":
                light = float(self._simulated(of).mean() - np.median(e.bias)) * e.gain
                relative = (mean - bias) * e.gain - rate * seconds
                relative = relative / self._flat / max(light, 1.0)
        for of in [n for n in e.fringes if n in names]:
            look = self._looks[of]
            assert isinstance(look, SetDeviations)
            samples = self._replica.simulated_samples(of, [model], seed=seed) - self._simulated(of)
            samples *= self._per_adu
            seconds = np.nan_to_num(look.fringes.exptime_s)
            constant = (bias * e.gain + rate * seconds) / self._flat
            draw |= _named(of, look.change(samples, constant, relative, names[of]))
        return draw

    def _second_moments(self, model: ForwardModel, seed: int, keys: Sequence[Key]) -> Draw:
        """Contribution of a random change to quadratic deviations."""
        needed = [(of, MOMENTS[name]) for of, name in keys]
        change = self._linear(model, seed, needed)
        return {
            (of, name): self._looks[of].second_moments(name, change[of, source])
            for (of, name), (_, source) in zip(keys, needed, strict=True)
        }

    def _mixed(self, model: ForwardModel, seed: int, keys: Iterable[Key]) -> Draw:
        """Change of quadratic deviations by the action of the model on the noise of samples."""
        draw: Draw = {}
        for of, name in keys:
            noise = self._replica.simulated_samples(of, noise=True, seed=seed, most=MIXED)
            noise -= self._simulated(of)[: len(noise)]
            other = self._replica.simulated_samples(of, [model], noise=True, seed=seed, most=MIXED)
            other -= self._replica.simulated_samples(of, [model], seed=seed, most=MIXED)
            draw[of, name] = self._looks[of].pairs_between(noise, other, self._per_adu)
        return draw


def _named(of: str | int, change: Change) -> Draw:
    return {(of, name): value for name, value in change.items()}


def dot(weight: NDArray[Any], a: NDArray[Any], b: NDArray[Any]) -> float:
    """Weighted sum of products: within rows in the arrays' type, over rows in float64."""
    rows = (v.reshape(len(v), -1) for v in (weight, a, b))
    return float(np.einsum("tn,tn,tn->t", *rows).sum(dtype=float))
