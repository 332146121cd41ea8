"""Grade of one case: its diagnosis compared with the truth."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from blind_examination import draw
from blind_examination.draw import Truth
from blind_examination.offsets import AxisError
from blind_examination.parameters import check_parameters
from pixcal.effects import effects

BLAMED = 0.5  # share of the gap above which an absent effect is blamed for most of it
WITHIN = (1, 2, 3)  # allowed deviations of a parameter, in errors
WORST = 3  # number of worst statistics that should include the domain of an effect

# what a grade keeps of a cause, and of a statistic that differs
CLAIM = ("effect", "sigmas", "gap_closed", "p_value")
PLACE = ("domain", "statistic", "set", "place")

Diagnosis = Mapping[str, Any]


@dataclass(frozen=True)
class Grade:
    """Grade of a case."""

    case: str
    part: int
    truth: tuple[str, ...]  # effects in the case
    variant: str  # their laws and strengths
    times: float | None  # strength of the weakest over its threshold
    left_out: str
    verdict: str  # of the diagnosis; `failed` without one
    named: tuple[str, ...]  # causes in their order
    marks: dict[str, bool]  # whether each question of the part was answered right
    why: str  # reason of a wrong answer, or empty
    # claims about each cause: significance of its estimate, share of the gap closed, p-value
    claims: tuple[dict[str, Any], ...] = ()
    # largest differences of data and simulation: domain, statistic, set, place
    worst: tuple[dict[str, str], ...] = ()
    # of true effects that were found: name, true, found, error, and whether it is within one,
    # two and three errors
    parameters: tuple[dict[str, Any], ...] = ()
    # closed, oracle: share of the gap closed by the named causes, and by the true effects with
    # their true parameters
    closed: float | None = None
    oracle: float | None = None
    offsets: tuple[AxisError, ...] = ()  # errors of the offsets along x and y

    @property
    def right(self) -> bool:
        """Whether the answer to the part's first question is right."""
        return next(iter(self.marks.values()))


# questions of each part; the first one decides
QUESTIONS = {
    draw.SECOND_ONE: ("named first", "nothing else named", "explained"),
    draw.SECOND_NOTHING: ("no gap", "no cause claimed"),
    draw.SECOND_PAIR: ("all found, none invented", "all found", "none invented"),
    draw.SECOND_OTHER: ("honest", "not called explained", "nobody blamed for most"),
    draw.ONE: ("named first",),
    draw.NOTHING: ("no cause claimed", "no gap"),
    draw.SEVERAL: ("all found, none invented", "all found", "none invented"),
    draw.LEFT_OUT: ("honest", "not called explained", "nobody blamed for most", "right domain"),
}


def grade(case: str, truth: Truth, diagnosis: Diagnosis | None, error: str = "") -> Grade:
    """Compare ``diagnosis.json`` with the truth; None for a failed one, with its ``error``."""
    variant = ", ".join(f"{d.effect}: {d.variant} {d.strength:.3g}" for d in truth.drawn)
    times = min((d.times for d in truth.drawn if d.times is not None), default=None)
    about = (case, truth.part, truth.names, variant, times, truth.left_out)
    if diagnosis is None:
        marks = dict.fromkeys(QUESTIONS[truth.part], False)
        return Grade(*about, "failed", (), marks, error or "not diagnosed")
    named = tuple(cause["effect"] for cause in diagnosis["causes"])
    answers = _answers(truth, diagnosis, named)
    marks = dict(zip(QUESTIONS[truth.part], answers, strict=True))
    why = "" if answers[0] else _why(truth, diagnosis, named)
    closed = 1 - float(diagnosis["gap"]["after"]) if named else None
    parameters = () if truth.second else tuple(_parameters(truth, diagnosis))
    worst = diagnosis["gap"]["where"][:WORST]
    return Grade(
        *about,
        diagnosis["verdict"],
        named,
        marks,
        why,
        claims=tuple({key: cause.get(key) for key in CLAIM} for cause in diagnosis["causes"]),
        worst=tuple({key: str(one.get(key, "")) for key in PLACE} for one in worst),
        parameters=parameters,
        closed=closed,
    )


def _answers(truth: Truth, diagnosis: Diagnosis, named: Sequence[str]) -> tuple[bool, ...]:
    verdict = diagnosis["verdict"]
    if truth.part == draw.ONE:
        return (named[:1] == truth.names,)
    if truth.part == draw.SECOND_ONE:
        return named[:1] == truth.names, set(named) <= set(truth.names), verdict == "explained"
    if truth.part == draw.NOTHING:
        return not named, verdict == "no gap"
    if truth.part == draw.SECOND_NOTHING:
        return verdict == "no gap", not named
    if truth.part in (draw.SEVERAL, draw.SECOND_PAIR):
        complete, invented = set(truth.names) <= set(named), set(named) - set(truth.names)
        return complete and not invented, complete, not invented
    honest = verdict in ("unexplained", "partly explained")
    blamed = any(cause["gap_closed"] > BLAMED for cause in diagnosis["causes"])
    answers = honest and not blamed, honest, not blamed
    if truth.part == draw.SECOND_OTHER:
        return answers
    # Whether the worst statistics include a domain in which the effect is visible.
    domains = {domain for name in truth.names for domain in effects()[name].domains}
    return *answers, any(one["domain"] in domains for one in diagnosis["gap"]["where"][:WORST])


def _parameters(truth: Truth, diagnosis: Diagnosis) -> list[dict[str, Any]]:
    causes = {cause["effect"]: cause for cause in diagnosis["causes"]}
    rows = []
    for drawn in (drawn for drawn in truth.drawn if drawn.effect in causes):
        found = (causes[drawn.effect][key] for key in ("parameters", "uncertainty"))
        rows += [
            {
                "effect": drawn.effect,
                "name": one.name,
                "true": one.true,
                "found": one.estimate,
                "error": one.error,
                "within": [one.within(errors) for errors in WITHIN],
            }
            for one in check_parameters(drawn.effect, drawn.parameters, *found)
        ]
    return rows


def _why(truth: Truth, diagnosis: Diagnosis, named: Sequence[str]) -> str:
    """Reason of a wrong answer, from the diagnosis."""
    verdict, causes = f"verdict {diagnosis['verdict']!r}", diagnosis["causes"]
    if truth.part in (draw.NOTHING, draw.SECOND_NOTHING):
        reasons = [
            f"{c['effect']} claimed (p = {c['p_value']:.1e}, closes {c['gap_closed']:.2f})"
            for c in causes
        ]
        return "; ".join(reasons) or verdict
    if truth.part in (draw.LEFT_OUT, draw.SECOND_OTHER):
        blamed = [c for c in causes if c["gap_closed"] > BLAMED]
        reasons = [f"{c['effect']} credited with {c['gap_closed']:.2f} of the gap" for c in blamed]
        return "; ".join(reasons) or verdict
    reasons, about = [], {c["effect"]: c for c in diagnosis["candidates"]}
    for name in truth.names:
        if name not in named:
            tried = about.get(name, {})
            significance = f" ({tried['sigmas']:.1f} sigmas)" if "sigmas" in tried else ""
            reasons.append(
                f"{name}{significance}: {tried.get('rejected_because', 'not a candidate')}"
            )
        elif len(truth.names) == 1 and named[0] != name:
            reasons.append(f"{name}: named after {named[0]}")
    invented = [name for name in named if name not in truth.names]
    if invented:
        reasons.append(f"invented: {', '.join(invented)}")
    return "; ".join(reasons if named else [*reasons, verdict])
