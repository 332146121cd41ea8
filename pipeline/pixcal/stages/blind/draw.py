"""The cases of an examination: which effects, how strong, in which order."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any

import numpy as np

from pixcal.effects import effects
from pixcal.model.bench import Bench
from pixcal.stages.blind.benches import LAYOUTS, draw_bench
from pixcal.stages.blind.elsewhere import FOREIGN, galsim_is_there
from pixcal.stages.blind.strengths import STRONGEST, Way, ways_of

ONE, NOTHING, SEVERAL, LEFT_OUT, ELSEWHERE = range(1, 6)
PARTS = {
    ONE: "one effect",
    NOTHING: "nothing",
    SEVERAL: "two or three effects",
    LEFT_OUT: "the effect is no candidate",
    ELSEWHERE: "somebody else's effects",
}
SHARES = {ONE: 0.4, NOTHING: 0.15, SEVERAL: 0.15, LEFT_OUT: 0.15, ELSEWHERE: 0.15}
"""Of the cases."""
CLEAR = 2.0
"""Times the threshold that effects are at least, but for part 1, which begins at the threshold."""
OTHERS_OF_NOTHING = 3
"""Every third case without an effect is made by the other simulator."""

_TRUTH, _BENCH = 1, 2


@dataclass(frozen=True)
class Drawn:
    """An effect in a case.

    Attributes
    ----------
    effect, way : str
    strength, times : float
        And how many times the threshold that is.
    parameters : dict
        Of the library's effect; of somebody else's those that mean the same.
    """

    effect: str
    way: str
    strength: float
    times: float
    parameters: dict[str, Any]


@dataclass(frozen=True)
class Truth:
    """What is in a case, and what a diagnosis may not consider.

    Attributes
    ----------
    part : int
    left_out : str
        Effect that is no candidate.
    drawn : tuple of Drawn
    elsewhere : bool
        Whether the other simulator makes the frames.
    """

    part: int
    left_out: str
    drawn: tuple[Drawn, ...] = ()
    elsewhere: bool = False

    @property
    def names(self) -> tuple[str, ...]:
        """Of the effects."""
        return tuple(d.effect for d in self.drawn)


@dataclass(frozen=True)
class Examination:
    """Cases in the order of their numbers.

    Attributes
    ----------
    seed : int
    size : str
    truths : tuple of Truth
    notes : tuple of str
    """

    seed: int
    size: str
    truths: tuple[Truth, ...]
    notes: tuple[str, ...] = field(default=())

    def bench(self, number: int) -> Bench:
        """Bench of a case; its random numbers have nothing to do with those of the truth."""
        rng = np.random.default_rng([self.seed, _BENCH, number])
        return draw_bench(LAYOUTS[self.size], rng)


def draw_examination(cases: int, seed: int, size: str) -> Examination:
    """Draw the truth of all cases.

    Parameters
    ----------
    cases : int
    seed : int
    size : str
        One of `LAYOUTS`.
    """
    rng = np.random.default_rng([seed, _TRUTH])
    there = galsim_is_there()
    notes = () if there else ("GalSim is not installed: part 5 is left out",)
    counts = _counts(cases, {p: s for p, s in SHARES.items() if p != ELSEWHERE or there})
    truths = [truth for part, count in counts.items() for truth in _part(part, count, size, rng)]
    order = rng.permutation(len(truths))
    return Examination(seed, size, tuple(truths[n] for n in order), notes)


def _counts(cases: int, shares: dict[int, float]) -> dict[int, int]:
    """Cases of each part: in proportion, the largest remainders rounded up."""
    whole = sum(shares.values())
    exact = {part: cases * share / whole for part, share in shares.items()}
    counts = {part: int(value) for part, value in exact.items()}
    by_rest = sorted(exact, key=lambda part: counts[part] - exact[part])
    for part in by_rest[: cases - sum(counts.values())]:
        counts[part] += 1
    return counts


def _part(part: int, count: int, size: str, rng: np.random.Generator) -> Iterator[Truth]:
    names = list(FOREIGN if part == ELSEWHERE else ways_of())
    turns = _turns(names, rng)
    for number in range(count):
        if part == NOTHING:
            other = number % OTHERS_OF_NOTHING == OTHERS_OF_NOTHING - 1
            yield Truth(part, _innocent((), rng), elsewhere=other)
            continue
        many = 1 if part != SEVERAL else 3 if number % 3 == 2 else 2
        chosen = _distinct(turns, many)
        least = 1.0 if part == ONE else CLEAR
        if part == ELSEWHERE:
            drawn = [_foreign(name, size, rng) for name in chosen]
        else:
            drawn = [_drawn(_any(ways_of()[name], rng), size, least, rng) for name in chosen]
        left_out = chosen[0] if part == LEFT_OUT else _innocent(chosen, rng)
        yield Truth(part, left_out, tuple(drawn), part == ELSEWHERE)


def _turns(names: list[str], rng: np.random.Generator) -> Iterator[str]:
    """All names in some order, again and again, so that none is left out for long."""
    while True:
        yield from (names[n] for n in rng.permutation(len(names)))


def _distinct(turns: Iterator[str], count: int) -> list[str]:
    chosen: list[str] = []
    while len(chosen) < count:
        name = next(turns)
        if name not in chosen:
            chosen.append(name)
    return chosen


def _innocent(guilty: Sequence[str], rng: np.random.Generator) -> str:
    return str(rng.choice([name for name in effects() if name not in guilty]))


def _any(ways: Sequence[Way], rng: np.random.Generator) -> Way:
    return ways[int(rng.integers(len(ways)))]


def _drawn(way: Way, size: str, least: float, rng: np.random.Generator) -> Drawn:
    times = float(np.exp(rng.uniform(np.log(least), np.log(STRONGEST))))
    strength = times * way.threshold(size)
    made = way.make(strength, rng)
    return Drawn(way.effect, way.strength, strength, times, made)


@cache
def _foreign_ways() -> dict[str, Way]:
    """The way of the library's own that each effect of GalSim is measured against."""
    return {name: ways_of()[name][0] for name in FOREIGN}


def _foreign(name: str, size: str, rng: np.random.Generator) -> Drawn:
    way = _foreign_ways()[name]
    times = float(np.exp(rng.uniform(np.log(CLEAR), np.log(STRONGEST))))
    strength = times * way.threshold(size)
    if name == "quantisation":
        strength = float(np.ceil(strength))
    return Drawn(name, f"GalSim {FOREIGN[name]}", strength, times, {})
