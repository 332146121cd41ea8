"""A case: a bench with its effects."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from second_bench.effects import LAWS, Law, laws_of
from second_bench.model import Bench, stream
from second_bench.ordinary import VARIATIONS, Layout, draw_bench, draw_phases, draw_variations

SCHEMA = "second_bench/truth/1"
ORDINARY = "ordinary"


class CaseError(ValueError):
    """A case that does not exist."""


@dataclass(frozen=True)
class Chosen:
    """A law of an effect and its strength, in the unit of the law."""

    law: Law
    size: float


def make_case(
    case: str, seed: int, layout: Layout, strength: float | None = None, plain: bool = False
) -> tuple[Bench, dict[str, Any]]:
    """A bench with the effects of a case, and the truth; CaseError if there is no such case.

    ``case``: ``ordinary``, ``ordinary/VARIATION``, ``EFFECT``, ``EFFECT/LAW``, or these joined by
    ``+``. ``strength``: from 0 (barely visible) to 1 (strong); by default drawn from the seed.
    ``plain``: without ordinary variations besides the effects.
    """
    chosen: list[Chosen] = []
    varied = set() if plain else draw_variations(seed)
    if case.partition("/")[0] == ORDINARY:
        only = case.partition("/")[2]
        if only and only not in VARIATIONS:
            raise CaseError(f"{case}: variations of a bench are {', '.join(VARIATIONS)}")
        varied = {only} if only else varied
    else:
        rng = stream(seed, "effects")
        chosen = [_choose(name, strength, rng) for name in case.split("+")]
    bench = draw_bench(layout, seed, varied)
    if any(c.law.varied_phases for c in chosen):
        for run in bench.fringe_runs():
            run.phase = draw_phases("random", run.frames, stream(seed, "phases", run.name))
            bench.notes[run.name]["phases"] = "random"
    effects = []
    for c in chosen:
        parameters = c.law.apply(bench, c.size, stream(seed, "effect", c.law.effect))
        effects.append(
            {
                "effect": c.law.effect,
                "law": c.law.name,
                "size": c.size,
                "unit": c.law.unit,
                "range": [c.law.weak, c.law.strong],
                "parameters": parameters,
                "known": c.law.known,
                "decidable": c.law.decidable,
            }
        )
    return bench, {"schema": SCHEMA, "case": case, "seed": seed, "effects": effects}


def _choose(name: str, strength: float | None, rng: np.random.Generator) -> Chosen:
    effect, _, law = name.partition("/")
    laws = laws_of(effect)
    if not laws:
        known = ", ".join(dict.fromkeys(one.effect for one in LAWS))
        raise CaseError(f"{name}: no such effect; there are {known}")
    if law and law not in {one.name for one in laws}:
        raise CaseError(f"{name}: laws of {effect} are {', '.join(one.name for one in laws)}")
    of = [one for one in laws if law in ("", one.name)]
    found = of[int(rng.integers(len(of)))]
    share = rng.uniform() if strength is None else strength
    return Chosen(found, float(found.weak * (found.strong / found.weak) ** share))
