"""A case: a bench with its effects."""

from typing import Any

import numpy as np

from second_bench.effects import LAWS, Law
from second_bench.model import Bench, stream
from second_bench.ordinary import VARIATIONS, Layout, draw_bench, draw_phases, draw_variations

SCHEMA = "second_bench/truth/1"
ORDINARY = "ordinary"


class CaseError(ValueError):
    """A case that does not exist."""


def make_case(
    case: str, seed: int, layout: Layout, strength: float | None = None, plain: bool = False
) -> tuple[Bench, dict[str, Any]]:
    """A bench with the effects of a case, and the truth; CaseError if there is no such case.

    ``case``: ``ordinary``, ``ordinary/VARIATION``, ``EFFECT``, ``EFFECT/LAW``, or these joined by
    ``+``. ``strength``: from 0 (barely visible) to 1 (strong); by default drawn from the seed.
    ``plain``: without ordinary variations besides the effects.
    """
    chosen: list[tuple[Law, float]] = []
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
    if any(law.varied_phases for law, _ in chosen):
        for run in bench.fringe_runs():
            run.phase = draw_phases("random", run.frames, stream(seed, "phases", run.name))
            bench.notes[run.name]["phases"] = "random"
    effects = []
    for law, size in chosen:
        parameters = law.apply(bench, size, stream(seed, "effect", law.effect)) or {}
        effects.append(
            {
                "effect": law.effect,
                "law": law.name,
                "size": size,
                "unit": law.unit,
                "range": [law.weak, law.strong],
                "parameters": parameters,
                "known": law.known,
                "decidable": law.decidable,
            }
        )
    return bench, {"schema": SCHEMA, "case": case, "seed": seed, "effects": effects}


def _choose(name: str, strength: float | None, rng: np.random.Generator) -> tuple[Law, float]:
    """A law of an effect and its strength, in the unit of the law."""
    effect, _, law = name.partition("/")
    laws = [one for one in LAWS if one.effect == effect]
    if not laws:
        known = ", ".join(dict.fromkeys(one.effect for one in LAWS))
        raise CaseError(f"{name}: no such effect; there are {known}")
    if law and law not in {one.name for one in laws}:
        raise CaseError(f"{name}: laws of {effect} are {', '.join(one.name for one in laws)}")
    of = [one for one in laws if law in ("", one.name)]
    found = of[int(rng.integers(len(of)))]
    share = rng.uniform() if strength is None else strength
    return found, float(found.weak * (found.strong / found.weak) ** share)
