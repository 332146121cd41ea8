"""Which map to use, what limits it, and what each cause does to it: for the terminal and report."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from pixcal.effects import known_effects, parse_effects
from pixcal.model.errors import InputError
from pixcal.stages.treatment import SUFFIX, treatment_of
from pixcal.storage.artefact import MANIFEST, read_json
from pixcal.storage.stage import require

Json = Mapping[str, Any]

HEADER = ("effect", "size", "on the map (rms, maximum)", "action")
# in the place of `on_map` where a diagnosis has none
NOT_MEASURED = {"rms_px": 0.0, "max_px": 0.0, "action": "not measured"}
MATTERS = 0.3  # share of SIGMA from which an error that SIGMA does not hold limits a map


@dataclass(frozen=True)
class Advice:
    """What a reader of the maps must know first."""

    sentences: tuple[str, ...]  # which maps to use, and what limits them
    rows: tuple[tuple[str, str, str, str], ...]  # a row for each cause, under `HEADER`


def advice(run_dir: Path) -> Advice | None:
    """What the fit, the diagnosis and the correction say together; None without a fit.

    Parameters
    ----------
    run_dir : Path
        A run; without a diagnosis only the fitted maps are spoken of.
    """
    if not (run_dir / "fit" / MANIFEST).exists():
        return None
    fit = read_json(run_dir / "fit" / "fit.json")
    if not fit["outputs"]:
        return None
    diagnosis = _diagnosis(run_dir)
    correction = _correction(run_dir)
    causes = diagnosis["causes"] if diagnosis else ()
    rows = tuple(_row(cause, correction) for cause in causes)
    names = [path.name for path in maps_to_use(run_dir).values()]
    use = f"Use {' and '.join(names)}{_about(diagnosis, correction)}."
    return Advice((use, _limit(fit, diagnosis, correction)), rows)


def maps_to_use(run_dir: Path) -> dict[str, Path]:
    """The products to use, by the names of their maps: corrected ones where there are any.

    Raises
    ------
    InputError
        If the run was not fitted.
    """
    require(run_dir, "fit")
    source: Json = read_json(run_dir / "fit" / "fit.json")
    correction, suffix = _correction(run_dir), ""
    if correction is not None and correction["outputs"]:
        source, suffix = correction, SUFFIX
    return {name: run_dir / "products" / f"{name}{suffix}.fits" for name in source["outputs"]}


def _diagnosis(run_dir: Path) -> Json | None:
    if not (run_dir / "diagnose" / MANIFEST).exists():
        return None
    require(run_dir, "diagnose")
    found: Json = read_json(run_dir / "diagnose" / "diagnosis.json")
    return found


def _correction(run_dir: Path) -> Json | None:
    """That of the present fit and diagnosis."""
    if not (run_dir / "corrected" / MANIFEST).exists():
        return None
    made = require(run_dir, "corrected")
    for stage, key in made.inputs.items():
        if read_json(run_dir / stage / MANIFEST)["key"] != key:
            return None
    found: Json = read_json(run_dir / "corrected" / "correction.json")
    return found


def _on_map(cause: Json) -> Json:
    found: Json = cause.get("on_map", NOT_MEASURED)
    return found


def _about(diagnosis: Json | None, correction: Json | None) -> str:
    if diagnosis is None:
        return " as fitted. No diagnosis was made, so biases are unknown"
    if correction is not None and correction["outputs"]:
        freed = [e["effect"] for e in correction["effects"] if _corrects(e["treatment"])]
        return f", corrected for {' and '.join(freed)}"
    if any(_on_map(c)["action"] == "corrected" for c in diagnosis["causes"]):
        return " as fitted, NOT corrected for the effects below"
    return " as fitted. They need no correction"


def _corrects(how: str) -> bool:
    return how.startswith("undone") or how == "in the corrected fit"


def _limit(fit: Json, diagnosis: Json | None, correction: Json | None) -> str:
    """The largest of what errors hold, and of what they do not."""
    made = correction if correction is not None and correction["outputs"] else None
    if made is None:
        sigma = {name: facts["sigma_median_px"] for name, facts in fit["sets"].items()}
    else:
        sigma = {name: facts["sigma_median_px"]["after"] for name, facts in made["sets"].items()}
    least = min((s for s in sigma.values() if s), default=math.nan)
    told = ", ".join(f"{s:.2g} px ({name})" for name, s in sigma.items() if s)
    others = [
        c for c in (diagnosis or {}).get("causes", ())
        if _on_map(c)["rms_px"] > MATTERS * least
        and not (made and _on_map(c)["action"] == "corrected")
    ]  # fmt: skip
    if others:
        worst = max(others, key=lambda c: _on_map(c)["rms_px"])
        return (
            f"Limited by {worst['effect']}, which moves offsets by "
            f"{_on_map(worst)['rms_px']:.2g} px rms; the noise is {told}."
        )
    if diagnosis is not None and diagnosis["verdict"] in ("unexplained", "partly explained"):
        return (
            f"The noise is {told}. Part of the gap has no known cause, so the maps may be biased."
        )
    kept = [
        e for facts in (made["sets"].values() if made else ())
        for e in facts["parameter_error_px"].values() if e
    ]  # fmt: skip
    if kept and max(kept) > MATTERS * least:
        return (
            f"Limited by noise, {told}, which includes the error of the correction, up to "
            f"{max(kept):.2g} px rms."
        )
    return f"Limited by photon and read noise: {told}. More frames reduce it."


def _row(cause: Json, correction: Json | None) -> tuple[str, str, str, str]:
    own = _on_map(cause)
    moved = "none" if not own["rms_px"] else f"{own['rms_px']:.2g} px, {own['max_px']:.2g} px"
    return cause["effect"], size_of(cause), moved, _done(cause, correction)


def _done(cause: Json, correction: Json | None) -> str:
    action = _on_map(cause)["action"]
    why = next((e for e in (correction or {}).get("effects", ())
                if e["effect"] == cause["effect"]), None)  # fmt: skip
    if action == "corrected":
        if why is not None and _corrects(why["treatment"]):
            return "corrected"
        return "NOT corrected: see 'pixcal fit RUN --with-diagnosis'"
    reason = why["why"] if why is not None else _reason(cause)
    return f"{action}: {reason}" if reason else str(action)


def _reason(cause: Json) -> str:
    try:
        (effect,) = parse_effects({cause["effect"]: cause["parameters"]}, "diagnosis")
    except InputError:
        return ""  # An effect of the user's own.
    return treatment_of(effect, "auto", {}).why


def _share(part: Json) -> float:
    """Of a coupling, or of the wave of a ghost, which has a complex amplitude for each term."""
    waves = (part[key] for key in ("static", "forward", "backward") if key in part)
    return float(max([abs(part.get("share", 0.0)), *(math.hypot(*wave) for wave in waves)]))


def _size_of_parts(name: str, parts: Sequence[Json], unit: str) -> str:
    """Of a list of like parts; of a replay, which has a value for each frame, the rms."""
    if "value" in parts[0]:
        values = [float(v) for part in parts for v in part["value"]]
        rms = math.hypot(*values) / math.sqrt(max(len(values), 1))
        return f"{rms:.2g} {unit} rms, frame by frame".replace("  ", " ")
    largest = max(map(_share, parts))
    told = f", largest {100 * largest:.2g} %" if largest else ""
    return f"{len(parts)} {name}{told}"


def size_of(cause: Json) -> str:
    """The strengths of an effect in a few words."""
    kind = known_effects().get(cause["effect"])
    if kind is None:
        return "-"
    units = {f.name: f.metadata.get("unit", "") for f in fields(kind)}
    parts = []
    for name in kind.strengths:
        value = cause["parameters"].get(name)
        if isinstance(value, Sequence) and value and isinstance(value[0], Mapping):
            parts.append(_size_of_parts(name, value, units[name]))
        elif isinstance(value, int | float) and value:
            parts.append(f"{name} {value:.3g} {units[name]}".strip())
        elif isinstance(value, Sequence) and value:
            numbers = [v for v in value if isinstance(v, int | float)]
            if numbers:
                parts.append(f"{name} up to {max(map(abs, numbers)):.3g} {units[name]}".strip())
    return "; ".join(parts) or "-"
