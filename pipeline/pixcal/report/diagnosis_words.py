"""A diagnosis in words: the verdict, shares and chances."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pixcal.report.contents import DiagnosisContents
from pixcal.report.text import number

# what `curves.json` has for the name of a set where a curve is of no single set
DETECTOR = "detector"


def percent(value: float) -> str:
    """A share in per cent, to two digits or a hundredth of a per cent."""
    return f"{number(round(100 * float(value), 2), 2)}\u00a0%"


def with_interval(value: float, ends: Sequence[float]) -> str:
    """A share and its 90 % interval, in per cent."""
    low, high = (number(round(100 * float(v), 2), 2) for v in ends)
    return f"{percent(value)} [{low}, {high}]"


def residual_gap(gap: Mapping[str, Any]) -> str:
    """Share of the gap that remains, with its interval."""
    low, high = (number(round(100 * float(v), 2), 2) for v in gap["interval"])
    return f"residual gap is {percent(gap['after'])} (90\u00a0% interval {low} to {high}\u00a0%)"


def listed(names: Iterable[str], last: str = "and") -> str:
    """Names as a list within a sentence."""
    *first, end = names
    return f"{', '.join(first)} {last} {end}" if first else end


def effect_title(diagnosis: DiagnosisContents, name: str) -> str:
    """An effect in a few words and its name: own effects are known by the causes alone."""
    given = {c["effect"]: c["title"] for c in diagnosis.facts["causes"]}
    title = given.get(name) or diagnosis.titles.get(name)
    return f"{title} ({name})" if title else name


def level(diagnosis: DiagnosisContents) -> str:
    """Severity of a verdict; causes that were identified may ask for something to be done."""
    verdict = diagnosis.facts["verdict"]
    if verdict == "unexplained":
        return "bad"
    settled = verdict == "no gap" or (verdict == "explained" and diagnosis.settled)
    return "good" if settled else "check"


def answer(diagnosis: DiagnosisContents) -> str:
    """The verdict as one sentence."""
    facts = diagnosis.facts
    gap, verdict = facts["gap"], facts["verdict"]
    tested = facts.get("statistics", len(diagnosis.curves))
    count = sum(bool(c["in_gap"]) for c in diagnosis.curves)
    if verdict == "no gap":
        return (
            f"No gap: {'' if _shared(facts) else 'on held-out frames, '}none of {tested} "
            "statistics differs significantly from the nominal simulation."
        )
    where = _main_domain(gap, residual=False)
    if verdict == "unexplained":
        return (
            f"Unexplained: the data differ from the nominal simulation in {count} of {tested} "
            f"statistics{where}. None of the {len(considered(facts))} effects considered "
            "closes the gap."
        )
    causes = listed(effect_title(diagnosis, c["effect"]) for c in facts["causes"])
    one = len(facts["causes"]) == 1
    left, held_out = residual_gap(gap), "" if _shared(facts) else ", measured on held-out frames"
    if verdict == "explained":
        return (
            f"Explained: {causes} account{'s' if one else ''} for the differences between the "
            f"data and the nominal simulation, found in {count} of {tested} statistics. The "
            f"{left}{held_out}."
        )
    return (
        f"{verdict[:1].upper()}{verdict[1:]}: {causes} close{'s' if one else ''} "
        f"{percent(1 - gap['after'])} of the gap between the data and the nominal simulation. The "
        f"{left}{_main_domain(gap, residual=True)}{held_out}."
    )


def considered(facts: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Candidates, without those that show in fringes alone where there are none."""
    sets = facts.get("looked_at", {}).get("sets", True)
    return [c for c in facts["candidates"] if sets or "fringes would" not in c["rejected_because"]]


def _shared(facts: Mapping[str, Any]) -> bool:
    """Whether some frames were too few to fit effects on one half and test them on the other."""
    return bool(facts.get("looked_at", {}).get("shared"))


def _main_domain(gap: Mapping[str, Any], *, residual: bool) -> str:
    """', mostly in noise', or an empty text where no domain dominates."""
    shares = {domain: ends[residual] for domain, ends in gap.get("domains", {}).items()}
    whole = sum(shares.values())
    most = max(shares, key=lambda d: shares[d], default="")
    return f", mostly in {most}" if whole > 0 and shares[most] > 0.5 * whole else ""


def worst(curve: Mapping[str, Any]) -> int:
    """Number of the value that differs most; with effects, where only they make it differ."""
    sigmas = curve["z"] if curve["in_gap"] else curve["z_after"]
    return max(range(len(sigmas)), key=lambda n: abs(sigmas[n]))
