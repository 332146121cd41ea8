"""The score of an examination as Markdown, and its place on a page."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pixcal.model.errors import InputError

Plain = Mapping[str, Any]


def as_markdown(score: Plain) -> str:
    """Tables of a score: parts, confusion, failures."""
    about = f"{len(score['cases'])} cases, size {score['size']}, seed {score['seed']}"
    if score["purpose"] == "development":
        about += " — **development seed: not an examination**"
    blocks = [
        about + ".",
        _parts(score["parts"]),
        _medians(score["medians"]),
        "Named first, by what was in the data (alone in it, and a candidate):",
        _confusion(score["confusion"]),
        _failures(score["cases"]),
        *(f"{note}." for note in score["notes"]),
    ]
    return "\n\n".join(block for block in blocks if block) + "\n"


def _parts(parts: Mapping[str, Plain]) -> str:
    rows = []
    for part, facts in parts.items():
        for question, count in facts["questions"].items():
            name, right = f"{part}: {facts['title']}", f"{count['right']} of {count['of']}"
            rows.append((name, question, right, *_percent(count)))
    return _table(("part", "question", "right", "share", "95 % interval"), rows)


def _percent(count: Plain) -> tuple[str, str]:
    if count["share"] is None:
        return "", ""
    low, high = count["interval"]
    return f"{100 * count['share']:.0f} %", f"{100 * low:.0f} to {100 * high:.0f} %"


def _medians(medians: Mapping[str, float | None]) -> str:
    names = {
        "closed": "share of the gap closed",
        "oracle": "by the true effects",
        "offset_before_px": "error of the offsets before, px",
        "offset_after_px": "after, px",
    }
    known = [f"{names[n]} {v:.3g}" for n, v in medians.items() if v is not None]
    return f"Medians of part 1: {', '.join(known)}." if known else ""


def _confusion(confusion: Mapping[str, Mapping[str, int]]) -> str:
    rows = []
    for true, named in confusion.items():
        others = [f"{n} {count}" for n, count in named.items() if n != true]
        rows.append((true, sum(named.values()), named.get(true, 0), ", ".join(others)))
    return _table(("in the data", "cases", "named first", "instead"), rows)


def _failures(cases: Sequence[Plain]) -> str:
    rows = [
        (
            case["case"],
            case["part"],
            ", ".join(case["truth"]) or "nothing",
            case["way"],
            "" if case["times"] is None else f"{case['times']:.1f}",
            ", ".join(case["named"]) or case["verdict"],
            case["why"],
        )
        for case in cases
        if not case["right"]
    ]
    if not rows:
        return "No case was answered wrong."
    header = ("case", "part", "in the data", "how", "× threshold", "answer", "why")
    return "Answered wrong:\n\n" + _table(header, rows)


def _table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(str(cell).replace("|", "/") for cell in line) + " |" for line in lines
    )


def write_between(page: Path, size: str, text: str) -> None:
    """Put a table on a page, between ``<!-- blind:SIZE -->`` and ``<!-- end -->``.

    Raises
    ------
    InputError
        If the page or its marks are not there.
    """
    begin, end = f"<!-- blind:{size} -->", "<!-- end -->"
    if not page.is_file():
        raise InputError(f"--write {page}: not found")
    before, mark, rest = page.read_text(encoding="utf-8").partition(begin)
    _, closed, after = rest.partition(end)
    if not mark or not closed:
        raise InputError(f"--write {page}: has no lines {begin} and {end}; add them")
    page.write_text(f"{before}{begin}\n\n{text}\n{end}{after}", encoding="utf-8")
