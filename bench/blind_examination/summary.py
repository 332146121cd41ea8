"""Counts over the graded cases of an examination: parts, effects, maps, confusion."""

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.stats import binomtest

from blind_examination import draw
from blind_examination.grade import QUESTIONS, WITHIN, Grade
from blind_examination.offsets import AXES, AxisError

NOBODY = "nothing"
TWICE = 2.0
FROM_TWICE = "named first, from twice the threshold"
PLACE = "right place, by the true effect"
NEAR = 0.05  # by which the share closed may differ from the oracle's
# shares that the diagnosis is to reach
TARGETS = {
    (draw.SECOND_ONE, "named first"): 0.95,
    (draw.SECOND_ONE, "nothing else named"): 0.95,
    (draw.SECOND_ONE, "explained"): 0.85,
    (draw.SECOND_NOTHING, "no gap"): 0.95,
    (draw.SECOND_OTHER, "honest"): 0.9,
    (draw.ONE, FROM_TWICE): 0.95,
    (draw.NOTHING, "no cause claimed"): 0.95,
    (draw.SEVERAL, "pairs: both found"): 0.85,
    (draw.LEFT_OUT, "honest"): 0.9,
}
# Cramér-Rao bounds that the median error of corrected maps is to be at most, where an effect biases
# them
BOUNDS = 1.3


def summary(grades: Sequence[Grade]) -> dict[str, Any]:
    """Counts of every part, with intervals and targets, and the confusion of causes."""
    parts = {}
    for part, title in draw.PARTS.items():
        own = [g for g in grades if g.part == part]
        if own:
            questions = {q: _count(g.marks[q] for g in own) for q in QUESTIONS[part]}
            questions |= _more_questions(part, own)
            for question, count in questions.items():
                target = TARGETS.get((part, question))
                if target is not None:
                    count |= {"target": target}
            parts[str(part)] = {"title": title, "cases": len(own), "questions": questions}
    one = [g for g in grades if g.part == draw.ONE]
    second = [g for g in grades if g.part == draw.SECOND_ONE]
    return {
        "cases": [asdict(g) | {"right": g.right} for g in grades],
        "parts": parts,
        "confusion": confusion(grades),
        "second": {"effects": _by_effect(second), "maps": _of_maps(second)},
        "effects": _by_effect(one),
        "medians": {
            "closed": median(g.closed for g in one),
            "oracle": median(g.oracle for g in one),
        },
        "maps": _of_maps(one),
    }


def _more_questions(part: int, own: Sequence[Grade]) -> dict[str, dict[str, Any]]:
    if part == draw.ONE:
        return {
            FROM_TWICE: _count(g.right for g in own if _clear(g)),
            **{
                f"parameters within {errors} sigma": _count(
                    p["within"][n] for g in own for p in g.parameters
                )
                for n, errors in enumerate(WITHIN)
            },
            "share of the gap closed as by the true effects": _count(
                abs(g.closed - g.oracle) <= NEAR
                for g in own
                if g.closed is not None and g.oracle is not None
            ),
        }
    if part == draw.SEVERAL:
        pairs = [g for g in own if len(g.truth) == 2]
        return {"pairs: both found": _count(g.marks["all found"] for g in pairs)}
    if part == draw.LEFT_OUT:
        return {PLACE: _count(g.marks[PLACE] for g in own if PLACE in g.marks)}
    return {}


def _clear(graded: Grade) -> bool:
    """Whether the weakest effect has twice its threshold."""
    return graded.times is not None and graded.times >= TWICE


def _count(answers: Iterable[bool]) -> dict[str, Any]:
    """Number of right answers, of all, with its 95 % interval (Clopper and Pearson 1934)."""
    given = list(answers)
    right, of = sum(given), len(given)
    if not of:
        return {"right": 0, "of": 0, "share": None, "interval": None}
    interval = binomtest(right, of).proportion_ci(0.95, method="exact")
    return {
        "right": right,
        "of": of,
        "share": right / of,
        "interval": [float(interval.low), float(interval.high)],
    }


def median(values: Iterable[float | None]) -> float | None:
    """Median of the known values; None without any."""
    known = [v for v in values if v is not None]
    return float(np.median(known)) if known else None


def confusion(grades: Sequence[Grade]) -> dict[str, dict[str, int]]:
    """Of every effect that is alone in a case and a candidate, the causes named first."""
    table: dict[str, dict[str, int]] = {}
    for g in grades:
        if len(g.truth) > 1 or g.left_out in g.truth:
            continue
        true = g.truth[0] if g.truth else NOBODY
        silent = true if true == NOBODY and g.right else g.verdict
        first = g.named[0] if g.named else silent
        row = table.setdefault(true, {})
        row[first] = row.get(first, 0) + 1
    return {name: dict(sorted(row.items())) for name, row in sorted(table.items())}


def _by_effect(grades: Sequence[Grade]) -> dict[str, dict[str, Any]]:
    """Of every effect: named first, below and above twice the threshold too, and the maps."""
    table = {}
    for name in sorted({g.truth[0] for g in grades}):
        those = [g for g in grades if g.truth[0] == name]
        table[name] = {
            "below_twice": _count(g.right for g in those if not _clear(g)),
            "from_twice": _count(g.right for g in those if _clear(g)),
            "right": _count(g.right for g in those),
            "closed": median(g.closed for g in those),
            "offsets": {
                axis: {
                    "before": median(one.before for one in _along(those, axis)),
                    "after": median(one.after for one in _along(those, axis)),
                }
                for axis in AXES
            },
        }
    return table


def _along(grades: Iterable[Grade], axis: str) -> list[AxisError]:
    return [one for g in grades for one in g.offsets if one.axis == axis]


def _of_maps(grades: Sequence[Grade]) -> dict[str, Any]:
    """Errors of the offsets over the bound, medians: of all maps, and of those that are biased."""
    errors = [one for axis in AXES for one in _along(grades, axis)]
    facts: dict[str, Any] = {"target": BOUNDS}
    for name, chosen in (("all", errors), ("biased", [one for one in errors if one.biased])):
        facts[name] = {
            "maps": len(chosen),
            "before": median(one.before for one in chosen),
            "after": median(one.after for one in chosen),
            "within_target": _count(one.after <= BOUNDS for one in chosen),
        }
    return facts
