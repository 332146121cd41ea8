"""A diagnosis in words: the verdict, shares and chances."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pixcal.report.contents import DiagnosisContents
from pixcal.report.text import number

DETECTOR = "detector"  # name of the set in `curves.json` for a curve that is not of a single set
_STEPS = ("x+1", "y+1", "x+1 y+1", "x−1 y+1", "x+2", "y+2", "x+3", "y+3", "x+4", "y+4")


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
    """Title and name of an effect; titles of users' own effects are only in the causes."""
    given = {c["effect"]: c["title"] for c in diagnosis.facts["causes"]}
    title = given.get(name) or diagnosis.titles.get(name)
    return f"{title} ({name})" if title else name


def level(diagnosis: DiagnosisContents) -> str:
    """Severity of a verdict; identified causes may require action."""
    verdict = diagnosis.facts["verdict"]
    if verdict == "unexplained":
        return "bad"
    settled = verdict == "no gap" or (verdict == "explained" and diagnosis.nothing_to_do)
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
    """Candidates; without fringes, excluding those that show only in fringes."""
    sets = facts.get("looked_at", {}).get("sets", True)
    only = "; record fringes"
    return [c for c in facts["candidates"] if sets or not c["rejected_because"].endswith(only)]


def _shared(facts: Mapping[str, Any]) -> bool:
    """Whether any frames were too few to fit effects to one half and test them on the other."""
    return bool(facts.get("looked_at", {}).get("shared"))


def _main_domain(gap: Mapping[str, Any], *, residual: bool) -> str:
    """', mostly in noise', or an empty text if no domain dominates."""
    shares = {domain: ends[residual] for domain, ends in gap.get("domains", {}).items()}
    whole = sum(shares.values())
    most = max(shares, key=lambda d: shares[d], default="")
    return f", mostly in {most}" if whole > 0 and shares[most] > 0.5 * whole else ""


def worst(curve: Mapping[str, Any]) -> int:
    """Index of the value that differs most, or of one that differs only with effects."""
    sigmas = curve["z"] if curve["in_gap"] else curve["z_after"]
    return max(range(len(sigmas)), key=lambda n: abs(sigmas[n]))


# Abscissae of a statistic's curve: which row, which neighbour, which period


@dataclass(frozen=True)
class _Axis:
    """Abscissae of a curve: label of the axis, wording within a sentence, names."""

    label: str
    phrase: str
    names: tuple[str, ...] = ()


_SIDES = ("x−1", "x+1", "y−1", "y+1")
_ROWS_OF_FOUR = tuple(f"{step} r{row}" for step in ("y+1", "x+1") for row in range(4))
_IN_PAIRS = tuple(
    f"{of}, {how}" for of in ("rows", "columns") for how in ("in pairs", "alternating")
)
_LINES = tuple(f"{n} {of}{'s' * (n > 1)}" for of in ("row", "column") for n in range(1, 5))
_BANDS = ("≥ 8 px", "4 to 8 px", "2.7 to 4 px", "2 to 2.7 px", "2 rows", "2 columns")
_HALF_WAVES = ("1 to 3", "4 to 9", "10 on")
_CELLS = tuple(f"{row},{column}" for row in range(1, 5) for column in range(1, 5))
_TERMS = tuple(f"{of} {f} {n}φ" for of in "VB" for n in ("", 2, 3) for f in ("cos", "sin"))
_SIGMAS = ("−5", "−7", "−10", "+5", "+7", "+10")

# by `x_label` of `curves.json`, for which numbers alone are not informative
_AXES = {
    "neighbour": _Axis("neighbour", "neighbour {}", _STEPS),
    "far neighbour": _Axis("neighbour", "neighbour {}", _STEPS[4:]),
    "row of four, down then right": _Axis("neighbour, row modulo 4", "neighbour {}", _ROWS_OF_FOUR),
    "left, right, above, below": _Axis("neighbour", "neighbour {}", _SIDES),
    "rows, columns: in pairs, alternating": _Axis("", "{}", _IN_PAIRS),
    "distance: rows, then columns": _Axis("lines apart", "{} apart", _LINES),
    "band, then two rows, two columns": _Axis("period", "periods of {}", _BANDS),
    "bin of frequency": _Axis(
        "half-cycles over the set", "{} half-cycles over the set", _HALF_WAVES
    ),
    "cell of 4 × 4": _Axis("cell of the window", "cell {}", _CELLS),
    "contrast, light of each pair": _Axis("maps", "{}", ("contrast", "light") * 20),
    "term": _Axis("contrast V, then intensity B", "{}", _TERMS),
    "sigma, low then high": _Axis("beyond so many σ", "beyond {} σ", _SIGMAS),
    "quantile": _Axis("quantile of the pixels", "{} quantile"),
    "bin of level": _Axis("level, dark to bright", "level bin {} (0: darkest)"),
    "flat": _Axis("flat levels (0: shortest, dimmest)", "flats of level {}"),
    "period, rows": _Axis("period, rows", "every {} rows"),
    "period, columns": _Axis("period, columns", "every {} columns"),
    "frames before": _Axis("other frame", "frame {}"),
    "harmonic (cosine, sine)": _Axis("harmonic", "{}"),
    "exposure time of flats": _Axis("exposure time (s)", "flats of {} s"),
    "exposure time without light": _Axis("exposure time (s)", "bias and dark frames of {} s"),
    "batches averaged": _Axis("batches averaged", "batches averaged: {}"),
}


def axis_label(curve: Mapping[str, Any]) -> str:
    """Label of the abscissae of a curve."""
    label = str(curve["x_label"])
    return _AXES[label].label if label in _AXES else label.replace(" a ", " per ")


def places(curve: Mapping[str, Any]) -> list[str]:
    """A name for each value of a curve."""
    label, x = str(curve["x_label"]), list(curve["x"])
    names = _AXES[label].names if label in _AXES else ()
    if not label and len(x) == 1:
        return ["all frames"]
    if len(names) >= len(x):
        return list(names[: len(x)])
    if label == "harmonic (cosine, sine)":
        return [f"{'sin' if v % 1 else 'cos'} {int(v) if int(v) > 1 else ''}ψ" for v in x]
    if label == "frames before":
        return [f"t{-int(v):+d}".replace("-", "−") for v in x]
    if label == "quantile":
        return [f"{100 * v:g} %" for v in x]
    return [number(int(v)) if v == int(v) else number(v, 3) for v in x]


def place(curve: Mapping[str, Any], at: int) -> str:
    """Position of a value in a curve, in words."""
    label, name = str(curve["x_label"]), places(curve)[at]
    if label in _AXES:
        return _AXES[label].phrase.format(name)
    if label.startswith("cycles a ") and curve["x"][at] > 0:
        period = number(1 / curve["x"][at], 2)
        return f"periods of {period} {'px' if label.endswith('pixel') else 'frames'}"
    return f"{label} {name}".strip()
