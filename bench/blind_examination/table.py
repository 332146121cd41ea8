"""The score of an examination as Markdown, and its place on a page."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from blind_examination.draw import PARTS, SECOND
from pixcal.model.errors import InputError

Plain = Mapping[str, Any]

# questions whose names in the score are not their words
WORDS = {
    "honest": "no false explanation",
    "nobody blamed for most": "no effect credited with most of the gap",
}
BY_STRENGTH = {"below_twice": "named first below twice the threshold", "from_twice": "from there"}


def as_markdown(score: Plain) -> str:
    """Tables of a score: the second bench, then pixcal's own draws, confusion, failures."""
    wrong = [case for case in score["cases"] if not case["right"]]
    second = {p: facts for p, facts in score["parts"].items() if int(p) in SECOND}
    own = {p: facts for p, facts in score["parts"].items() if int(p) not in SECOND}
    blocks = [_about(score)]
    if second:
        blocks += [
            "**The second bench**, which shares no code with pixcal:",
            _parts(second),
            _maps(score["second"]["maps"]),
            _effects(score["second"]["effects"], {"right": "named first"}),
        ]
    if own:
        blocks += [
            "**Self-check**: cases of pixcal's own simulator, which its diagnosis uses too:",
            _parts(own),
            _medians(score["medians"]),
            _maps(score["maps"]),
            _effects(score["effects"], BY_STRENGTH),
        ]
    blocks += [
        _confusion(score["confusion"]),
        _failures(wrong) if wrong else "No case was answered wrong.",
        *(f"{note}." for note in score["notes"]),
    ]
    return "\n\n".join(block for block in blocks if block) + "\n"


def _about(score: Plain) -> str:
    text = f"{len(score['cases'])} cases, size {score['size']}"
    if score["seed"] is not None:
        seeds = score["seed"] if isinstance(score["seed"], list) else [score["seed"]]
        text += f", seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}"
    if score["missing"]:
        text += f"; **{len(score['missing'])} of {score['made']} are not diagnosed yet**"
    if score["purpose"] == "development":
        text += " — **development seed: not an examination**"
    runs = score["runs"]
    if len(runs["codes"]) > 1:
        text += f" — **diagnosed by {len(runs['codes'])} versions of the program**"
    seconds = runs["median_seconds"]
    if seconds["diagnosis"] is not None:
        text += (
            f". Median time of a case: {seconds['diagnosis']:.0f} s, and "
            f"{seconds['maps']:.1f} s for its maps"
        )
    if runs["without_maps"]:
        text += f"; {runs['without_maps']} have no maps: the fit failed"
    return text + "."


def _parts(parts: Mapping[str, Plain]) -> str:
    rows = []
    for facts in parts.values():
        name = facts["title"].partition(": ")[2]
        for question, count in facts["questions"].items():
            if not count["of"]:
                continue
            right = f"{count['right']} of {count['of']}"
            words = WORDS.get(question, question)
            rows.append((name, words, right, *_percent(count), *_target(count)))
    header = ("part", "question", "right", "share", "95 % interval", "target", "reached")
    return _table(header, rows)


def _percent(count: Plain) -> tuple[str, str]:
    low, high = count["interval"]
    return f"{100 * count['share']:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %"


def _target(count: Plain) -> tuple[str, str]:
    if "target" not in count:
        return "", ""
    return f"≥ {100 * count['target']:.0f} %", _yes_no(count["share"] >= count["target"])


def _yes_no(reached: bool) -> str:
    return "yes" if reached else "**no**"


def _medians(medians: Mapping[str, float | None]) -> str:
    names = {"closed": "share of the gap closed", "oracle": "by the true effects"}
    known = [f"{names[n]} {v:.3g}" for n, v in medians.items() if v is not None]
    return f"Medians over the cases of one effect: {', '.join(known)}." if known else ""


def _maps(maps: Plain) -> str:
    """Errors of the offsets, in Cramér-Rao bounds."""
    if not maps["all"]["maps"]:
        return ""
    titles = {"all": "all cases of one effect", "biased": "those that the effect biases"}
    rows = []
    for which, title in titles.items():
        errors = maps[which]
        if not errors["maps"]:
            rows.append((title, 0, "", "", "", "", ""))
            continue
        of_target = (f"≤ {maps['target']}", _yes_no(errors["after"] <= maps["target"]))
        within = errors["within_target"]
        medians = (f"{errors[when]:.2f}" for when in ("before", "after"))
        few = f"{within['right']} ({_percent(within)[1]})"
        rows.append(
            (title, errors["maps"], *medians, few, *(of_target if which == "biased" else ("", "")))
        )
    header = (
        "maps along x or y",
        "number",
        "median error as fitted, bounds",
        "as corrected",
        f"at most {maps['target']} bounds",
        "target of the median",
        "reached",
    )
    return _table(header, rows)


def _effects(effects: Mapping[str, Plain], right: Mapping[str, str]) -> str:
    """A row for each effect that was alone; ``right`` gives the header of each count."""
    if not effects:
        return ""
    rows = []
    for name, facts in effects.items():
        counts = [f"{facts[k]['right']} of {facts[k]['of']}" for k in right]
        closed = "" if facts["closed"] is None else f"{facts['closed']:.2f}"
        rows.append((name, *counts, closed, *(_before_after(o) for o in facts["offsets"].values())))
    more = ("gap closed, median", "error along x, bounds", "along y")
    return _table(("one effect", *right.values(), *more), rows)


def _before_after(medians: Mapping[str, float | None]) -> str:
    before, after = medians["before"], medians["after"]
    return "" if before is None or after is None else f"{before:.2f} → {after:.2f}"


def _confusion(confusion: Mapping[str, Mapping[str, int]]) -> str:
    """Effects named first instead of the only effect in the data."""
    rows = []
    for true, named in confusion.items():
        others = [f"{n} {count}" for n, count in named.items() if n != true]
        if others:
            rows.append((true, sum(named.values()), named.get(true, 0), ", ".join(others)))
    if not rows:
        return ""
    return _table(("in the data, alone", "cases", "named first", "named instead"), rows)


def _failures(wrong: Sequence[Plain]) -> str:
    rows = [
        (
            case["case"],
            PARTS[case["part"]],
            case["variant"] or "nothing",
            "" if case["times"] is None else f"{case['times']:.1f}",
            ", ".join(_claimed(one) for one in case["claims"]) or case["verdict"],
            # The verdict is in the answer already.
            "; ".join(why for why in case["why"].split("; ") if not why.startswith("verdict")),
        )
        for case in wrong
    ]
    header = ("case", "part", "in the data", "× threshold", "answer", "why")
    return "Answered wrong:\n\n" + _table(header, rows)


def _claimed(one: Plain) -> str:
    parts = [] if one["sigmas"] is None else [f"{one['sigmas']:.1f} sigmas"]
    if one["gap_closed"] is not None:
        parts.append(f"closes {one['gap_closed']:.2f}")
    return f"{one['effect']} ({', '.join(parts)})" if parts else str(one["effect"])


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "/") for cell in line) + " |" for line in lines
    )


def write_between(page: Path, size: str, text: str) -> None:
    """Put a table on a page, between ``<!-- blind:SIZE -->`` and ``<!-- end -->``."""
    before, after = around_table(page, size)
    page.write_text(f"{before}\n\n{text}\n{after}", encoding="utf-8")


def around_table(page: Path, size: str) -> tuple[str, str]:
    """Text of a page before and after a table, marks included; InputError without them."""
    begin, end = f"<!-- blind:{size} -->", "<!-- end -->"
    if not page.is_file():
        raise InputError(f"--write {page}: not found")
    before, mark, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not mark or not closed:
        raise InputError(f"--write {page}: has no lines {begin} and {end}; add them")
    return before + begin, end + after
