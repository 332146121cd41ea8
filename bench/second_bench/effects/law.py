"""Effects by name, each with its possible laws."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from second_bench.model import Bench

Apply = Callable[[Bench, float, np.random.Generator], dict[str, Any]]


@dataclass(frozen=True)
class Law:
    """One law of an effect.

    Attributes
    ----------
    effect, name : str
        The effect's name is pixcal's, if pixcal has the effect.
    weak, strong : float
        Sizes at strengths 0 and 1.
    unit : str
        Of the size.
    apply : callable
        Changes a bench by a size; returns further drawn values.
    known : bool
        Whether pixcal has this effect.
    decidable : bool
        Whether frames of the bench can show it at all.
    varied_phases : bool
        Whether it is detectable only if the phase step differs from frame to frame.
    needs : str
        Package that it needs besides HCIPy and GalSim.
    """

    effect: str
    name: str
    weak: float
    strong: float
    unit: str
    apply: Apply
    known: bool = True
    decidable: bool = True
    varied_phases: bool = False
    needs: str = ""


LAWS: list[Law] = []


def law(
    effect: str, name: str, weak: float, strong: float, unit: str, **more: Any
) -> Callable[[Apply], Apply]:
    """Register a law in `LAWS`."""

    def entered(apply: Apply) -> Apply:
        LAWS.append(Law(effect, name, weak, strong, unit, apply, **more))
        return apply

    return entered


def laws_of(effect: str) -> list[Law]:
    """Laws of an effect; none if there is no such effect."""
    return [one for one in LAWS if one.effect == effect]
