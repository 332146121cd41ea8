"""``pixcal blind score``: the seal is opened, and every case held against its truth."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import binomtest

from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.errors import PixcalError
from pixcal.stages.blind.draw import ONE, PARTS, SEVERAL
from pixcal.stages.blind.grade import QUESTIONS, Grade, grade
from pixcal.stages.blind.oracle import share_closed
from pixcal.stages.blind.paper import RUNS, Paper, purpose_of, read_paper
from pixcal.stages.blind.seal import Sealed, read_seal
from pixcal.stages.blind.sitting import DIAGNOSIS, FAILED
from pixcal.stages.blind.table import as_markdown, write_between
from pixcal.storage.artefact import read_json, write_json

SCHEMA = "pixcal/blind-score/1"
PRODUCT = "score.json"
TABLE = "score.md"
NOBODY = "nothing"
TWICE = 2.0
NEAR = 0.05
"""By which the share closed may differ from the oracle's."""


@dataclass(frozen=True)
class ScoreConfig:
    """Options of the command.

    Attributes
    ----------
    oracle : bool
        Simulate the true effects as well, to tell what they close.
    write : Path, optional
        Page that the table goes to, between the marks of the examination's size.
    """

    oracle: bool = False
    write: Path | None = None


def score(folder: Path, sealed: Path, config: ScoreConfig, runtime: Runtime) -> dict[str, Any]:
    """Score an examination: ``score.json`` and ``score.md`` in its folder.

    Parameters
    ----------
    folder : Path
        Of the cases.
    sealed : Path
        The truth.
    config : ScoreConfig
    runtime : Runtime

    Returns
    -------
    dict
        Contents of ``score.json``.

    Raises
    ------
    InputError
        If the truth is not the one that the cases were made with.
    """
    paper = read_paper(folder)
    opened = read_seal(sealed, paper.commitment)
    grades = _grades(folder, paper, opened)
    if config.oracle:
        grades = _with_oracle(folder, opened, grades, runtime)
    found = summary(grades) | {
        "schema": SCHEMA,
        "purpose": purpose_of(opened.examination.seed),
        "seed": opened.examination.seed,
        "size": paper.size,
        "notes": list(opened.examination.notes),
    }
    write_json(folder / PRODUCT, found)
    text = as_markdown(found)
    (folder / TABLE).write_text(text, encoding="utf-8")
    if config.write is not None:
        write_between(config.write, paper.size, text)
    return found


def _grades(folder: Path, paper: Paper, opened: Sealed) -> list[Grade]:
    grades = []
    for name, truth in zip(paper.cases, opened.examination.truths, strict=True):
        run_dir = folder / RUNS / name
        if (run_dir / DIAGNOSIS).is_file():
            grades.append(grade(name, truth, read_json(run_dir / DIAGNOSIS)))
        else:
            failed = run_dir / FAILED
            error = read_json(failed)["error"] if failed.is_file() else ""
            grades.append(grade(name, truth, None, error))
    return grades


def _with_oracle(
    folder: Path, opened: Sealed, grades: Sequence[Grade], runtime: Runtime
) -> list[Grade]:
    """Grades of parts 1 and 3 with what the true effects close."""
    numbers = [n for n, g in enumerate(grades) if g.part in (ONE, SEVERAL) and g.closed is not None]
    at_once = min(runtime.n_workers, max(len(numbers), 1))
    each = Runtime("sync", memory=runtime.memory // at_once)
    shares = run_tasks(
        partial(_oracle, folder, opened, tuple(g.case for g in grades), each),
        numbers, runtime, label="true effects",
    )  # fmt: skip
    found = list(grades)
    for number, share in zip(numbers, shares, strict=True):
        found[number] = replace(found[number], oracle=share)
    return found


def _oracle(
    folder: Path, opened: Sealed, cases: Sequence[str], runtime: Runtime, number: int
) -> float | None:
    truth, bench = opened.examination.truths[number], opened.benches[number]
    try:
        return share_closed(folder / cases[number], truth, bench, runtime)
    except PixcalError:
        return None


def summary(grades: Sequence[Grade]) -> dict[str, Any]:
    """Counts of every part, with intervals, and the confusion of causes."""
    parts = {}
    for part, title in PARTS.items():
        own = [g for g in grades if g.part == part]
        if not own:
            continue
        questions = {q: _count(g.marks[q] for g in own) for q in QUESTIONS[part]}
        if part == ONE:
            clear = [g for g in own if g.times is not None and g.times >= TWICE]
            questions["named first, from twice the threshold"] = _count(g.right for g in clear)
            questions["parameters within three errors"] = _count(
                p["within"] for g in own for p in g.parameters
            )
            questions["share closed as by the truth"] = _count(
                abs(g.closed - g.oracle) <= NEAR
                for g in own
                if g.closed is not None and g.oracle is not None
            )
        if part == SEVERAL:
            pairs = [g for g in own if len(g.truth) == 2]
            questions["pairs: both found"] = _count(g.marks["all found"] for g in pairs)
        parts[str(part)] = {"title": title, "cases": len(own), "questions": questions}
    return {
        "cases": [asdict(g) | {"right": g.right} for g in grades],
        "parts": parts,
        "confusion": confusion(grades),
        "medians": _medians(grades),
    }


def _count(answers: Iterable[bool]) -> dict[str, Any]:
    """How many are right, of how many, with an interval of 95 % (Clopper and Pearson 1934)."""
    given = list(answers)
    right, of = sum(given), len(given)
    if not of:
        return {"right": 0, "of": 0, "share": None, "interval": None}
    interval = binomtest(right, of).proportion_ci(0.95, method="exact")
    return {
        "right": right,
        "of": of,
        "share": right / of,
        "interval": [float(interval.low), float(interval.high)],
    }


def confusion(grades: Sequence[Grade]) -> dict[str, dict[str, int]]:
    """Of every effect that is alone in a case and a candidate, the causes named first."""
    table: dict[str, dict[str, int]] = {}
    for g in grades:
        if len(g.truth) > 1 or g.left_out in g.truth:
            continue
        true = g.truth[0] if g.truth else NOBODY
        silent = true if true == NOBODY and g.right else g.verdict
        first = g.named[0] if g.named else silent
        row = table.setdefault(true, {})
        row[first] = row.get(first, 0) + 1
    return {name: dict(sorted(row.items())) for name, row in sorted(table.items())}


def _medians(grades: Sequence[Grade]) -> Mapping[str, float | None]:
    """Of part 1: share closed, beside the oracle's, and errors of the offsets."""
    own = [g for g in grades if g.part == ONE]

    def median(values: Iterable[float | None]) -> float | None:
        known = [v for v in values if v is not None]
        return float(np.median(known)) if known else None

    return {
        "closed": median(g.closed for g in own),
        "oracle": median(g.oracle for g in own),
        "offset_before_px": median(g.offset_before_px for g in own),
        "offset_after_px": median(g.offset_after_px for g in own),
    }
