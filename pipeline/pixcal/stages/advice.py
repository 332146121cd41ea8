"""Which map to use, what limits it, and what each cause does to it: for the terminal and report."""

import math
import re
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

HEADER = ("effect", "size", "effect on the offsets", "action")
# in the place of `on_map` where a diagnosis has none
NOT_MEASURED = {"rms_px": 0.0, "max_px": 0.0, "action": "not measured"}
MATTERS = 0.3  # share of SIGMA from which an error that SIGMA does not hold limits a map


@dataclass(frozen=True)
class Advice:
    """What to know before using the maps."""

    sentences: tuple[str, ...]  # which maps to use, and what limits them; none without maps
    rows: tuple[tuple[str, str, str, str], ...]  # a row for each cause, under `HEADER`


def advice(run_dir: Path) -> Advice:
    """What the fit, the diagnosis and the correction of a run say together.

    Without a diagnosis there are sentences on the fitted maps only, without a fit the causes alone.
    """
    fit = _artefact(run_dir, "fit", "fit.json") or {"outputs": [], "sets": {}}
    diagnosis = _artefact(run_dir, "diagnose", "diagnosis.json")
    correction = _correction(run_dir)
    sigma = _sigma(fit, correction)
    rows = tuple(_row(c, correction, sigma) for c in (diagnosis["causes"] if diagnosis else ()))
    if not fit["outputs"]:
        return Advice((), rows)
    names = " and ".join(path.name for path in maps_to_use(run_dir).values())
    use = f"Use {names}{_as_what(diagnosis, correction)}."
    return Advice((use, _limit(sigma, diagnosis, correction)), rows)


def maps_to_use(run_dir: Path) -> dict[str, Path]:
    """The products to use, by the names of their maps: corrected ones where there are any."""
    require(run_dir, "fit")
    source: Json = read_json(run_dir / "fit" / "fit.json")
    correction, suffix = _correction(run_dir), ""
    if correction is not None and correction["outputs"]:
        source, suffix = correction, SUFFIX
    return {name: run_dir / "products" / f"{name}{suffix}.fits" for name in source["outputs"]}


def _artefact(run_dir: Path, stage: str, file: str) -> Json | None:
    """Contents of the file of a stage that was run."""
    if not (run_dir / stage / MANIFEST).exists():
        return None
    require(run_dir, stage)
    contents: Json = read_json(run_dir / stage / file)
    return contents


def _correction(run_dir: Path) -> Json | None:
    """The correction of the present fit and diagnosis, if there is one."""
    correction = _artefact(run_dir, "corrected", "correction.json")
    if correction is not None:
        for stage, key in require(run_dir, "corrected").inputs.items():
            if read_json(run_dir / stage / MANIFEST)["key"] != key:
                return None
    return correction


def _sigma(fit: Json, correction: Json | None) -> dict[str, float]:
    """Error of the median pixel of each set, px, in the maps to use."""
    if correction is not None and correction["outputs"]:
        each = {name: s["sigma_median_px"]["after"] for name, s in correction["sets"].items()}
    else:
        each = {name: s["sigma_median_px"] for name, s in fit["sets"].items()}
    return {name: sigma for name, sigma in each.items() if sigma}


def _on_map(cause: Json) -> Json:
    measured: Json = cause.get("on_map", NOT_MEASURED)
    return measured


def _as_what(diagnosis: Json | None, correction: Json | None) -> str:
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


def _limit(sigma: Mapping[str, float], diagnosis: Json | None, correction: Json | None) -> str:
    """What limits the maps: the largest bias, or noise."""
    made = correction if correction is not None and correction["outputs"] else None
    least = min(sigma.values(), default=math.nan)
    noise = ", ".join(f"{s:.2g} px ({name})" for name, s in sigma.items())
    biases = {
        cause["effect"]: _on_map(cause)["rms_px"]
        for cause in (diagnosis or {}).get("causes", ())
        if not (made and _on_map(cause)["action"] == "corrected")
    }
    largest = max(biases, key=lambda name: biases[name], default="")
    if biases.get(largest, 0.0) > MATTERS * least:
        return (
            f"Limited by {largest}, which moves offsets by {biases[largest]:.2g} px rms; the "
            f"noise is {noise}."
        )
    if diagnosis is not None and diagnosis["verdict"] in ("unexplained", "partly explained"):
        return (
            f"The noise is {noise}. Part of the gap has no known cause, so the maps may be biased."
        )
    sets = made["sets"].values() if made else ()
    kept = max((e for s in sets for e in s["parameter_error_px"].values() if e), default=0.0)
    if kept > MATTERS * least:
        return (
            f"Limited by noise, {noise}, which includes the error of the correction, up to "
            f"{kept:.2g} px rms."
        )
    return f"Limited by photon and read noise: {noise}. More frames reduce it."


def _row(
    cause: Json, correction: Json | None, sigma: Mapping[str, float]
) -> tuple[str, str, str, str]:
    return (
        cause["effect"],
        size_of(cause),
        _moved(cause, sigma),
        _action(cause, correction, bool(sigma)),
    )


def _moved(cause: Json, sigma: Mapping[str, float]) -> str:
    """Change of the offsets, against the error of the best set's median pixel."""
    if not sigma:
        return "no maps"
    rms, most = _on_map(cause)["rms_px"], _on_map(cause)["max_px"]
    return (
        f"{rms:.2g} px rms ({rms / min(sigma.values()):.2g} σ), {most:.2g} max" if rms else "none"
    )


def _action(cause: Json, correction: Json | None, with_maps: bool) -> str:
    """How an effect was treated, or what to do about it."""
    action = _on_map(cause)["action"]
    treated = {e["effect"]: e for e in (correction or {}).get("effects", ())}.get(cause["effect"])
    why = treated["why"] if treated else _reason(cause)
    if not with_maps and action in ("corrected", "unaffected"):
        ends = "corrected for it" if action == "corrected" else f"unaffected: {why}"
        text = f"maps of offsets measured with this detector would be {ends}"
    elif action == "corrected":
        done = treated is not None and _corrects(treated["treatment"])
        text = "maps corrected" if done else "NOT corrected: run 'pixcal fit RUN --with-diagnosis'"
    elif action == "unaffected":
        text = f"maps unaffected: {why}"
    else:
        text = f"{action.replace('fix the', 'fix on the')}: {why}" if why else str(action)
    if cause.get("would_decide"):
        others = " or ".join(cause["not_told_apart_from"])
        text += f"; to distinguish it from {others}, retake with {', '.join(cause['would_decide'])}"
    return text


def _reason(cause: Json) -> str:
    try:
        (effect,) = parse_effects({cause["effect"]: cause["parameters"]}, "diagnosis")
    except InputError:
        return ""  # An effect of the user's own.
    return treatment_of(effect, "auto", {}).why


def size_of(cause: Json) -> str:
    """The strengths of an effect with errors and units."""
    kind = known_effects().get(cause["effect"])
    if kind is None:
        return "-"
    units = {f.name: f.metadata.get("unit", "") for f in fields(kind)}
    sizes = (_strength(cause, name, units[name]) for name in kind.strengths)
    return "; ".join(filter(None, sizes)) or "-"


def _strength(cause: Json, name: str, unit: str) -> str:
    """One strength; nothing where it is zero."""
    value = cause["parameters"].get(name)
    # The unit follows the number; that of a relative size is per cent.
    label = re.sub(r"_(e|e_h|px|rad|adu|us|per_px|px_per_e|cm2_s)$", "", name).replace("_", " ")
    label = "" if label in ("share", "relative") else f"{label} "
    if isinstance(value, int | float):
        error = cause.get("uncertainty", {}).get(name)
        return f"{label}{_measured(value, error, unit)}" if value else ""
    if not isinstance(value, Sequence) or not value:
        return ""
    if isinstance(value[0], Mapping):
        return _parts(name, value, unit)
    numbers = [abs(v) for v in value if isinstance(v, int | float)]
    return f"{label}up to {_measured(max(numbers), None, unit)}" if any(numbers) else ""


def _measured(value: float, error: float | None, unit: str) -> str:
    scale, unit = (100, "%") if not unit else (1, unit)
    more = f" ± {scale * error:.2g}" if error else ""
    return f"{scale * value:.3g}{more} {unit}"


def _parts(name: str, parts: Sequence[Json], unit: str) -> str:
    """Size of a list of like parts; of a replay, which has a value for each frame, the rms."""
    if "value" in parts[0]:
        values = [float(v) for part in parts for v in part["value"]]
        rms = math.hypot(*values) / math.sqrt(max(len(values), 1))
        return f"{_measured(rms, None, unit)} rms, frame by frame"
    largest = max(map(_share, parts))
    number = f"{len(parts)} {name if len(parts) > 1 else name.removesuffix('s')}"
    return f"{number}, largest {100 * largest:.2g} %" if largest else number


def _share(part: Json) -> float:
    """Of a coupling, or of the wave of a ghost, which has a complex amplitude for each term."""
    waves = (part[key] for key in ("static", "forward", "backward") if key in part)
    return float(max([abs(part.get("share", 0.0)), *(math.hypot(*wave) for wave in waves)]))
