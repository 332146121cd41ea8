"""Draw the cases of an examination: effects, strengths and order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from blind_examination.benches import LAYOUTS, draw_bench
from blind_examination.second import SecondCase, SecondLaw, catalogue
from blind_examination.strengths import STRONGEST, Variant, variants_of
from pixcal.effects import effects
from pixcal.model.bench import Bench

ONE, NOTHING, SEVERAL, LEFT_OUT, SECOND_ONE, SECOND_NOTHING, SECOND_PAIR, SECOND_OTHER = range(1, 9)
# in the order of the table
PARTS = {
    SECOND_ONE: "second bench: one effect",
    SECOND_NOTHING: "second bench: an ordinary bench",
    SECOND_PAIR: "second bench: two effects",
    SECOND_OTHER: "second bench: an effect that pixcal does not know",
    ONE: "self-check: one effect",
    NOTHING: "self-check: nothing",
    SEVERAL: "self-check: two or three effects",
    LEFT_OUT: "self-check: the effect is no candidate",
}
SECOND = (SECOND_ONE, SECOND_NOTHING, SECOND_PAIR, SECOND_OTHER)
# share of the cases of each bench; both benches have equal numbers
SHARES = {
    "second": {SECOND_ONE: 0.55, SECOND_NOTHING: 0.25, SECOND_PAIR: 0.1, SECOND_OTHER: 0.1},
    "own": {ONE: 0.5, NOTHING: 0.16, SEVERAL: 0.17, LEFT_OUT: 0.17},
}
VISIBLE = 0.3  # least strength of the second bench's effects; 0 is barely visible
# least strength over the threshold, except in part 1, which begins at the threshold
CLEAR = 2.0

_TRUTH, _BENCH = 1, 2


@dataclass(frozen=True)
class Drawn:
    """An effect in a case."""

    effect: str
    variant: str
    strength: float
    # strength over the threshold, which is unknown for the second bench
    times: float | None
    parameters: dict[str, Any]  # of the library's effect


@dataclass(frozen=True)
class Truth:
    """Effects in a case, and the effect that a diagnosis may not consider."""

    part: int
    left_out: str  # effect that is not a candidate
    drawn: tuple[Drawn, ...] = ()
    # request to the second bench, if it makes the frames
    second: SecondCase | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the effects."""
        return tuple(d.effect for d in self.drawn)


@dataclass(frozen=True)
class Examination:
    """Cases in the order of their numbers."""

    seed: int
    size: str
    truths: tuple[Truth, ...]
    notes: tuple[str, ...] = field(default=())

    def bench(self, number: int) -> Bench:
        """Bench of a case; its random numbers are independent of those of the truth."""
        return draw_bench(LAYOUTS[self.size], np.random.default_rng([self.seed, _BENCH, number]))


def draw_examination(cases: int, seed: int, size: str, bench: str = "both") -> Examination:
    """Draw the truth of all cases; InputError if the second bench is needed and cannot be run.

    ``size``: one of `LAYOUTS`. ``bench``: simulator of the cases, ``second``, ``own`` or ``both``.
    """
    rng = np.random.default_rng([seed, _TRUTH])
    absent = catalogue()[2] if bench != "own" else ()
    notes = tuple(f"{name} is not installed: laws that need it are left out" for name in absent)
    shares: dict[int, float] = {}
    for whose, own in SHARES.items():
        if bench in (whose, "both"):
            shares |= own
    truths = [
        truth
        for part, count in _counts(cases, shares).items()
        for truth in (_second if part in SECOND else _part)(part, count, size, rng)
    ]
    order = rng.permutation(len(truths))
    return Examination(seed, size, tuple(truths[n] for n in order), notes)


def _counts(cases: int, shares: dict[int, float]) -> dict[int, int]:
    """Number of cases of each part, in proportion, with the largest remainders rounded up."""
    whole = sum(shares.values())
    exact = {part: cases * share / whole for part, share in shares.items()}
    counts = {part: int(value) for part, value in exact.items()}
    by_rest = sorted(exact, key=lambda part: counts[part] - exact[part])
    for part in by_rest[: cases - sum(counts.values())]:
        counts[part] += 1
    return counts


def _part(part: int, count: int, size: str, rng: np.random.Generator) -> Iterator[Truth]:
    turns = _turns(list(variants_of()), rng)
    for number in range(count):
        if part == NOTHING:
            yield Truth(part, _absent((), rng))
            continue
        many = 1 if part != SEVERAL else 3 if number % 3 == 2 else 2
        chosen = _distinct(turns, many)
        least = 1.0 if part == ONE else CLEAR
        drawn = [_drawn(variants_of()[name], size, least, rng) for name in chosen]
        left_out = chosen[0] if part == LEFT_OUT else _absent(chosen, rng)
        yield Truth(part, left_out, tuple(drawn))


def _second(part: int, count: int, _size: str, rng: np.random.Generator) -> Iterator[Truth]:
    """Cases of the second bench: effects in turn, each with a law that frames can show."""
    variations, laws, _ = catalogue()
    of: dict[str, list[SecondLaw]] = {}
    for law in laws:
        if law.decidable and law.known == (part != SECOND_OTHER):
            of.setdefault(law.effect, []).append(law)
    turns, others = _turns(list(of), rng), _turns([f"ordinary/{v}" for v in variations], rng)
    for number in range(count):
        seed, strength = int(rng.integers(1 << 40)), float(rng.uniform(VISIBLE, 1))
        if part == SECOND_NOTHING:
            # Half of them have all variations at once.
            case = next(others) if number % 2 else "ordinary"
            yield Truth(part, _absent((), rng), second=SecondCase(case, seed, strength))
            continue
        chosen = _distinct(turns, 2 if part == SECOND_PAIR else 1)
        laws_drawn = [of[name][int(rng.integers(len(of[name])))] for name in chosen]
        drawn = tuple(
            Drawn(one.effect, f"{one.name}, {one.unit}", one.size(strength), None, {})
            for one in laws_drawn
        )
        case = "+".join(f"{one.effect}/{one.name}" for one in laws_drawn)
        yield Truth(part, _absent(chosen, rng), drawn, SecondCase(case, seed, strength))


def _turns(names: list[str], rng: np.random.Generator) -> Iterator[str]:
    """All names in random order, repeatedly."""
    while True:
        yield from (names[n] for n in rng.permutation(len(names)))


def _distinct(turns: Iterator[str], count: int) -> list[str]:
    chosen: list[str] = []
    while len(chosen) < count:
        name = next(turns)
        if name not in chosen:
            chosen.append(name)
    return chosen


def _absent(present: Sequence[str], rng: np.random.Generator) -> str:
    return str(rng.choice([name for name in effects() if name not in present]))


def _drawn(variants: Sequence[Variant], size: str, least: float, rng: np.random.Generator) -> Drawn:
    variant = variants[int(rng.integers(len(variants)))]
    times = float(np.exp(rng.uniform(np.log(least), np.log(STRONGEST))))
    strength = times * variant.threshold(size)
    return Drawn(variant.effect, variant.strength, strength, times, variant.make(strength, rng))
