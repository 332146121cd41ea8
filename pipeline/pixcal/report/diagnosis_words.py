"""A diagnosis in words: the verdict, and the places of a curve."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pixcal.report.contents import Diagnosis
from pixcal.report.text import number

DETECTOR = "detector"
"""What ``curves.json`` has for the name of a set where a curve is of no single set."""

_UNITS = {"sigma": "σ", "2 √count": "2 √number", "": "", "h^-0.5": "1/√h"}


def unit(name: str) -> str:
    """A unit as people write it."""
    if name in _UNITS:
        return _UNITS[name]
    return name.replace("h^0.5", "√h").replace("e-", "e⁻").replace("um", "µm")


def percent(value: float) -> str:
    """A share in per cent, two digits."""
    return f"{number(100 * float(value), 2)}\u00a0%"


def with_interval(value: float, ends: Sequence[float]) -> str:
    """A share and its interval, in per cent."""
    low, high = (number(100 * float(v), 2) for v in ends)
    return f"{percent(value)} [{low}, {high}]"


def chance(p: float) -> str:
    """A p-value; below any size that means something, a limit."""
    return "< 10⁻¹²" if p <= 1e-12 else number(float(p), 2)


def listed(names: Iterable[str], last: str = "and") -> str:
    """Names as a list within a sentence."""
    *first, end = names
    return f"{', '.join(first)} {last} {end}" if first else end


def effect_title(diagnosis: Diagnosis, name: str) -> str:
    """An effect in a few words and its name: own effects are known by the causes alone."""
    words = diagnosis.effects.get(name)
    given = [c["title"] for c in diagnosis.facts["causes"] if c["effect"] == name and "title" in c]
    title = given[0] if given else words.title if words else ""
    return f"{title} ({name})" if title else name


def level(verdict: str) -> str:
    """How much a verdict should worry: a cause that was found is still at work in the data."""
    return {"no gap": "good", "unexplained": "bad"}.get(verdict, "check")


def answer(diagnosis: Diagnosis) -> str:
    """The verdict as one sentence."""
    facts = diagnosis.facts
    gap, verdict = facts["gap"], facts["verdict"]
    looked = facts.get("statistics", len(diagnosis.curves))
    count = differing(diagnosis)
    if verdict == "no gap":
        return (
            f"No gap: on frames kept out of every fit, none of {looked} statistics differs from "
            "the nominal simulation by more than chance."
        )
    where = main_domains(gap)
    if verdict == "unexplained":
        return (
            f"Unexplained: the data differ from the nominal simulation in {count} of {looked} "
            f"statistics{where}, and none of the {len(facts['candidates'])} effects that were "
            "tried closes the gap."
        )
    causes = listed(effect_title(diagnosis, c["effect"]) for c in facts["causes"])
    one = len(facts["causes"]) == 1
    left = with_interval(gap["after"], gap["interval"])
    if verdict == "explained":
        return (
            f"Explained: {causes} account{'s' if one else ''} for how the data differ from the "
            f"nominal simulation, in {count} of {looked} statistics; on frames kept out of the "
            f"fit, {left} of the gap is left."
        )
    return (
        f"{verdict[:1].upper()}{verdict[1:]}: {causes} close{'s' if one else ''} "
        f"{percent(1 - gap['after'])} of the gap between the data and the nominal simulation, on "
        f"frames kept out of the fit; {left} is left{where_left(gap)}."
    )


def differing(diagnosis: Diagnosis) -> int:
    """Statistics in which data and nominal simulation differ."""
    return sum(bool(c["in_gap"]) for c in diagnosis.curves)


def main_domains(gap: Mapping[str, Any]) -> str:
    """', mostly in noise', or nothing where no domain stands out."""
    return _mostly({d: v[0] for d, v in gap.get("domains", {}).items()})


def where_left(gap: Mapping[str, Any]) -> str:
    """The same for what is left."""
    return _mostly({d: v[1] for d, v in gap.get("domains", {}).items()})


def _mostly(shares: Mapping[str, float]) -> str:
    whole = sum(shares.values())
    most = max(shares, key=lambda d: shares[d], default="")
    return f", mostly in {most}" if whole > 0 and shares[most] > 0.5 * whole else ""


# Places of a curve

_STEPS = ("x+1", "y+1", "x+1 y+1", "x−1 y+1", "x+2", "y+2", "x+3", "y+3", "x+4", "y+4")


@dataclass(frozen=True)
class _Axis:
    """The places of a curve: the label of the axis, a place within a sentence, its names."""

    label: str
    phrase: str
    names: tuple[str, ...] = ()


_AXES = {
    "neighbour": _Axis("neighbour", "neighbour {}", _STEPS),
    "neighbour, by level": _Axis("neighbour, level by level", "neighbour {}", _STEPS[:4] * 8),
    "row of four, down then right": _Axis(
        "neighbour, row modulo 4",
        "neighbour {}",
        tuple(f"{step} r{row}" for step in ("y+1", "x+1") for row in range(4)),
    ),
    "left, right, above, below": _Axis("neighbour", "neighbour {}", ("x−1", "x+1", "y−1", "y+1")),
    "rows, columns": _Axis("", "{}", ("rows", "columns")),
    "cell of 4 × 4": _Axis(
        "cell of the window",
        "cell {}",
        tuple(f"{row},{column}" for row in range(1, 5) for column in range(1, 5)),
    ),
    "contrast, light of each pair": _Axis("maps", "{}", ("contrast", "light") * 20),
    "term": _Axis(
        "contrast V, then intensity B",
        "{}",
        tuple(f"{of} {f} {n}φ" for of in "VB" for n in ("", 2, 3) for f in ("cos", "sin")),
    ),
    "sigma, low then high": _Axis(
        "beyond so many σ", "beyond {} σ", ("−5", "−7", "−10", "+5", "+7", "+10")
    ),
    "quantile": _Axis("quantile of the pixels", "{} quantile"),
    "bin of level": _Axis("level, dark to bright", "level bin {}, 0 the darkest"),
    "period, rows": _Axis("period, rows", "every {} rows"),
    "period, columns": _Axis("period, columns", "every {} columns"),
    "frames before": _Axis("other frame", "frame {}"),
    "harmonic (cosine, sine)": _Axis("harmonic", "{}"),
    "batches averaged": _Axis("batches averaged", "batches averaged: {}"),
}
"""By ``x_label`` of ``curves.json``, where numbers alone would say little."""


def axis_label(curve: Mapping[str, Any]) -> str:
    """What the places of a curve are."""
    label = str(curve["x_label"])
    return _AXES[label].label if label in _AXES else label


def places(curve: Mapping[str, Any]) -> list[str]:
    """A name for each value of a curve."""
    label, x = str(curve["x_label"]), list(curve["x"])
    names = _AXES[label].names if label in _AXES else ()
    if len(names) >= len(x):
        return list(names[: len(x)])
    if label == "harmonic (cosine, sine)":
        return [f"{'sin' if v % 1 else 'cos'} {int(v) if int(v) > 1 else ''}ψ" for v in x]
    if label == "frames before":
        return [f"t{-int(v):+d}".replace("-", "−") for v in x]
    if label == "quantile":
        return [f"{100 * v:g} %" for v in x]
    return [number(int(v)) if v == int(v) else number(v, 3) for v in x]


def worst(curve: Mapping[str, Any]) -> int:
    """Number of the value that differs most; with effects, where only they make it differ."""
    sigmas = curve["z"] if curve["in_gap"] else curve["z_after"]
    return max(range(len(sigmas)), key=lambda n: abs(sigmas[n]))


def place(curve: Mapping[str, Any], at: int) -> str:
    """Where in a curve a value is, in words."""
    label, name = str(curve["x_label"]), places(curve)[at]
    if not label and len(curve["x"]) == 1:
        return "all frames"
    if label in _AXES:
        return _AXES[label].phrase.format(name)
    if label.startswith("cycles a ") and curve["x"][at] > 0:
        period = number(1 / curve["x"][at], 2)
        return f"periods of {period} {'px' if label.endswith('pixel') else 'frames'}"
    return f"{label} {name}".strip()
