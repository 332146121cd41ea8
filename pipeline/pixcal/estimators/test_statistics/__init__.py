"""Test statistics that compare data and simulation, by domain or by kind of frame.

A statistic is a function of an acquisition's evidence, marked by `statistic`; `known_statistics`
collects all in these files. It gives a short curve: values with the same meaning in every
acquisition of the same size, measured or simulated.
"""

import importlib
import pkgutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from inspect import signature
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics.fringe_set_data import FringeSetData
from pixcal.model.arrays import F64

# replaces the name of a set where a curve is of the detector or of several sets
DETECTOR = "detector"


@dataclass(frozen=True)
class Curve:
    """Values of a statistic."""

    x: F64  # (n,)
    value: F64  # (n,) in the statistic's unit; its square where the statistic is a power

    @classmethod
    def numbered(cls, values: ArrayLike) -> Self:
        """Values at x = 0, 1, ...; none for an empty sequence."""
        value = np.asarray(values, float)
        return cls(np.arange(len(value), dtype=float), value)


Key = tuple[str, str]  # name of a statistic and of the fringe set (or `DETECTOR`)


@dataclass(frozen=True)
class Statistic:
    """A test statistic."""

    name: str
    title: str
    domain: str  # `space`, `time`, `intensity` or `noise`
    quantity: str  # of the values; for a power, of their roots
    unit: str  # of the quantity; empty where it is a ratio
    x_label: str
    kind: str  # `linear`, or `power`: mean squares, which are compared by their logarithms
    of_set: bool  # uses one fringe set; else all of the evidence,
    of_all: bool  # or all fringe sets together
    floor: float  # least standard deviation by chance, as simulations may all be equal
    # from the `FringeSetData` of a set or of all sets, or `Evidence`; None where data are missing
    measure: Callable[[Any], Curve | None]


def statistic(
    domain: str,
    title: str,
    quantity: str,
    *,
    unit: str = "",
    x: str = "",
    power: bool = False,
    floor: float = 0.0,
) -> Callable[[Callable[[Any], Curve | None]], Statistic]:
    """Mark a function of `FringeSetData`, those of all sets, or `Evidence` as a statistic."""

    def mark(measure: Callable[[Any], Curve | None]) -> Statistic:
        *_, data = signature(measure).parameters.values()
        of_set, of_all = (
            data.annotation is FringeSetData,
            data.annotation == Sequence[FringeSetData],
        )
        name, kind = getattr(measure, "__name__", ""), "power" if power else "linear"
        return Statistic(
            name, title, domain, quantity, unit, x, kind, of_set, of_all, floor, measure
        )

    return mark


def family(
    name: str, members: Sequence[tuple[str, ...]], *texts: str, **options: Any
) -> Callable[[Callable[[Any, Any], Curve | None]], tuple[Statistic, ...]]:
    """Mark a function of a word and data as a statistic for each of several words.

    Texts and options are as in `statistic`; ``{0}`` in them is the word, ``{1}`` ... those that
    follow it in ``members``. An option may be a mapping by the word.
    """

    def filled(text: Any, words: tuple[str, ...]) -> Any:
        if isinstance(text, Mapping):
            return text[words[0]]
        return text.format(*words) if isinstance(text, str) else text

    def mark(measure: Callable[[Any, Any], Curve | None]) -> tuple[Statistic, ...]:
        made = []
        for words in members:
            named = {key: filled(option, words) for key, option in options.items()}
            one = statistic(*(filled(text, words) for text in texts), **named)
            made.append(replace(one(partial(measure, words[0])), name=filled(name, words)))
        return tuple(made)

    return mark


@cache
def known_statistics() -> Mapping[str, Statistic]:
    """All statistics, by name."""
    by_name: dict[str, Statistic] = {}
    for module in pkgutil.iter_modules(__path__):
        contents = vars(importlib.import_module(f"{__name__}.{module.name}"))
        for value in contents.values():
            for one in value if isinstance(value, tuple) else (value,):
                if isinstance(one, Statistic):
                    by_name[one.name] = one
    return by_name


def measure(evidence: Evidence) -> dict[Key, Curve]:
    """Every statistic for which an acquisition has the frames."""
    curves: dict[Key, Curve] = {}
    sets = {name: FringeSetData(fringes, evidence) for name, fringes in evidence.fringes.items()}
    every: tuple[tuple[str, Any], ...] = ((DETECTOR, tuple(sets.values())),)
    for name, one in known_statistics().items():
        whole = every if one.of_all else ((DETECTOR, evidence),)
        for of, what in sets.items() if one.of_set else whole:
            curve = one.measure(what)
            if curve is not None and len(curve.value) and np.isfinite(curve.value).all():
                curves[name, of] = curve
    return curves
