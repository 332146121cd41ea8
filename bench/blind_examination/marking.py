"""``pixcal blind score``: open the seal and compare every case with its truth."""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from blind_examination.benches import LAYOUTS
from blind_examination.draw import LEFT_OUT, ONE
from blind_examination.grade import Grade, grade
from blind_examination.manifest import FILE, RUNS, ExaminationManifest, purpose_of, read_manifest
from blind_examination.offsets import offset_errors
from blind_examination.options import ScoreConfig
from blind_examination.oracle import Oracle, ask_oracle
from blind_examination.running import DIAGNOSIS, DONE, FAILED, PRODUCTS, share
from blind_examination.seal import Sealed, read_seal
from blind_examination.summary import PLACE, median, summary
from blind_examination.table import around_table, as_markdown, write_between
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.errors import DamagedError, InputError, PixcalError, PlanError
from pixcal.storage.manifest import read_json, write_json

SCHEMA = "pixcal/blind-score/4"
_TIMED = ("diagnosis", "maps")


def score(folder: Path, sealed: Path, config: ScoreConfig, runtime: Runtime) -> dict[str, Any]:
    """Score an examination: ``score.json``, also returned, and ``score.md`` in its folder.

    Cases that were not run yet count as missing and are not scored. InputError if the truth does
    not belong to the cases, no case was run, or examinations of several sizes are given.
    """
    exams = [(folder, sealed), *config.also]
    _require_alike([own for own, _ in exams])
    if config.write is not None:
        # Check this first, as scoring takes minutes.
        around_table(config.write, read_manifest(folder).size)
    marked = [_marked(own, truth, config, runtime) for own, truth in exams]
    named = [one.named(apart=len(marked) > 1) for one in marked]
    missing = [case for _, own in named for case in own]
    seeds = [one.opened.examination.seed for one in marked]
    purposes = {purpose_of(seed) for seed in seeds}
    result = summary([g for grades, _ in named for g in grades]) | {
        "schema": SCHEMA,
        "purpose": "development" if "development" in purposes else "examination",
        # With the seed, anybody could draw the cases still to be run.
        "seed": None if missing else seeds[0] if len(seeds) == 1 else seeds,
        "size": marked[0].manifest.size,
        "made": sum(len(one.manifest.cases) for one in marked),
        "missing": missing,
        "runs": _summary_of_runs(
            [one.folder / RUNS / g.case for one in marked for g in one.grades]
        ),
        "notes": list(dict.fromkeys(n for one in marked for n in one.opened.examination.notes)),
    }
    write_json(folder / "score.json", result)
    text = as_markdown(result)
    (folder / "score.md").write_text(text, encoding="utf-8")
    if config.write is not None:
        write_between(config.write, result["size"], text)
    return result


def _require_alike(folders: Sequence[Path]) -> None:
    """Refuse examinations that cannot be scored together."""
    manifests = [read_manifest(folder) for folder in folders]
    for folder, manifest in zip(folders, manifests, strict=True):
        if manifest.size != manifests[0].size:
            raise InputError(
                f"--also {folder}: of size {manifest.size}, {folders[0]} of {manifests[0].size}; "
                "score them separately"
            )
    if len({manifest.commitment for manifest in manifests}) < len(manifests):
        raise InputError("--also: an examination is given twice; name each once")


@dataclass(frozen=True)
class _Marked:
    """An examination with its truth and grades."""

    folder: Path
    manifest: ExaminationManifest
    opened: Sealed
    grades: list[Grade]
    missing: list[str]

    def named(self, apart: bool) -> tuple[list[Grade], list[str]]:
        """Grades, and missing cases; with the folder's name if there are several folders."""
        if not apart:
            return self.grades, self.missing
        place = self.folder.resolve().name
        return (
            [replace(g, case=f"{place}/{g.case}") for g in self.grades],
            [f"{place}/{case}" for case in self.missing],
        )


def _marked(folder: Path, sealed: Path, config: ScoreConfig, runtime: Runtime) -> _Marked:
    manifest = read_manifest(folder)
    opened = read_seal(sealed, manifest.commitment)
    if len(manifest.cases) != len(opened.examination.truths):
        raise InputError(
            f"{folder / FILE}: lists {len(manifest.cases)} cases, --sealed {sealed} of "
            f"{len(opened.examination.truths)}; one of the two files is damaged"
        )
    # Diagnosed, or failed.
    done = [
        n
        for n, name in enumerate(manifest.cases)
        if any((folder / RUNS / name / file).is_file() for file in (DIAGNOSIS, FAILED))
    ]
    if not done:
        raise InputError(f"{folder}: no case was diagnosed; run 'pixcal blind run {folder}'")
    grades = run_tasks(partial(_graded, folder, manifest, opened), done, runtime, label="score")
    if config.oracle:
        grades = _with_oracle(folder, opened, dict(zip(done, grades, strict=True)), config, runtime)
    missing = [name for n, name in enumerate(manifest.cases) if n not in done]
    return _Marked(folder, manifest, opened, grades, missing)


@contextmanager
def _understood(file: Path) -> Iterator[None]:
    """Turn errors in the contents of a case's file into an error that names the file."""
    try:
        yield
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        damaged = DamagedError(file, f"damaged ({reason:.200})")
        case = next(up for up in file.parents if up.parent.name == RUNS)
        damaged.advice = f"remove {case} and run 'pixcal blind run {case.parents[1]}'"
        raise damaged from error


def _graded(folder: Path, manifest: ExaminationManifest, opened: Sealed, number: int) -> Grade:
    name, truth = manifest.cases[number], opened.examination.truths[number]
    run_dir = folder / RUNS / name
    if not (run_dir / DIAGNOSIS).is_file():
        with _understood(run_dir / FAILED):
            return grade(name, truth, None, str(read_json(run_dir / FAILED)["error"]))
    with _understood(run_dir / DIAGNOSIS):
        graded = grade(name, truth, read_json(run_dir / DIAGNOSIS))
    if not (run_dir / PRODUCTS / "correction.json").is_file():
        return graded
    with _understood(run_dir / PRODUCTS / "correction.json"):
        errors = offset_errors(
            run_dir / PRODUCTS, folder / name, truth, opened.benches[number], LAYOUTS[manifest.size]
        )
    return replace(graded, offsets=errors)


def _summary_of_runs(cases: Sequence[Path]) -> dict[str, Any]:
    """Versions of the code that diagnosed the cases, their times, and failures.

    There should be one version: after changes with part of the seal open, it is not blind.
    """
    files = [case / DONE for case in cases]
    runs = [_case_run(file) for file in files if file.is_file()]
    return {
        "codes": sorted({one["code"] for one in runs}),
        "median_seconds": {what: median(one[what] for one in runs) for what in _TIMED},
        "without_maps": sum(one["no_maps"] for one in runs),
    }


def _case_run(file: Path) -> dict[str, Any]:
    with _understood(file):
        one = read_json(file)
        seconds = {what: float(one["seconds"][what]) for what in _TIMED}
        return {"code": str(one["code"]), "no_maps": bool(one["no_maps"]), **seconds}


def _with_oracle(
    folder: Path, opened: Sealed, grades: Mapping[int, Grade], config: ScoreConfig, runtime: Runtime
) -> list[Grade]:
    """Grades with the gap that true effects close, for a number of cases of parts 1 and 4."""
    numbers = [n for n, g in grades.items() if g.part in (ONE, LEFT_OUT) and g.verdict != "failed"][
        : config.oracle
    ]
    size = opened.examination.size
    over, each = share("simulating the true effects", size, len(numbers), runtime)
    ask = partial(_oracle, folder, opened, {n: grades[n].case for n in numbers}, each)
    answers = run_tasks(ask, numbers, over, label="true effects")
    by_number = dict(grades)
    for number, answer in zip(numbers, answers, strict=True):
        if answer is not None:
            by_number[number] = _beside(by_number[number], answer)
    return list(by_number.values())


def _beside(graded: Grade, answer: Oracle) -> Grade:
    if graded.part == ONE:
        return replace(graded, oracle=answer.closed)
    first = graded.worst[0] if graded.worst else {"statistic": "", "set": ""}
    right = (first["statistic"], first["set"]) in answer.causes
    return replace(graded, oracle=answer.closed, marks=graded.marks | {PLACE: right})


def _oracle(
    folder: Path, opened: Sealed, cases: Mapping[int, str], runtime: Runtime, number: int
) -> Oracle | None:
    truth, bench = opened.examination.truths[number], opened.benches[number]
    case = cases[number]
    try:
        return ask_oracle(folder / case, folder / RUNS / case / "diagnose", truth, bench, runtime)
    except PlanError:
        raise
    except PixcalError:
        return None
