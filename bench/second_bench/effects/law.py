"""Effects by name, each with its possible laws."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from second_bench.model import Bench

Drawn = dict[str, Any]
Apply = Callable[[Bench, float, np.random.Generator], Drawn | None]


@dataclass(frozen=True)
class Law:
    """One law of an effect."""

    effect: str  # as pixcal calls it, if pixcal has it
    name: str
    weak: float  # weak, strong: sizes at strengths 0 and 1
    strong: float
    unit: str  # of the size
    apply: Apply  # changes a bench by a size; returns further drawn values, if any
    known: bool = True  # whether pixcal has this effect
    decidable: bool = True  # whether frames of the bench can show it at all
    varied_phases: bool = False  # whether it shows only if phase steps differ from frame to frame
    needs: str = ""  # package that it needs besides HCIPy and GalSim


LAWS: list[Law] = []


def law(
    effect: str, name: str, weak: float, strong: float, unit: str, **more: Any
) -> Callable[[Apply], Apply]:
    """Register a law in `LAWS`."""

    def entered(apply: Apply) -> Apply:
        LAWS.append(Law(effect, name, weak, strong, unit, apply, **more))
        return apply

    return entered
