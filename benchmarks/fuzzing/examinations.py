"""Bad input of `pixcal blind`: folders of cases and sealed files, damaged or foreign."""

import json
import os
import shutil
from functools import cache
from pathlib import Path
from typing import Any

from fuzzing.laws import RUNTIME, Broken, Case, Kind, good_input, lasting_folder, pixcal

CASES = 2
DIAGNOSIS = {
    "verdict": "no gap",
    "causes": [],
    "candidates": [],
    "gap": {"after": 1.0, "where": []},
}
DONE = '{"code": "x", "seconds": {"diagnosis": 1.0, "maps": 1.0}, "no_maps": ""}'
JUNK = (b"", b"[]", b"{}", b"null", b"3", b"\xff\xfe", b"{", b'{"schema": "pixcal/blind/1"}')


@cache
def _exams() -> tuple[Path, Path]:
    """Folders, each with an examination that was run (no gap each time) and its truth."""
    folder = lasting_folder()
    made = []
    for seed in (1, 2):
        exam, truth = folder / f"{seed}" / "exam", folder / f"{seed}" / "truth.json"
        line = ["--cases", str(CASES), "--seed", str(seed), "--size", "tiny", "--bench", "own"]
        with good_input():
            pixcal("blind", "make", *line, "--out", exam, "--sealed", truth, *RUNTIME)
        for number in range(1, CASES + 1):
            run = exam / "runs" / f"case-{number:04d}"
            (run / "products").mkdir(parents=True)
            (run / "products" / "diagnosis.json").write_text(json.dumps(DIAGNOSIS))
            (run / "done.json").write_text(DONE)
        made.append(folder / f"{seed}")
    return made[0], made[1]


def _spoil_json(case: Case, file: Path) -> None:
    """A key missing, doubled or of another type; bytes changed; unrelated content."""
    body = file.read_bytes()
    file.unlink()
    how = str(case.pick("key", "key", "value", "value", "cut", "flip", "junk", "gone", "folder"))
    if how in ("key", "value"):
        plain = json.loads(body)
        key = str(case.pick(*plain))
        if how == "key":
            del plain[key]
        else:
            values: tuple[Any, ...] = (None, [], {}, "x", -1, 1e300, ["case"], [1, 2], [None] * 3)
            plain[key] = case.pick(*values)
        body = json.dumps(plain).encode()
    elif how == "cut":
        body = body[: int(case.rng.integers(len(body)))]
    elif how == "flip":
        changed = bytearray(body)
        changed[int(case.rng.integers(len(body)))] ^= 1 << int(case.rng.integers(8))
        body = bytes(changed)
    elif how == "junk":
        body = JUNK[int(case.rng.integers(len(JUNK)))]
    if how == "folder":
        file.mkdir()
    elif how != "gone":
        file.write_bytes(body)


def _exam(case: Case) -> None:
    """An examination with one fault, to be scored or continued."""
    first, second = _exams()
    exam, truth = case.folder / "exam", case.folder / "truth.json"
    shutil.copytree(first / "exam", exam, copy_function=os.link)
    shutil.copy(first / "truth.json", truth)
    runs = sorted((exam / "runs").iterdir())
    what = str(
        case.pick(
            "paper",
            "paper",
            "paper",
            "truth",
            "truth",
            "other",
            "foreign",
            "diagnosis",
            "diagnosis",
            "done",
            "case",
            "page",
        )
    )
    more: tuple[str | Path, ...] = ()
    run = runs[int(case.rng.integers(CASES))]
    if what == "paper":
        _spoil_json(case, exam / "blind.json")
    elif what == "truth":
        _spoil_json(case, truth)
    elif what == "other":
        shutil.copy(second / "truth.json", truth)
    elif what == "foreign":
        where = case.pick(exam, exam / "runs", run, run / "products")
        assert isinstance(where, Path)
        (where / str(case.pick("case-0009", "notes.txt", ".DS_Store", "blind.json~"))).touch()
    elif what == "diagnosis":
        _spoil_json(case, run / "products" / "diagnosis.json")
    elif what == "done":
        _spoil_json(case, run / "done.json")
    elif what == "case":
        shutil.rmtree(case.pick(exam / "runs", run, exam / run.name))
    else:
        page = case.folder / "page.md"
        page.write_text(
            str(case.pick("", "<!-- blind:tiny -->", "<!-- blind:tiny -->\n<!-- end -->\n"))
        )
        more = ("--write", page)
    names = (str(exam), str(truth), "--write")
    pixcal("blind", "score", exam, "--sealed", truth, *more, *RUNTIME, names=names)
    told = json.loads((exam / "score.json").read_text())
    scored = sum(part["cases"] for part in told["parts"].values())
    if scored + len(told["missing"]) != CASES:
        raise Broken(f"{scored} cases scored, {len(told['missing'])} missing, of {CASES}")


KINDS = [Kind("blind", "damaged blind examinations", _exam, 100)]
