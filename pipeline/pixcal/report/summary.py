"""Summary of the run: the precision reached, and the warnings."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pixcal.report import findings
from pixcal.report.contents import Contents, DiagnosisContents, SetContents
from pixcal.report.diagnosis_words import level, residual_gap
from pixcal.report.text import NAMES, NO_OFFSETS, number, share, unit, with_error

_OFF = 0.05  # relative difference of a measured value from the declared one that is shown at once


class Card(NamedTuple):
    """One key number and its reference."""

    title: str
    value: str
    detail: str
    level: str


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
            findings.GOOD if np.isfinite(sigma) else findings.BAD,
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
            yield Card(f["title"], value, unit(f["note"]), findings.GOOD)


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
    ratios = [findings.over_bound(s.facts) for s in sets]
    return Card(
        "σ / Cramér–Rao bound",
        ", ".join(number(value, 4) for value in ratios),
        f"{', '.join(s.name for s in sets)}; 1 is the limit for any unbiased estimate",
        max(map(findings.bound_level, ratios), key=findings.SEVERITY.index),
    )


def _allan_card(slopes: Mapping[str, Mapping[str, Any]]) -> Card:
    knees = {name: s["knee_frames"] for name, s in slopes.items() if s.get("knee_frames")}
    at = ", ".join(f"knee of {name} at {number(round(k))} frames" for name, k in knees.items())
    white = all(findings.slope_is_white(s) for s in slopes.values())
    return Card(
        "Allan slope",
        ", ".join(with_error(s["slope"], s.get("slope_err")) for s in slopes.values()),
        f"{', '.join(slopes)}; white noise: −0.5; {at or 'no knee'}",
        findings.GOOD if white and not knees else findings.CHECK,
    )


def _mask_card(contents: Contents) -> Card:
    flags = contents.flags or contents.detector.flags
    if flags is None:
        return Card("masked pixels", "–", "not measured", findings.CHECK)
    whole = flags.shape[0] * flags.shape[1]
    shown, part = f"{number(flags.masked)} of {number(whole)}", flags.masked / whole
    return Card(
        "masked pixels", share(flags.masked, whole), shown, findings.severity(part, 0.01, 0.1)
    )
