"""Which map to use, what limits it, and how each cause affects it: for terminal and report."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.effects import known_effects
from pixcal.report.text import NO_OFFSETS, digits_apart, number, sigmas, unit, with_error
from pixcal.stages.treatment import CORRECTED, SUFFIX, fitted_shapes, treatment_of_kind
from pixcal.storage.manifest import MANIFEST, read_json
from pixcal.storage.stage import require, without_fringes

Json = Mapping[str, Any]

# in place of an artefact that is not there
NOTHING: Json = {"outputs": (), "sets": {}, "effects": (), "causes": (), "verdict": None}
NEGLIGIBLE = 1e-3  # change of the offsets over their errors below which it is not given
WITH_GAP = ("unexplained", "partly explained")  # verdicts that leave part of the gap open
MIN_BIAS_OVER_SIGMA = 0.3  # share of SIGMA from which an error outside it limits a map


@dataclass(frozen=True)
class Advice:
    """What to know before using the maps."""

    sentences: tuple[str, ...]  # which maps to use, and what limits them; none without maps
    rows: tuple[tuple[str, ...], ...]  # a header, and a row for each cause; empty without any
    nothing_to_do: bool = True  # whether no cause asks for anything to be done


def advice(run_dir: Path) -> Advice:
    """What fit, diagnosis and correction of a run say together, as far as they exist."""
    fit, correction = _artefact(run_dir, "fit", "fit.json"), _correction(run_dir)
    diagnosis = _artefact(run_dir, "diagnose", "diagnosis.json")
    sigma, causes = _sigma(fit, correction), diagnosis["causes"]
    shapes, fringes = fitted_shapes(run_dir), not without_fringes(run_dir)

    def action(cause: Json) -> str:
        to_do = str(cause.get("remedy", ""))
        if fringes:
            to_do = _action(cause, correction, shapes, bool(sigma))
        return f"{to_do}{_to_distinguish(cause)}"

    rows: tuple[tuple[str, ...], ...] = tuple(
        (c["effect"], size_of(c), sigmas(c.get("sigmas")), moved_by(c, sigma), action(c))
        for c in causes
    )
    rows += unexplained(diagnosis)
    header = ("effect", "size", "significance", "effect on the offsets", "action")
    rows = (header, *rows) if rows else ()
    if not sigma:
        rows = tuple((*row[:3], *row[4:]) for row in rows)
    nothing_to_do = all(fringes and _nothing_to_do(c, correction, bool(sigma)) for c in causes)
    if not fit["outputs"]:
        return Advice((), rows, nothing_to_do)
    if not sigma:
        return Advice((NO_OFFSETS,), rows, nothing_to_do)
    names = [path.name for path in maps_to_use(run_dir).values()]
    it_needs = "They need" if len(names) > 1 else "It needs"
    use = f"Use {' and '.join(names)}{_correction_clause(diagnosis, correction, it_needs)}."
    return Advice((use, limit(sigma, diagnosis, correction)), rows, nothing_to_do)


def maps_to_use(run_dir: Path) -> dict[str, Path]:
    """The products to use, by the names of their maps: corrected ones where there are any."""
    require(run_dir, "fit")
    source, suffix = _correction(run_dir), SUFFIX
    if not source["outputs"]:
        source, suffix = read_json(run_dir / "fit" / "fit.json"), ""
    return {name: run_dir / "products" / f"{name}{suffix}.fits" for name in source["outputs"]}


def _artefact(run_dir: Path, stage: str, file: str) -> Json:
    """Contents of the file of a stage, or `NOTHING`."""
    if not (run_dir / stage / MANIFEST).exists():
        return NOTHING
    require(run_dir, stage)
    return dict(read_json(run_dir / stage / file))


def _correction(run_dir: Path) -> Json:
    """The correction, unless it is of another fit or diagnosis."""
    correction = _artefact(run_dir, "corrected", "correction.json")
    if correction is NOTHING:
        return correction
    made_from = require(run_dir, "corrected").inputs
    present = {stage: read_json(run_dir / stage / MANIFEST)["key"] for stage in made_from}
    return correction if present == made_from else NOTHING


def _sigma(fit: Json, correction: Json) -> dict[str, float]:
    """Error of the median pixel of each set, px, in the maps to use."""
    each = {name: s["sigma_median_px"] for name, s in fit["sets"].items()}
    if correction["outputs"]:
        each = {name: s["sigma_median_px"]["after"] for name, s in correction["sets"].items()}
    return {name: sigma for name, sigma in each.items() if sigma and math.isfinite(sigma)}


def _correction_clause(diagnosis: Json, correction: Json, it_needs: str) -> str:
    if diagnosis is NOTHING:
        return " as fitted. No diagnosis was made, so biases are unknown"
    if correction["outputs"]:
        freed = [e["effect"] for e in correction["effects"] if e["treatment"] in CORRECTED]
        return f", corrected for {' and '.join(freed)}"
    if any(c["on_map"]["action"] == "corrected" for c in diagnosis["causes"]):
        return " as fitted, NOT corrected for the effects below"
    if unknown := _unknown(diagnosis["causes"]):
        return f" as fitted. The effect of {' and '.join(unknown)} on the offsets is unknown"
    if diagnosis["verdict"] in WITH_GAP:
        return " as fitted"  # `limit` says why they may need a correction
    return f" as fitted. {it_needs} no correction"


def _unknown(causes: Sequence[Json]) -> list[str]:
    """Causes that are neither absorbed nor corrected: their change of the maps is unknown."""
    left = [c for c in causes if c["on_map"]["action"] == "fix the bench"]
    return [c["effect"] for c in left if not c["on_map"]["rms_px"]]


def limit(sigma: Mapping[str, float], diagnosis: Json, correction: Json) -> str:
    """What limits the maps: the largest bias, or noise."""
    least = min(sigma.values(), default=math.nan)
    noise = ", ".join(f"{number(s, 2)} px ({name})" for name, s in sigma.items())
    biases = {
        cause["effect"]: cause["on_map"]["rms_px"]
        for cause in diagnosis["causes"]
        if not (correction["outputs"] and cause["on_map"]["action"] == "corrected")
    }
    largest = max(biases, key=lambda name: biases[name], default="")
    if biases.get(largest, 0.0) > MIN_BIAS_OVER_SIGMA * least:
        moved = f"{number(biases[largest], 2)} px rms"
        return f"Limited by {largest}, which moves offsets by {moved}; the noise is {noise}."
    if diagnosis["verdict"] in WITH_GAP:
        return (
            f"The noise is {noise}. Part of the gap has no known cause, so the maps may be biased."
        )
    if unknown := _unknown(diagnosis["causes"]):
        return f"The noise is {noise}. {' and '.join(unknown)} may bias the maps."
    errors = [e for s in correction["sets"].values() for e in s["parameter_error_px"].values()]
    kept = max(filter(None, errors), default=0.0)
    if kept > MIN_BIAS_OVER_SIGMA * least:
        return (
            f"Limited by noise: {noise}, including up to {number(kept, 2)} px rms from the "
            "correction."
        )
    return f"Limited by photon and read noise: {noise}. More frames reduce it."


def moved_by(cause: Json, sigma: Mapping[str, float]) -> str:
    """Change of the offsets, against the error of the best set's median pixel."""
    rms, most = cause["on_map"]["rms_px"], cause["on_map"]["max_px"]
    if not rms or not sigma:
        return "not known" if _unknown([cause]) else "none"
    in_sigma = rms / min(sigma.values())
    if in_sigma < NEGLIGIBLE:
        return f"below {NEGLIGIBLE:g} σ"
    return f"{number(rms, 2)} px rms ({number(in_sigma, 2)} σ), {number(most, 2)} px maximum"


def _treated(cause: Json, correction: Json) -> Json | None:
    """Entry of an effect in the correction, where there is one."""
    return next((e for e in correction["effects"] if e["effect"] == cause["effect"]), None)


def _nothing_to_do(cause: Json, correction: Json, with_maps: bool) -> bool:
    action, treated = cause["on_map"]["action"], _treated(cause, correction)
    done = not with_maps or (treated is not None and treated["treatment"] in CORRECTED)
    return bool(action == "unaffected" or (action == "corrected" and done))


def _action(
    cause: Json, correction: Json, shapes: tuple[str, Mapping[str, str]], with_maps: bool
) -> str:
    """How an effect was treated, or what to do about it."""
    action, treated = cause["on_map"]["action"], _treated(cause, correction)
    # An effect of the user's own is not known here.
    kind = known_effects().get(cause["effect"])
    why = treated["why"] if treated else treatment_of_kind(kind, *shapes)[1] if kind else ""
    because = f": {why}" if why else ""
    if action == "corrected":
        if not with_maps:
            text = "run 'pixcal fit RUN --with-diagnosis' for corrected maps"
        elif _nothing_to_do(cause, correction, with_maps):
            text = "maps corrected"
        else:
            text = "NOT corrected: run 'pixcal fit RUN --with-diagnosis'"
    elif action == "unaffected":
        text = f"{'maps unaffected' if with_maps else 'no bias of pixel offsets'}{because}"
    else:
        text = action.replace("fix the", "fix on the") + because
    return text


def _to_distinguish(cause: Json) -> str:
    """Frames that would distinguish a cause from others, for the end of a sentence."""
    if not cause.get("would_decide"):
        return ""
    others = " or ".join(cause["not_told_apart_from"])
    return f"; to distinguish it from {others}, also record {', '.join(cause['would_decide'])}"


def unexplained(diagnosis: Json) -> tuple[tuple[str, ...], ...]:
    """A row on the largest departure that no cause explains, if there is one."""
    if diagnosis["verdict"] not in WITH_GAP or not diagnosis["gap"]["where"]:
        return ()
    ranked = sorted(diagnosis["gap"]["where"], key=lambda e: -abs(e["z_after"]))
    first, sized = ranked[0], [e for e in ranked if e["unit"] != "σ"]
    # The size of what only has a significance shows best in another statistic.
    shown = ranked[:1] + (sized[:1] if first["unit"] == "σ" else [])
    size = "; ".join(map(_departure, shown))
    frames = ", ".join(diagnosis["more_would_tell"])
    more = f"; recommended frames: {frames}" if frames else ""
    action = f"find the cause on the bench{more}"
    return (("unexplained", size, sigmas(abs(first["z_after"])), "not known", action),)


def _departure(entry: Json) -> str:
    """What a statistic measures, and what the simulation has."""
    ends = [float(entry[key]) for key in ("measured", "after")]
    its_unit = f" {unit(entry['unit'])}" if entry["unit"] else ""
    if not its_unit and max(map(abs, ends)) <= 1:
        ends, its_unit = [100 * end for end in ends], " %"
    digits = digits_apart(*ends)
    decimals = digits - 1 - math.floor(math.log10(max(map(abs, ends))))
    measured, simulated = (number(round(v, decimals), digits) for v in ends)
    return f"{entry['title']}, {entry['place']}: {measured}{its_unit} (simulated: {simulated})"


# least mean of a series, over the rms about it, that is reported: smaller ones are its scatter
_LEVEL = 1.0


def size_of(cause: Json) -> str:
    """The significant strengths with errors and units, or the size where these do not say it."""
    if size := cause.get("size"):
        measured = _measured(size["value"], size["error"], size["unit"])
        return f"{measured} {size['of'].replace('e-', 'e⁻')}"
    sizes = {n: s for n in cause["strengths"] if (s := _strength(cause, n, cause["units"][n]))}
    significant = [text for name, text in sizes.items() if not _within_errors(cause, name)]
    return "; ".join(significant or sizes.values()) or "-"


def _within_errors(cause: Json, name: str) -> bool:
    """Whether a strength is less than two of its errors."""
    value, error = cause["parameters"].get(name), cause.get("uncertainty", {}).get(name)
    return isinstance(value, int | float) and error is not None and abs(value) < 2 * error


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
        if "value" not in value[0]:
            largest = max(map(_share, value))
            number_of = f"{len(value)} {name if len(value) > 1 else name.removesuffix('s')}"
            return f"{number_of}, largest {100 * largest:.2g} %" if largest else ""
        axis = "" if name.endswith("tracks") else label
        return f"{axis}{_replay(value, unit)}"
    numbers = [abs(v) for v in value if isinstance(v, int | float)]
    return f"{label}up to {_measured(max(numbers), None, unit)}" if any(numbers) else ""


def _measured(value: float, error: float | None, unit: str) -> str:
    scale, unit = (100, "%") if not unit else (1, unit.replace("e-", "e⁻"))
    text = with_error(scale * value, scale * error) if error else number(float(scale * value))
    return f"{text} {unit}"


def _replay(tracks: Sequence[Json], unit: str) -> str:
    """The rms of a change that has a value for each frame, and the largest mean of a series."""
    series = [np.array(track["value"], float) for track in tracks if track["value"]]
    levels = [float(values.mean()) for values in series]
    apart = [v - level for v, level in zip(series, levels, strict=True)] or [np.zeros(1)]
    rms = float(np.std(np.concatenate(apart)))
    text = f"{_measured(rms, None, unit)} rms, frame by frame"
    level = max(levels, key=abs, default=0.0)
    if abs(level) <= _LEVEL * rms:
        return text
    return f"{text}, about a mean of {_measured(level, None, unit)}"


def _share(part: Json) -> float:
    """Of a coupling, a point of a response, or the wave of a ghost, complex for each term."""
    if part.get("level_e"):
        return abs(float(part["change_e"])) / float(part["level_e"])
    waves = (part[key] for key in ("static", "forward", "backward") if key in part)
    return float(max([abs(part.get("share", 0.0)), *(math.hypot(*wave) for wave in waves)]))
