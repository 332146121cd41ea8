"""The commands as functions: the same stages, options and artefacts.

Stages are imported when they are called, as the shell commands do: to open a run is quick.
"""

import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from pixcal.api.keywords import function_of
from pixcal.api.opened import Run, open_run
from pixcal.engine.run import Runtime
from pixcal.model import options as of
from pixcal.model.config import StrPath
from pixcal.storage.manifest import read_json

Json = dict[str, Any]


def _call(stage: str, *args: Any, **values: Any) -> Any:
    return import_module(f"pixcal.stages.{stage}").run(*args, **values)


def _all_steps(acquisition: StrPath, out: StrPath, options: of.Run, runtime: Runtime) -> Run:
    notes: list[str] = []
    _call("chain", Path(acquisition), Path(out), options, runtime, note=notes.append)
    for note in notes:
        warnings.warn(note, stacklevel=3)
    return open_run(out)


def _ingest(acquisition: StrPath, out: StrPath, options: of.Ingest, runtime: Runtime) -> Run:
    _call("ingest", Path(acquisition), Path(out), options, runtime)
    return open_run(out)


def _step(stage: str) -> Callable[..., Run]:
    """A step of a run."""

    def body(run: StrPath, options: Any, runtime: Runtime) -> Run:
        corrected = getattr(options, "with_diagnosis", False)
        _call("correct" if corrected else stage, Path(run), options, runtime)
        return open_run(run)

    return body


def _json_of(stage: str, file: str) -> Callable[..., Json]:
    """A step whose result is a file of the run."""

    def body(run: StrPath, options: Any, runtime: Runtime) -> Json:
        _call(stage, Path(run), options, runtime)
        contents: Json = read_json(Path(run) / stage / file)
        return contents

    return body


def _compare(runs: Sequence[StrPath], out: StrPath, options: of.Compare, runtime: Runtime) -> Json:
    _call("compare", [Path(one) for one in runs], Path(out), options, runtime)
    contents: Json = read_json(Path(out) / "compare.json")
    return contents


def _budget(bench: StrPath, options: of.Budget, out: StrPath | None) -> Json:
    plan: Json = _call("budget", Path(bench), options, None if out is None else Path(out))
    return plan


def _simulate(bench: StrPath, out: StrPath, options: of.Simulate, runtime: Runtime) -> Path:
    _call("simulate", Path(bench), Path(out), options, runtime)
    return Path(out)


run = function_of(
    of.Run,
    "run",
    _all_steps,
    "a file, key or option is wrong. A diagnosis or correction that is not possible is a warning",
    "Run\n    Without fringes in the acquisition it holds only what was measured of the detector.",
)
ingest = function_of(of.Ingest, "ingest", _ingest, "a file, key or option is wrong")
reduce = function_of(
    of.Reduce,
    "reduce",
    _step("reduce"),
    "the run was not ingested, or its gain is to be measured and cannot be",
)
fit = function_of(
    of.Fit,
    "fit",
    _step("fit"),
    "the run was not reduced, was not diagnosed (for ``with_diagnosis``), or holds no fringes that "
    "can be fitted",
)
allan = function_of(
    of.Allan,
    "allan",
    _step("allan"),
    "the run was not fitted, or a region is not inside its window",
)
write_report = function_of(
    of.Report,
    "write_report",
    _step("report"),
    "the run was not reduced",
    "Run\n    Its ``report`` is the page.",
)
crests = function_of(
    of.Crests,
    "crests",
    _json_of("crests", "crests.json"),
    "the run was not reduced, or a set has too few fringes",
    "dict\n    Contents of ``crests.json``.",
)
diagnose = function_of(
    of.Diagnose,
    "diagnose",
    _json_of("diagnose", "diagnosis.json"),
    "the run was not reduced, or an effect is not known",
    "dict\n    Contents of ``diagnosis.json``.",
)
astrometry = function_of(
    of.Astrometry,
    "astrometry",
    _json_of("astrometry", "astrometry.json"),
    "the run was not fitted, or the truth is not that of this detector",
    "dict\n    Contents of ``astrometry.json``.",
)
compare = function_of(
    of.Compare,
    "compare",
    _compare,
    "a run was not fitted, or the windows differ",
    "dict\n    Contents of ``compare.json``; pictures are beside it in ``out``.",
)
budget = function_of(
    of.Budget,
    "budget",
    _budget,
    "the bench cannot be read, or its frames determine nothing",
    "dict\n    Contents of ``budget.json``; with ``out`` it goes there, with ``budget.png``.",
)
simulate = function_of(
    of.Simulate,
    "simulate",
    _simulate,
    "the bench is wrong, or a directory holds what simulate did not put there",
    "Path\n    The acquisition.",
)
