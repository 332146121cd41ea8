"""The commands as functions: the same stages, options and artefacts.

Each is written with its options as one dataclass, and called with its fields as keywords
(`function_of`). Stages are imported when they are called, as the shell commands do: to open a run
is quick.
"""

import warnings
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

from pixcal.api.keywords import function_of
from pixcal.api.opened import Run, open_run
from pixcal.engine.run import Runtime
from pixcal.model import options as of
from pixcal.model.config import StrPath
from pixcal.model.errors import InputError
from pixcal.storage.artefact import read_json

Json = dict[str, Any]


def _stage(name: str) -> Any:
    return import_module(f"pixcal.stages.{name}")


def _json(file: Path) -> Json:
    contents: Json = read_json(file)
    return contents


@function_of(of.Run)
def run(
    acquisition: StrPath, out: StrPath, options: of.Run, *, runtime: Runtime | None = None
) -> Run:
    """Run all steps, from an acquisition to corrected maps and the report, as ``pixcal run``.

    Returns
    -------
    Run
        Without fringes in the acquisition, only the detector's side of it is there.

    Raises
    ------
    InputError
        In one line, with the file, key or option that is wrong. A diagnosis or correction
        that is not possible is a warning.
    """
    notes: list[str] = []
    _stage("chain").run(
        Path(acquisition), Path(out), options, runtime or Runtime(), note=notes.append
    )
    for note in notes:
        warnings.warn(note, stacklevel=3)
    return open_run(out)


@function_of(of.Ingest)
def ingest(
    acquisition: StrPath, out: StrPath, options: of.Ingest, *, runtime: Runtime | None = None
) -> Run:
    """Check and catalogue every frame of an acquisition.

    Raises
    ------
    InputError
        If a file, key or option is wrong.
    """
    _stage("ingest").run(Path(acquisition), Path(out), options, runtime or Runtime())
    return open_run(out)


@function_of(of.Reduce)
def reduce(run: StrPath, options: of.Reduce, *, runtime: Runtime | None = None) -> Run:
    """Measure the detector and write the fringes in electrons.

    Raises
    ------
    InputError
        If the run was not ingested, or its gain is to be measured and cannot be.
    """
    _stage("reduce").run(Path(run), options, runtime or Runtime())
    return open_run(run)


@function_of(of.Fit)
def fit(run: StrPath, options: of.Fit, *, runtime: Runtime | None = None) -> Run:
    """Fit the fringes and write the maps of the offsets.

    Raises
    ------
    InputError
        If the run was not reduced, or holds no fringes that can be fitted; with a diagnosis, if
        there is none.
    """
    if options.own and not options.with_diagnosis:
        raise InputError("pixcal.fit: own: has an effect only with with_diagnosis; give both")
    name = "correct" if options.with_diagnosis else "fit"
    _stage(name).run(Path(run), options, runtime or Runtime())
    return open_run(run)


@function_of(of.Allan)
def allan(run: StrPath, options: of.Allan, *, runtime: Runtime | None = None) -> Run:
    """Measure how the error falls with the number of frames (paper, section 4.3).

    Raises
    ------
    InputError
        If the run was not fitted, or a region is not inside its window.
    """
    _stage("allan").run(Path(run), options, runtime or Runtime())
    return open_run(run)


@function_of(of.Report)
def write_report(run: StrPath, options: of.Report, *, runtime: Runtime | None = None) -> Run:
    """Write the report of a run, one self-contained HTML page, as ``pixcal report``.

    Returns
    -------
    Run
        Its ``report`` is the page.

    Raises
    ------
    InputError
        If the run was not reduced.
    """
    _stage("report").run(Path(run), options, runtime or Runtime())
    return open_run(run)


@function_of(of.Crests)
def crests(run: StrPath, options: of.Crests, *, runtime: Runtime | None = None) -> Json:
    """Locate the fibres from the paths of crests and valleys (paper, equation 7).

    Returns
    -------
    dict
        Contents of ``crests.json``.

    Raises
    ------
    InputError
        If the run was not reduced, or a set has too few fringes.
    """
    _stage("crests").run(Path(run), options, runtime or Runtime())
    return _json(Path(run) / "crests" / "crests.json")


@function_of(of.Diagnose)
def diagnose(run: StrPath, options: of.Diagnose, *, runtime: Runtime | None = None) -> Json:
    """Find where data and simulation differ, which effect causes it, and the residual gap.

    Returns
    -------
    dict
        Contents of ``diagnosis.json``.

    Raises
    ------
    InputError
        If the run was not reduced, or an effect is not known.
    """
    _stage("diagnose").run(Path(run), options, runtime or Runtime())
    return _json(Path(run) / "products" / "diagnosis.json")


@function_of(of.Astrometry)
def astrometry(run: StrPath, options: of.Astrometry, *, runtime: Runtime | None = None) -> Json:
    """Estimate how much the maps improve star centroids (paper, section 2).

    Returns
    -------
    dict
        Contents of ``astrometry.json``.

    Raises
    ------
    InputError
        If the run was not fitted, or the truth is not that of this detector.
    """
    _stage("astrometry").run(Path(run), options, runtime or Runtime())
    return _json(Path(run) / "products" / "astrometry.json")


@function_of(of.Compare)
def compare(
    runs: Sequence[StrPath], out: StrPath, options: of.Compare, *, runtime: Runtime | None = None
) -> Json:
    """Compare maps of the same pixels, scale by scale.

    Returns
    -------
    dict
        Contents of ``compare.json``; beside it in ``out`` lie pictures.

    Raises
    ------
    InputError
        If a run was not fitted, or the windows differ.
    """
    _stage("compare").run([Path(one) for one in runs], Path(out), options, runtime or Runtime())
    return _json(Path(out) / "compare.json")


@function_of(of.Budget)
def budget(bench: StrPath, options: of.Budget, *, out: StrPath | None = None) -> Json:
    """Plan an exposure: frames and hours for a given precision (Cramér-Rao bound).

    Returns
    -------
    dict
        Contents of ``budget.json``, which goes into ``out`` (if given) with ``budget.png``.

    Raises
    ------
    InputError
        If the bench cannot be read, or its frames determine nothing.
    """
    result: Json = _stage("budget").run(Path(bench), options, None if out is None else Path(out))
    return result


@function_of(of.Simulate)
def simulate(
    bench: StrPath, out: StrPath, options: of.Simulate, *, runtime: Runtime | None = None
) -> Path:
    """Simulate a bench; write an acquisition and, in a separate directory, its truth.

    Returns
    -------
    Path
        The acquisition.

    Raises
    ------
    InputError
        If the bench is wrong, or a directory holds what simulate did not put there.
    """
    _stage("simulate").run(Path(bench), Path(out), options, runtime or Runtime())
    return Path(out)
