"""Tables on the diagnosis: causes, their parameters, the statistics that differ, the residual."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pixcal.report import diagnosis_words as words
from pixcal.report.contents import DiagnosisContents
from pixcal.report.tables import Table, is_table
from pixcal.report.text import (
    chance,
    digits_apart,
    exact,
    number,
    share_by_law,
    sigmas,
    times,
    unit,
    with_error,
)

Facts = Mapping[str, Any]

SHOWN = 12  # rows of a table that are not folded
PLOTS = 3  # statistics that are drawn for each cause, and for the residual gap
LISTED = 8  # most numbers of a list that are shown individually


# Causes


def causes(result: DiagnosisContents) -> Table:
    """What each cause closes."""
    rows = []
    for rank, cause in enumerate(result.facts["causes"], 1):
        title = f"{rank}. {words.effect_title(result, cause['effect'])}"
        alone = words.with_interval(cause["gap_closed"], cause["gap_closed_interval"])
        alike = words.listed(cause["not_told_apart_from"] or ["–"], "or")
        unique = words.percent(cause["gain_over_rest"])
        rows.append([title, alone, unique, chance(cause["p_value"]), alike])
    header = ["cause", "gap closed", "unique share", "p-value", "indistinguishable from"]
    return Table("Causes", header, rows)


def about_cause(cause: Facts) -> str:
    """Description of an effect, its evidence, and its law with the share that it closes."""
    sentences = [cause["about"]]
    if evidence := cause.get("why"):
        sentences.append(f"Evidence: {evidence.rstrip('.')}.")
    if size := cause.get("sigmas"):
        sentences.append(f"Detection significance in the fitted frames: {sigmas(size)}.")
    if law := cause.get("law"):
        sentences.append(f"Law: {law}.")
    if (by_law := share_by_law(cause)) is not None:
        sentences.append(f"The law alone closes {words.percent(by_law)} of the gap.")
    return " ".join(filter(None, sentences))


def titles(result: DiagnosisContents, names: Sequence[str]) -> list[str]:
    """Titles of effects."""
    return [words.effect_title(result, name) for name in names]


def evidence(result: DiagnosisContents, cause: Facts) -> list[Facts]:
    """Curves of the statistics that are the evidence for a cause."""
    curves = {(c["statistic"], c["set"]): c for c in result.curves}
    keys = [(n["statistic"], n["set"]) for n in cause.get("given_away_by", ())[:PLOTS]]
    return [curves[key] for key in keys if key in curves]


def parameters(cause: Facts) -> Iterator[tuple[str, Table]]:
    """Parameters with their errors; lists of like mappings have tables of their own."""
    errors, values = cause["uncertainty"], cause["parameters"]
    # A replay frame by frame replaces the law, whose strengths are then zero.
    replayed = any(is_table(value) and "value" in value[0] for value in values.values())
    rows = []
    for name, value in values.items():
        shown = name in errors and value if replayed else value not in (None, [])
        if shown and not is_table(value):
            its_unit = unit(cause["units"].get(name, "")) or "–"
            meaning = cause["meanings"].get(name, "")
            rows.append([name, _fitted(name, value, errors), its_unit, meaning])
    if rows:
        header = ["parameter", "value", "unit", "meaning"]
        yield "", Table(f"Parameters of {cause['effect']}", header, rows)
    for name, value in values.items():
        if is_table(value):
            table, same = _list_of(name, value, errors)
            meaning = cause["meanings"].get(name, "")
            about = [f"{name}: {meaning}." if meaning else "", f"The same in all rows: {same}."]
            yield " ".join(filter(None, about if same else about[:1])), table


def _fitted(name: str, value: Any, errors: Facts) -> str:
    if isinstance(value, list) and not _is_long(value):
        if all(isinstance(v, float) and f"{name}[{n}]" not in errors for n, v in enumerate(value)):
            return f"{_in_short(value)} (not fitted)"
        return ", ".join(_fitted(f"{name}[{n}]", v, errors) for n, v in enumerate(value))
    if name in errors and isinstance(value, (int, float)):
        return with_error(float(value), errors[name])
    if isinstance(value, bool):
        return "yes" if value else "no"
    plain = value is None or isinstance(value, (str, list))
    return _in_short(value) if plain else f"{exact(value)} (not fitted)"


def _list_of(name: str, entries: Sequence[Facts], errors: Facts) -> tuple[Table, str]:
    """Table of a list of like mappings, and the values common to all."""
    keys = list(dict.fromkeys(key for entry in entries for key in entry))
    fitted = {k for k in keys if any(f"{name}[{n}].{k}" in errors for n in range(len(entries)))}

    def cell(n: int, key: str) -> str:
        value = entries[n].get(key)
        if key in fitted:
            return with_error(value, errors.get(f"{name}[{n}].{key}"))
        return _in_short(value)

    def alike(key: str) -> bool:
        return key not in fitted and all(e.get(key) == entries[0].get(key) for e in entries)

    same = [k for k in keys if len(entries) > 1 and alike(k)]
    columns = [k for k in keys if k not in same]
    rows = [[cell(n, k) for k in columns] for n in range(len(entries))]
    return Table(name, columns, rows), ", ".join(f"{k} = {_in_short(entries[0][k])}" for k in same)


def _is_long(value: Any) -> bool:
    long = isinstance(value, list) and len(value) > LISTED
    return long and all(isinstance(one, (int, float)) for one in value)


def _in_short(value: Any) -> str:
    """A value in full; for a long list of numbers their count, range and rms."""
    if isinstance(value, list) and not _is_long(value):
        return ", ".join(number(one) if isinstance(one, float) else exact(one) for one in value)
    if not _is_long(value):
        return exact(value)
    ends = f"{len(value)} values, {number(min(value))} to {number(max(value))}"
    rms = math.sqrt(sum(one * one for one in value) / len(value))
    return f"{ends} (rms {number(rms)})" if min(value) < 0 else ends


# Statistics


def largest(curves: Sequence[Facts]) -> list[Facts]:
    """The most significant statistics."""
    return sorted((c for c in curves if c["significance"] > 0), key=lambda c: -c["significance"])[
        :PLOTS
    ]


def differing(result: DiagnosisContents) -> list[Facts]:
    """Statistics that differ, the largest effect first."""
    differ = (c for c in result.curves if c["in_gap"] and c["significance"] > 0)
    return sorted(differ, key=lambda c: -abs(c["size"]))


def still_differing(result: DiagnosisContents) -> list[Facts]:
    """Statistics that differ with all causes, the most significant first."""
    left = [c for c in result.curves if c["significance_after"] > result.noticed]
    return sorted(left, key=lambda c: -c["significance_after"])


def worst_of_each_domain(curves: Sequence[Facts]) -> tuple[list[Facts], list[Facts]]:
    """The first `SHOWN` curves, shared among domains, and the rest; the worst domain first."""
    order = list(dict.fromkeys(c["domain"] for c in curves))
    domains = [[c for c in curves if c["domain"] == domain] for domain in order]
    ranked = sorted((rank, n) for n, d in enumerate(domains) for rank in range(len(d)))
    taken = [sum(n == of for _, n in ranked[:SHOWN]) for of in range(len(domains))]
    if len(curves) <= SHOWN + 2:
        taken = [len(d) for d in domains]
    first = [c for d, most in zip(domains, taken, strict=True) for c in d[:most]]
    return first, [c for d, most in zip(domains, taken, strict=True) for c in d[most:]]


def statistics(title: str, curves: Sequence[Facts], causes: Any) -> Table:
    """A row for each statistic: its worst value, measured and simulated."""
    after = ["with causes", "its significance (σ)", "residual"] if causes else []
    header = ["domain", "statistic", "where", "measured", "nominal", "difference / scatter"]
    header += ["significance (σ)", *after]
    return Table(title, header, [_row(c, bool(causes)) for c in curves])


def _row(curve: Facts, causes: bool) -> list[str]:
    at = words.worst(curve)
    measured, nominal = curve["measured"][at], curve["nominal"]["value"][at]
    of = "" if curve["set"] == words.DETECTOR else f"set {curve['set']}: "
    digits = digits_apart(measured, nominal)
    value = f"{number(measured, digits)} {unit(curve['unit'])}".strip()
    title = curve["title"] if curve["unit"] else f"{curve['title']} ({curve['quantity']})"
    row = [curve["domain"], title, of + words.place(curve, at), value]
    row += [number(nominal, digits), times(curve["size"]), f"{curve['significance']:.1f}"]
    if causes:
        left = words.percent(curve["left"]) if curve["in_gap"] else "new"
        after = number(curve["with_effects"]["value"][at], digits)
        row += [after, f"{curve['significance_after']:.1f}", left]
    return row


def _sigma(value: float) -> str:
    text = f"{value:+.1f}" if math.isfinite(value) else "–"
    return "0.0" if text in ("+0.0", "-0.0") else text.replace("-", "−")


def absolute(facts: Facts) -> Table:
    """The differences in physical units."""
    causes = [cause["effect"] for cause in facts["causes"]]
    each = causes if len(causes) > 1 else []
    rows = []
    for entry in facts["gap"]["absolute"]:
        digits = digits_apart(entry["measured"], entry["simulated"])
        row = [entry["quantity"], unit(entry["unit"]), number(entry["measured"], digits)]
        for key in ("simulated", "after") if causes else ("simulated",):
            ends = [number(end, digits) for end in entry.get(f"{key}_interval", ())]
            row.append(number(entry[key], digits) + (f" [{', '.join(ends)}]" if ends else ""))
        row += [number(entry.get("with_only", {}).get(name), digits) for name in each]
        rows.append(row)
    after = ["with causes", *(f"{name} only" for name in each)] if causes else []
    header = ["quantity", "unit", "measured", "nominal", *after]
    return Table("Differences in physical units (1σ intervals)", header, rows)


def by_domain(gap: Facts) -> str:
    """', 2 % in space and 1 % in noise': the residual gap by domain."""
    left = sorted(gap.get("domains", {}).items(), key=lambda d: -d[1][1])
    parts = [f"{words.percent(after)} in {domain}" for domain, (_, after) in left if after >= 5e-4]
    return f", {words.listed(parts)}" if parts else ""


# Candidates and frames


def rejected(result: DiagnosisContents) -> Table:
    """Rejected candidates, the most likely first."""
    causes = {c["effect"] for c in result.facts["causes"]}
    tried = [c for c in words.considered(result.facts) if c["effect"] not in causes]
    rows = []
    for c in sorted(tried, key=lambda c: (-c["gap_closed"], -(c.get("sigmas") or 0.0))):
        size = _sigma(c["sigmas"]) if "sigmas" in c else "–"
        closed = words.percent(c["gap_closed"]) if c.get("tried_on_unseen_frames") else "–"
        rows.append([words.effect_title(result, c["effect"]), size, closed, c["rejected_because"]])
    return Table("Rejected effects", ["effect", "significance (σ)", "gap closed", "reason"], rows)


def frames_used(facts: Facts) -> Table:
    """Frames and windows that were fitted and held out."""
    fitted, held_out = facts["fitted_on"], facts["tried_on"]
    rows = [["window", window(fitted["window"]), "; ".join(map(window, held_out["windows"]))]]
    for name in dict.fromkeys([*fitted["frames"], *held_out["frames"]]):
        rows.append([name, *(_frames(of["frames"].get(name)) for of in (fitted, held_out))])
    return Table("Frames and windows", ["", "fitted", "held out"], rows)


def window(ends: Sequence[Sequence[int]]) -> str:
    """A window in words."""
    (y0, y1), (x0, x1) = ends
    return f"rows {y0} to {y1 - 1}, columns {x0} to {x1 - 1}"


def _frames(facts: Sequence[int] | None) -> str:
    if facts is None:
        return "–"
    first, last, count = facts
    whole = count == last - first + 1
    return f"frames {first} to {last}" if whole else f"{count} of the frames {first} to {last}"
