"""Summary of the run: the precision reached, and the warnings."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pixcal.report.contents import Contents, DiagnosisContents, SetContents
from pixcal.report.diagnosis_words import level, listed, residual_gap
from pixcal.report.text import NAMES, NO_OFFSETS, duration, number, ratio, share, unit, with_error

TARGET_PX = 5e-5  # target precision of a calibration (paper, section 4.2)

# offset of the fibres that a laboratory would notice: twice its 2 cm (paper, section 5.2)
FAR_MM = 40.0

_OFF = 0.05  # relative difference of a measured value from the declared one that is shown at once

GOOD, CHECK, BAD = SEVERITY = ("good", "check", "bad")


class Card(NamedTuple):
    """One key number and its reference."""

    title: str
    value: str
    detail: str
    level: str


class Finding(NamedTuple):
    """One sentence and its severity (``good``, ``check`` or ``bad``)."""

    level: str
    text: str


def headline(contents: Contents) -> str:
    """One sentence on the whole run."""
    if not contents.sets:
        if not contents.has_fringes:
            return detector_headline(contents.detector.facts)
        return (
            "No offsets were measured: the fit has not been run. This page shows the results of "
            "the detector frames."
        )
    parts = []
    for offset in contents.offsets:
        sigma = offset.sigma.median
        if np.isfinite(sigma):
            nm = sigma * contents.pitch_um * 1e3
            parts.append(f"{NAMES[offset.name]} {number(sigma, 2)} px ({number(nm, 2)} nm)")
    if not parts:
        return NO_OFFSETS
    return f"Median error (1σ): {', '.join(parts)}."


def detector_headline(facts: dict[str, Any]) -> str:
    """Gain, read noise and full well in a sentence, measured where they could be."""
    figures = facts.get("figures_of_merit") or {}
    parts = []
    for key, entry, name, of in (
        ("conversion_gain", "gain_e_per_adu", "gain", "e⁻/ADU"),
        ("read_noise", "read_noise_e", "read noise", "e⁻"),
        ("full_well", "", "full well", "e⁻"),
    ):
        known = facts.get(entry, {})
        if key in figures and not figures[key]["note"]:
            value, error = figures[key]["value"], figures[key]["error"]
            parts.append(f"{name} {with_error(value, error)} {of}")
        elif known.get("measured") is not None:
            parts.append(f"{name} {with_error(known['measured'], known.get('error'))} {of}")
        elif known.get("used") is not None:
            parts.append(f"{name} {number(known['used'], 4)} {of} (declared)")
        declared, measured = known.get("declared"), known.get("measured")
        if declared and measured is not None:
            error = 3 * (known.get("error") or 0.0)
            if abs(measured - declared) > max(error, _OFF * declared):
                parts[-1] += f" instead of the declared {number(declared, 4)}"
    return f"The detector: {', '.join(parts)}." if parts else "The detector was not measured."


def cards(contents: Contents) -> Iterator[Card]:
    """Numbers for the top of the page."""
    for offset in contents.offsets:
        sigma, spread = offset.sigma.median, number(offset.delta.robust_std, 3)
        yield Card(
            f"median σ of {NAMES[offset.name]}, as fitted",
            f"{number(sigma, 3)} px",
            f"{number(sigma * contents.pitch_um * 1e3, 3)} nm; rms of the offsets: {spread} px",
            GOOD if np.isfinite(sigma) else BAD,
        )
    if contents.sets:
        yield _bound_card(contents.sets)
    measured = {s.name: s.allan for s in contents.sets if s.allan}
    slopes = {name: allan for name, allan in measured.items() if allan.get("slope") is not None}
    if slopes:
        yield _allan_card(slopes)
    if not contents.has_fringes:
        yield from _detector_cards(contents.detector.facts)
    if contents.diagnosis is not None:
        yield _diagnosis_card(contents.diagnosis)
    yield _mask_card(contents)


def _detector_cards(facts: dict[str, Any]) -> Iterator[Card]:
    figures = facts.get("figures_of_merit") or {}
    for key in (
        "conversion_gain",
        "read_noise",
        "full_well",
        "dynamic_range",
        "dsnu",
        "prnu",
        "dark_current",
    ):
        if key in figures:
            f = figures[key]
            value = f"{with_error(f['value'], f['error'])} {unit(f['unit'])}"
            yield Card(f["title"], value, unit(f["note"]), GOOD)


def _diagnosis_card(diagnosis: DiagnosisContents) -> Card:
    verdict, gap = diagnosis.facts["verdict"], diagnosis.facts["gap"]
    causes = ", ".join(c["effect"] for c in diagnosis.facts["causes"])
    detail = "no significant difference" if verdict == "no gap" else f"The {residual_gap(gap)}"
    if verdict == "no gap" and (
        untested := sum(map(len, diagnosis.facts.get("not_tested", {}).values()))
    ):
        effects = "effect" if untested == 1 else "effects"
        detail += f"; {untested} {effects} not tested (required frames missing)"
    return Card("diagnosis", verdict, f"{causes}. {detail}" if causes else detail, level(diagnosis))


def _bound_card(sets: Sequence[SetContents]) -> Card:
    ratios = [_over_bound(s.facts) for s in sets]
    return Card(
        "σ / Cramér–Rao bound",
        ", ".join(number(value, 4) for value in ratios),
        f"{', '.join(s.name for s in sets)}; 1 is the limit for any unbiased estimate",
        max(map(_bound_level, ratios), key=SEVERITY.index),
    )


def _allan_card(slopes: Mapping[str, Mapping[str, Any]]) -> Card:
    knees = {name: s["knee_frames"] for name, s in slopes.items() if s.get("knee_frames")}
    at = ", ".join(f"knee of {name} at {number(round(k))} frames" for name, k in knees.items())
    white = all(_slope_is_white(s) for s in slopes.values())
    return Card(
        "Allan slope",
        ", ".join(with_error(s["slope"], s.get("slope_err")) for s in slopes.values()),
        f"{', '.join(slopes)}; white noise: −0.5; {at or 'no knee'}",
        GOOD if white and not knees else CHECK,
    )


def _slope_is_white(measured: Mapping[str, Any]) -> bool:
    error = measured.get("slope_err") or 0.0
    return bool(abs(measured["slope"] + 0.5) <= max(3 * error, 0.02))


def _mask_card(contents: Contents) -> Card:
    flags = contents.flags or contents.detector.flags
    if flags is None:
        return Card("masked pixels", "–", "not measured", CHECK)
    whole = flags.shape[0] * flags.shape[1]
    shown, part = f"{number(flags.masked)} of {number(whole)}", flags.masked / whole
    return Card("masked pixels", share(flags.masked, whole), shown, _level(part, 0.01, 0.1))


def findings(contents: Contents) -> list[Finding]:
    """Findings, the most serious first."""
    made = [(CHECK, text) for text in contents.warnings]
    if contents.has_fringes and not contents.sets:
        made.append((CHECK, "the fit has not been run: there are no maps of offsets yet"))
    made += _of_sets(contents.sets)
    consistency = (contents.fit or {}).get("sets_chi2_reduced")
    if consistency is not None:
        words = "fringe sets that measure the same offsets"
        chi2 = f"reduced χ² {number(consistency)}"
        if consistency < 1.2:
            made.append((GOOD, f"{words} agree: {chi2}"))
        else:
            effect = "an effect that depends on the fringe vector is present"
            made.append((BAD, f"{words} do not agree: {chi2}; {effect}"))
    ranked = sorted(made, key=lambda f: -SEVERITY.index(f[0]))
    # With a capital letter and a full stop.
    return [Finding(level, text[:1].upper() + text[1:].rstrip(".") + ".") for level, text in ranked]


# severity, sentence with a `{}` for each value, and the values
FindingTemplate = tuple[str, str, *tuple[str, ...]]


def _of_sets(sets: Sequence[SetContents]) -> Iterator[tuple[str, str]]:
    """Findings on all fringe sets, each sentence once."""
    said: dict[tuple[str, str], dict[str, tuple[str, ...]]] = {}
    for s in sets:
        for severity, text, *values in _of_set(s.facts, s.allan):
            said.setdefault((severity, text), {})[s.name] = tuple(values)
    for (severity, text), by_set in said.items():
        columns = list(zip(*by_set.values(), strict=True))
        alike = all(len(set(column)) == 1 for column in columns)
        for n, column in enumerate(columns):
            each = [f"{v} for {name}" for name, v in zip(by_set, column, strict=True)]
            columns[n] = column if alike else (listed(each),)
        text = text.format(*(column[0] for column in columns)) if columns else text
        names = "all sets" if len(by_set) == len(sets) > 1 else f"set {', '.join(by_set)}"
        yield severity, f"{names}: {text}" if alike else text


def _of_set(facts: dict[str, Any], allan: dict[str, Any] | None) -> Iterator[FindingTemplate]:
    relative = _over_bound(facts)
    if relative is not None:
        text = "errors relative to the Cramér–Rao bound: {}"
        yield _bound_level(relative), text, number(relative, 4)
    scale = facts.get("sigma_scale")
    if scale is not None and abs(scale - 1) > 0.02:
        yield (
            _level(abs(scale - 1), 0.02, 0.3),
            "variance of the residuals relative to the declared noise: {}. All errors were "
            "multiplied by its square root, {}. Gain or read noise may be wrong, or the model "
            "incomplete",
            number(scale**2, 4),
            number(scale, 4),
        )
    if facts.get("period_note"):
        yield CHECK, facts["period_note"]
    if facts.get("fringe_vector_moves"):
        yield CHECK, "the fringe vector varies from frame to frame; it was fitted in each frame"
    if facts.get("model") == "hyperbolic":
        yield from _of_geometry(facts)
    if facts.get("batch_note") and allan is None:
        yield CHECK, facts["batch_note"]
    yield from _of_allan(allan)
    yield from _of_target(facts)


def _of_geometry(facts: dict[str, Any]) -> Iterator[FindingTemplate]:
    """Why the fringes are hyperbolic, and whether the fitted bench geometry is plausible."""
    if facts.get("evidence"):
        yield GOOD, "the fringes were fitted as hyperbolic: {}", facts["evidence"]
    else:
        yield GOOD, "the fringes were fitted as hyperbolic"
    geometry = facts.get("geometry", {})
    for axis in ("x", "y"):
        centre = geometry.get(f"centre_{axis}_mm")
        nominal = geometry.get(f"centre_{axis}_nominal_mm")
        if centre is None or nominal is None or abs(centre - nominal) <= FAR_MM:
            continue
        yield (
            CHECK,
            f"the fit places the fibres {{}} from their nominal position along {axis}. If the "
            "bench is better aligned, the fit mistook large-scale detector structure (such as "
            "stitching) for curvature of the fringes. Compare with --model paraxial",
            f"{number(abs(centre - nominal))} mm",
        )


def _of_allan(measured: dict[str, Any] | None) -> Iterator[FindingTemplate]:
    if measured is None:
        yield CHECK, "the Allan deviation has not been measured"
        return
    for text in measured.get("warnings") or ():
        yield CHECK, f"Allan deviation: {text}"
    if measured.get("slope") is None:
        return
    law = "with the square root of the number of frames"
    if (knee := measured.get("knee_frames")) is not None:
        yield (
            CHECK,
            f"beyond {{}} the Allan deviation no longer falls {law}: the bench or the detector "
            "drifts",
            f"{number(round(knee))} frames",
        )
    elif _slope_is_white(measured):
        yield GOOD, f"the Allan deviation falls {law}, over all averaging lengths"
    else:
        slope = with_error(measured["slope"], measured.get("slope_err"))
        yield CHECK, "the Allan deviation falls with slope {}, not −0.5", slope


def _of_target(facts: dict[str, Any]) -> Iterator[FindingTemplate]:
    """Frames needed for the target precision, if photon noise is the limit."""
    sigma, frames = facts.get("sigma_median_px"), facts.get("frames")
    target = f"{number(TARGET_PX, 1)} px"
    if not sigma or not frames:
        return
    if sigma <= TARGET_PX:
        yield GOOD, f"reaches the target of {target}"
        return
    needed = frames * (sigma / TARGET_PX) ** 2
    pace = facts.get("batch_period_s")
    time = f" ({duration(needed * pace)} at this rate)" if pace else ""
    yield (
        GOOD,
        f"the target of {target} needs {{}}, if the error keeps falling as 1/√N",
        f"{number(needed, 2)} frames{time}",
    )


def _over_bound(facts: Mapping[str, Any]) -> float | None:
    return ratio(facts.get("sigma_median_px"), facts.get("crb_median_px"))


def _bound_level(value: float | None) -> str:
    """Severity of errors over their bound; below it the declared noise is too large."""
    return CHECK if value is not None and value < 0.98 else _level(value, 1.1, 1.5)


def _level(value: float | None, good: float, tolerable: float) -> str:
    if value is None or not np.isfinite(value):
        return CHECK
    return GOOD if value <= good else CHECK if value <= tolerable else BAD
