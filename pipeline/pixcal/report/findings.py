"""Findings on the fringe sets: what departs from what was declared or is expected."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from pixcal.report.contents import Contents, SetContents
from pixcal.report.diagnosis_words import listed
from pixcal.report.text import duration, number, ratio, with_error

TARGET_PX = 5e-5  # target precision of a calibration (paper, section 4.2)

# offset of the fibres that a laboratory would notice: twice its 2 cm (paper, section 5.2)
FAR_MM = 40.0

GOOD, CHECK, BAD = SEVERITY = ("good", "check", "bad")


class Finding(NamedTuple):
    """One sentence and its severity (``good``, ``check`` or ``bad``)."""

    level: str
    text: str


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
    relative = over_bound(facts)
    if relative is not None:
        text = "errors relative to the Cramér–Rao bound: {}"
        yield bound_level(relative), text, number(relative, 4)
    scale = facts.get("sigma_scale")
    if scale is not None and abs(scale - 1) > 0.02:
        yield (
            severity(abs(scale - 1), 0.02, 0.3),
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
    elif slope_is_white(measured):
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


def over_bound(facts: Mapping[str, Any]) -> float | None:
    """Ratio of the median error to the Cramér-Rao bound."""
    return ratio(facts.get("sigma_median_px"), facts.get("crb_median_px"))


def bound_level(value: float | None) -> str:
    """Severity of errors over their bound; below it the declared noise is too large."""
    return CHECK if value is not None and value < 0.98 else severity(value, 1.1, 1.5)


def severity(value: float | None, good: float, tolerable: float) -> str:
    """Severity of a value, from the limits for good and tolerable ones."""
    if value is None or not np.isfinite(value):
        return CHECK
    return GOOD if value <= good else CHECK if value <= tolerable else BAD


def slope_is_white(measured: Mapping[str, Any]) -> bool:
    """Whether the slope of the Allan deviation is that of white noise."""
    error = measured.get("slope_err") or 0.0
    return bool(abs(measured["slope"] + 0.5) <= max(3 * error, 0.02))
