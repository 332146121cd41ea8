"""The section on the diagnosis: the gap between data and simulation, its causes, the residual."""

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pixcal.report import diagnosis_figures as figures
from pixcal.report import diagnosis_maps as maps
from pixcal.report.blocks import Block, Fold, Section, Words, folded, plate
from pixcal.report.contents import Contents, DiagnosisContents, EffectWords
from pixcal.report.curve_places import place
from pixcal.report.diagnosis_words import (
    DETECTOR,
    answer,
    chance,
    effect_title,
    level,
    listed,
    percent,
    residual_gap,
    unit,
    with_interval,
    worst,
)
from pixcal.report.tables import Table, is_table
from pixcal.report.text import exact, number, with_error

Facts = Mapping[str, Any]

SHOWN = 12  # rows of a table that are not folded
PLOTS = 3  # statistics that are drawn for each cause, and of what remains
LISTED = 8  # numbers of a list that are shown one by one
NEW = "introduced by the causes"
LAW_DIFFERS = 0.02  # difference of the shares closed by a cause and by its law alone that is shown

_READ = (
    "Top: data (dots) and simulations (squares or lines); error bars are ±1σ of the simulations. "
    "Bottom: residual of the data from each simulation; the band is ±2σ. "
)


def diagnosis(contents: Contents) -> Section:
    """All that ``pixcal diagnose`` found; one line where it was not run."""
    result = contents.diagnosis
    title = "Diagnosis: data compared with simulation"
    if result is None:
        lead = "Not run: run 'pixcal diagnose RUN' and then 'pixcal report RUN'."
        return Section("diagnosis", title, lead, [])
    verdict = result.facts["verdict"]
    blocks: list[Block] = [Words(answer(result), "answer", level(verdict))]
    if verdict == "no gap":
        blocks += _largest(result)
    else:
        blocks += _overview(result)
        for rank, cause in enumerate(result.facts["causes"], 1):
            blocks += _cause(rank, cause, result)
        blocks += _where(result)
        blocks += _absolute(result)
        blocks += _remainder(result)
    blocks += _candidates(result)
    blocks += _frames_used(result)
    return Section("diagnosis", title, _lead(contents), blocks)


def _lead(contents: Contents) -> str:
    """Which simulation the data were compared with."""
    fringes = contents.acquisition.get("frames", {}).get("fringes")
    bench = "straight fringes, constant light, " if fringes else ""
    given = [s.config.get("nominal") for s in contents.stages if s.name == "diagnose"]
    more = f" Included from the start: {listed(given[0])}." if given and given[0] else ""
    return (
        f"The same frames were simulated with the nominal bench: {bench}a linear detector without "
        f"lag or crosstalk, and its noise.{more} The gap is the sum of all significant differences "
        "from the data. Effects were fitted on one half of the frames and tested on the other."
    )


def _heading(text: str) -> Words:
    return Words(text, "heading")


# Overview


def _overview(result: DiagnosisContents) -> Iterator[Block]:
    gap, causes = result.facts["gap"], result.facts["causes"]
    closed = [
        figures.Closed(
            effect_title(result, c["effect"]),
            c["gap_closed"],
            tuple(c["gap_closed_interval"]),
            c["gain_over_rest"],
        )
        for c in causes
    ]
    caption = (
        "Each statistic that differs is weighted by the square of its significance; the gap of the "
        "nominal simulation is 100\u00a0%. "
    )
    if causes:
        caption += (
            "Thin lines are 90\u00a0% intervals. A cause that closes a large share alone but "
            "reopens little when removed overlaps with another cause."
        )
    yield plate("The gap", caption, figures.gap_figure(_bars(gap, bool(causes)), closed))
    if causes:
        yield _causes_table(result)


def _bars(gap: Facts, with_causes: bool) -> list[figures.Bar]:
    """All of the gap, its domains, and what differs only with the causes."""
    ends = gap["interval"]
    whole = figures.Bar("all", gap["total"], gap["after"], (ends[0], ends[1]))
    domains = gap.get("domains", {})
    parts = [figures.Bar(d, before, after) for d, (before, after) in domains.items()]
    rest = gap["after"] - sum(b.after for b in parts)
    if with_causes and parts and rest > 0.001:
        parts.append(figures.Bar(NEW, 0.0, rest))
    return [whole, *sorted(parts, key=lambda b: -b.before)]


def _causes_table(result: DiagnosisContents) -> Table:
    rows = []
    for rank, cause in enumerate(result.facts["causes"], 1):
        alike = cause["not_told_apart_from"]
        rows.append(
            [
                f"{rank}. {effect_title(result, cause['effect'])}",
                with_interval(cause["gap_closed"], cause["gap_closed_interval"]),
                percent(cause["gain_over_rest"]),
                chance(cause["p_value"]),
                listed(alike, "or") if alike else "–",
            ]
        )
    header = [
        "cause",
        "gap closed alone",
        "gap reopened when removed",
        "p-value",
        "indistinguishable from",
    ]
    return Table("Causes", header, rows)


# A cause


def _cause(rank: int, cause: Facts, result: DiagnosisContents) -> Iterator[Block]:
    name = cause["effect"]
    words = result.effects.get(name, EffectWords(""))
    yield _heading(f"Cause {rank}: {effect_title(result, name)}")
    evidence = f"Evidence: {cause['why'].rstrip('.')}." if cause.get("why") else ""
    size = cause.get("sigmas")
    significance = (
        f"Detection significance in the fitted frames: {number(size, 2)}σ." if size else ""
    )
    yield Words(" ".join(filter(None, (words.about, evidence, significance, _law(cause)))))
    alike = cause["not_told_apart_from"]
    if alike:
        others = listed((effect_title(result, other) for other in alike), "or")
        yield Words(
            f"The data cannot distinguish it from {others}."
            + _advice("Recommended frames", cause.get("would_decide")),
            "advice",
        )
    shown = _named(result, cause.get("given_away_by", ()))
    if shown:
        yield plate(
            f"Evidence for {effect_title(result, name)}",
            _READ + "These are the statistics whose likelihood improves most with this cause.",
            figures.curves_figure(shown),
        )
    yield from _parameters(cause, words)


def _law(cause: Facts) -> str:
    """The law of a cause, and what it closes by itself where that differs."""
    law, by_law = cause.get("law", ""), cause.get("gap_closed_by_law", cause["gap_closed"])
    alone = ""
    if abs(by_law - cause["gap_closed"]) > LAW_DIFFERS:
        alone = f"The law alone closes {percent(by_law)} of the gap."
    return " ".join(filter(None, (f"Law: {law}." if law else "", alone)))


def _advice(words: str, frames: Sequence[str] | None) -> str:
    """A sentence on the frames to take; empty where none are known."""
    return f" {words}: {listed(frames)}." if frames else ""


def _named(result: DiagnosisContents, names: Sequence[Facts]) -> list[Facts]:
    curves = {(c["statistic"], c["set"]): c for c in result.curves}
    keys = [(n["statistic"], n["set"]) for n in names[:PLOTS]]
    return [curves[key] for key in keys if key in curves]


def _parameters(cause: Facts, words: EffectWords) -> Iterator[Block]:
    """Parameters with their errors; lists of like mappings have tables of their own."""
    errors, parameters = cause["uncertainty"], cause["parameters"]
    rows = []
    for name, value in parameters.items():
        if is_table(value):
            continue
        its_unit, meaning = words.parameters.get(name, ("", ""))
        rows.append([name, _fitted(name, value, errors), unit(its_unit) or "–", meaning])
    if rows:
        header = ["parameter", "value", "unit", "meaning"]
        yield Table(f"Parameters of {cause['effect']}", header, rows)
    for name, value in parameters.items():
        if is_table(value):
            meaning = words.parameters.get(name, ("", ""))[1]
            table, same = _list_of(name, value, errors)
            about = f"{name}: {meaning}." if meaning else ""
            yield Words(" ".join(filter(None, (about, f"Common to all: {same}." if same else ""))))
            yield from folded(table, SHOWN, "rows")


def _fitted(name: str, value: Any, errors: Facts) -> str:
    if isinstance(value, list):
        if _is_long(value):
            return _in_short(value)
        return ", ".join(_fitted(f"{name}[{n}]", v, errors) for n, v in enumerate(value)) or "–"
    if name in errors and isinstance(value, (int, float)):
        return with_error(float(value), errors[name])
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, str):
        return value
    return f"{exact(value)} (not fitted)"


def _list_of(name: str, entries: Sequence[Facts], errors: Facts) -> tuple[Table, str]:
    """A list of like mappings, and what is the same in all of them."""
    keys = list(dict.fromkeys(key for entry in entries for key in entry))
    fitted = {k for k in keys if any(f"{name}[{n}].{k}" in errors for n in range(len(entries)))}
    constant = {k for k in keys if all(e.get(k) == entries[0].get(k) for e in entries)}
    same = [k for k in keys if k in constant - fitted and len(entries) > 1]
    columns = [k for k in keys if k not in same]
    rows = [
        [
            with_error(entry.get(k), errors.get(f"{name}[{n}].{k}")) if k in fitted
            else "–" if entry.get(k) is None else _in_short(entry[k])
            for k in columns
        ]
        for n, entry in enumerate(entries)
    ]  # fmt: skip
    notes = [f"{k} {_in_short(entries[0][k])}" for k in same]
    return Table(name, columns, rows), ", ".join(notes)


def _is_long(value: Any) -> bool:
    return (
        isinstance(value, list)
        and len(value) > LISTED
        and all(isinstance(one, (int, float)) for one in value)
    )


def _in_short(value: Any) -> str:
    """A value in full; of a long list of numbers how many there are, their range and rms."""
    if not _is_long(value):
        return exact(value)
    ends = f"{len(value)} values, {number(min(value))} to {number(max(value))}"
    rms = math.sqrt(sum(one * one for one in value) / len(value))
    return f"{ends} (rms {number(rms)})" if min(value) < 0 else ends


# Where


def _where(result: DiagnosisContents) -> Iterator[Block]:
    curves = sorted((c for c in result.curves if c["in_gap"]), key=lambda c: -c["significance"])
    if not curves:
        return
    yield _heading("Where data and simulation differ")
    causes = bool(result.facts["causes"])
    first, rest = _worst_of_each_domain(curves)
    if len(rest) <= 2:
        first, rest = _by_domain(curves), []
    header = _header(causes)
    title = "Statistics that differ, by domain, the most significant first"
    yield Table(title, header, [_row(c, causes) for c in first])
    if rest:
        rows = [_row(c, causes) for c in _by_domain(rest)]
        yield Fold(
            f"{len(rest)} more statistics that differ",
            [Table("Other statistics that differ", header, rows)],
        )
    yield from _maps(result)
    if not causes:
        yield plate(
            "The largest differences",
            _READ,
            figures.curves_figure(curves[:PLOTS], with_effects=False),
        )


def _maps(result: DiagnosisContents) -> Iterator[Block]:
    """The map of the deviations, if some parts of the detector stand out."""
    shape = result.facts.get("looked_at", {}).get("shape")
    places = result.facts["gap"].get("places", ())
    panels = maps.panels(shape, places, result.curves) if shape else []
    if not panels:
        where = "window" if places else "cell of the window"
        yield Words(f"No single {where} deviates by more than {maps.ASIDE:g} σ.")
    else:
        what = (
            "Windows tested (drawn larger than they are), with the largest deviation in each domain"
            if places
            else "Cells of the window, by statistic"
        )
        figure = maps.where_figure(shape, panels, with_after=bool(result.facts["causes"]))
        yield plate("Where on the detector", f"{what}. Numbers are deviations in σ.", figure)


def _by_domain(curves: Sequence[Facts]) -> list[Facts]:
    """Curves that are sorted, by domain: first the domain of the first."""
    order = list(dict.fromkeys(c["domain"] for c in curves))
    return sorted(curves, key=lambda c: order.index(c["domain"]))


def _worst_of_each_domain(curves: Sequence[Facts]) -> tuple[list[Facts], list[Facts]]:
    """`SHOWN` of the curves, from each domain alike as far as it has them; and the others."""
    rank = {id(c): _rank_in_domain(c, curves) for c in curves}
    chosen = {id(c) for c in sorted(curves, key=lambda c: rank[id(c)])[:SHOWN]}
    first = [c for c in curves if id(c) in chosen]
    return _by_domain(first), _by_domain([c for c in curves if id(c) not in chosen])


def _rank_in_domain(curve: Facts, curves: Sequence[Facts]) -> int:
    same = [c for c in curves if c["domain"] == curve["domain"]]
    return next(n for n, c in enumerate(same) if c is curve)


def _header(causes: bool) -> list[str]:
    after = ["with causes", "σ", "residual"] if causes else []
    return ["domain", "statistic", "where", "measured", "nominal", "σ", *after]


def _row(curve: Facts, causes: bool) -> list[str]:
    at = worst(curve)
    measured, nominal = curve["measured"][at], curve["nominal"]["value"][at]
    after = curve["with_effects"]["value"][at]
    of = "" if curve["set"] == DETECTOR else f"set {curve['set']}: "
    digits = _digits(measured, nominal)
    row = [
        curve["domain"],
        curve["title"],
        of + place(curve, at),
        f"{number(measured, digits)} {unit(curve['unit'])}".strip(),
        number(nominal, digits),
        _sigma(curve["z"][at]),
    ]
    if causes:
        left = percent(curve["left"]) if curve["in_gap"] else "new"
        row += [number(after, digits), _sigma(curve["z_after"][at]), left]
    return row


def _digits(one: float, other: float) -> int:
    """Significant digits that resolve the difference of two values."""
    size, apart = max(abs(one), abs(other)), abs(one - other)
    if not (math.isfinite(size) and apart > 0):
        return 3
    return min(max(3, 2 + math.ceil(math.log10(size / apart))), 6)


def _sigma(value: float) -> str:
    text = f"{value:+.1f}" if math.isfinite(value) else "–"
    return "0.0" if text in ("+0.0", "-0.0") else text.replace("-", "−")


def _absolute(result: DiagnosisContents) -> Iterator[Block]:
    causes = [cause["effect"] for cause in result.facts["causes"]]
    each = causes if len(causes) > 1 else []
    rows = []
    for entry in result.facts["gap"]["absolute"]:
        digits = _digits(entry["measured"], entry["simulated"])
        row = [entry["quantity"], unit(entry["unit"]), number(entry["measured"], digits)]
        for key in ("simulated", "after") if causes else ("simulated",):
            ends = [number(end, digits) for end in entry.get(f"{key}_interval", ())]
            interval = f" [{', '.join(ends)}]" if ends else ""
            row.append(number(entry[key], digits) + interval)
        row += [number(entry.get("with_only", {}).get(name), digits) for name in each]
        rows.append(row)
    if rows:
        after = ["with causes", *(f"{name} only" for name in each)] if causes else []
        header = ["quantity", "unit", "measured", "nominal", *after]
        title = "Differences in physical units (1σ intervals)"
        yield from folded(Table(title, header, rows), SHOWN, "quantities")


# Residual


def _remainder(result: DiagnosisContents) -> Iterator[Block]:
    if more := _advice("Recommended frames", result.facts.get("more_would_tell")):
        yield Words(more.strip(), "advice")
    if not result.facts["causes"]:
        return
    gap = result.facts["gap"]
    left = sorted(
        (c for c in result.curves if c["significance_after"] > result.noticed),
        key=lambda c: -c["significance_after"],
    )
    yield _heading("Residual gap")
    parts = [
        f"{percent(after)} in {domain}"
        for domain, (_, after) in sorted(gap.get("domains", {}).items(), key=lambda d: -d[1][1])
        if after >= 5e-4
    ]
    shares = f", {listed(parts)}" if parts else ""
    text = residual_gap(gap)
    sentence = f"The {text}{shares}. "
    if not left:
        yield Words(sentence + "No statistic differs significantly any more.")
        return
    one = len(left) == 1
    yield Words(
        sentence + f"{len(left)} statistic{'' if one else 's'} still "
        f"differ{'s' if one else ''} significantly."
    )
    new = [c for c in left if not c["in_gap"]]
    if new:
        yield Words(
            f"Of these, {len(new)} did not differ before: a cause predicts something that the data "
            "do not show, so it may be the wrong one.",
            "advice",
        )
    table = Table("Statistics that still differ", _header(True), [_row(c, True) for c in left])
    yield from folded(table, SHOWN, "statistics that still differ")
    yield plate("Largest residual differences", _READ, figures.curves_figure(left[:PLOTS]))


def _largest(result: DiagnosisContents) -> Iterator[Block]:
    """The largest deviations where there is no gap."""
    curves = sorted(result.curves, key=lambda c: -c["significance"])[:PLOTS]
    if not curves:
        return
    yield Table(
        "Largest deviations, none of them significant",
        _header(False),
        [_row(c, False) for c in curves],
    )
    yield plate("The largest deviations", _READ, figures.curves_figure(curves, with_effects=False))
    yield from _absolute(result)


# Candidates


def _candidates(result: DiagnosisContents) -> Iterator[Block]:
    causes = {c["effect"] for c in result.facts["causes"]}
    tried = sorted(
        (c for c in result.facts["candidates"] if c["effect"] not in causes),
        key=lambda c: (-c["gap_closed"], -(c.get("sigmas") or 0.0)),
    )
    if not tried:
        return
    rows = [
        [
            effect_title(result, c["effect"]),
            _sigma(c["sigmas"]) if "sigmas" in c else "–",
            percent(c["gap_closed"]) if c.get("tried_on_unseen_frames") else "–",
            c["rejected_because"],
        ]
        for c in tried
    ]
    header = ["effect", "significance (σ)", "gap closed alone", "reason"]
    other = " other" if result.facts["causes"] else ""
    title = f"{len(tried)}{other} effects were considered and rejected"
    yield Fold(title, [Table("Rejected effects", header, rows)])


def _frames_used(result: DiagnosisContents) -> Iterator[Block]:
    """Frames and windows that were fitted and held out."""
    facts = result.facts.get("looked_at")
    if not facts:
        return
    one, other = facts["fitted_on"], facts["tried_on"]
    rows = [["window", _window(one["window"]), "; ".join(map(_window, other["windows"]))]]
    names = dict.fromkeys([*one["frames"], *other["frames"]])
    rows += [[n, _frames(one["frames"].get(n)), _frames(other["frames"].get(n))] for n in names]
    blocks: list[Table | Words] = [Table("Frames and windows", ["", "fitted", "held out"], rows)]
    if facts.get("shared"):
        blocks.append(
            Words(
                f"Too few frames to split: {listed(facts['shared'])}. Effects were fitted and "
                "tested on the same frames there."
            )
        )
    blocks += [
        Words(f"Left out: {_window(one['window'])}. {one['reason']}")
        for one in facts.get("left_out", ())
    ]
    yield Fold("Frames and windows used", blocks)


def _window(ends: Sequence[Sequence[int]]) -> str:
    (y0, y1), (x0, x1) = ends
    return f"rows {y0} to {y1 - 1}, columns {x0} to {x1 - 1}"


def _frames(facts: Sequence[int] | None) -> str:
    if facts is None:
        return "–"
    first, last, count = facts
    if count == last - first + 1:
        return f"frames {first} to {last}"
    return f"{count} of the frames {first} to {last}"
