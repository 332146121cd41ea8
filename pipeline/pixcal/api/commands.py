"""The commands as functions: the same stages, options and artefacts.

Each is written with its options as one dataclass, and called with its fields as keywords
(`function_of`). Stages are imported when they are called, as the shell commands do: to open a run
is quick.
"""

import functools
import inspect
import operator
import warnings
from collections.abc import Callable, Sequence
from dataclasses import Field, fields
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pixcal.api.opened import Run, open_run
from pixcal.engine.run import Runtime
from pixcal.model import options as of
from pixcal.model.config import StrPath, parse
from pixcal.model.errors import InputError
from pixcal.storage.artefact import read_json

T = TypeVar("T")
Json = dict[str, Any]

_ARGUMENTS = {
    "acquisition": "str or path\n    Directory with ``acquisition.yaml``.",
    "bench": "str or path\n    Bench file (schema ``pixcal/bench/1``).",
    "run": "Run, str or path\n    A run directory.",
    "runs": "sequence of Run, str or path\n    Fitted runs; one alone is compared with itself.",
    "out": "str or path\n    Where the result goes; made if it is not there.",
    "runtime": "Runtime, optional\n    Where and with how much memory tasks run.",
}


def function_of(kind: type) -> Callable[[Callable[..., T]], Callable[..., T]]:
    """A function that takes the fields of a dataclass as keywords, for one that takes it whole.

    What is given is checked as a file's keys are. Signature and docstring tell every option;
    type checkers find them in ``pixcal/__init__.pyi``, which ``make doc-pages`` writes.

    Parameters
    ----------
    kind : type
        Of the parameter ``options``.
    """

    def decorate(body: Callable[..., T]) -> Callable[..., T]:
        own = inspect.signature(body)
        hints = get_type_hints(kind)
        given = [p for p in own.parameters.values() if p.name != "options"]
        keywords = [
            inspect.Parameter(
                field.name,
                inspect.Parameter.KEYWORD_ONLY,
                default=field.default,
                annotation=accepted(hints[field.name]),
            )
            for field in fields(kind)
        ]
        before = [p for p in given if p.kind is not inspect.Parameter.KEYWORD_ONLY]
        signature = own.replace(parameters=[*before, *keywords, *given[len(before) :]])

        @functools.wraps(body)
        def function(*args: Any, **values: Any) -> T:
            found = signature.bind(*args, **values).arguments
            chosen = {p.name: found.pop(p.name) for p in keywords if p.name in found}
            options: Any = parse(kind, chosen, f"pixcal.{body.__name__}")
            return body(**found, options=options)

        function.__signature__ = signature  # type: ignore[attr-defined]
        function.__doc__ = _with_parameters(body.__doc__ or "", fields(kind), signature)
        return function

    return decorate


def accepted(hint: Any) -> Any:
    """What a caller may give for a field: any path for a Path, any sequence for a tuple of some."""
    if hint is Path:
        return StrPath
    arguments = get_args(hint)
    if get_origin(hint) is UnionType:
        return functools.reduce(operator.or_, map(accepted, arguments))
    if get_origin(hint) is tuple and arguments[-1] is Ellipsis:
        return Sequence[accepted(arguments[0])]  # type: ignore[misc]
    return hint


def _with_parameters(text: str, options: Sequence[Field[Any]], signature: inspect.Signature) -> str:
    """A docstring with its parameters, before what it says of results and errors."""
    told = {field.name: field for field in options}
    lines = ["Parameters", "----------"]
    for parameter in signature.parameters.values():
        name = parameter.name
        if name not in told:
            lines.append(f"{name} : {_ARGUMENTS[name]}")
            continue
        lines += [f"{name} : {_words(parameter)}", f"    {told[name].metadata['doc']}"]
    summary, _, rest = inspect.cleandoc(text).partition("\n\n")
    return "\n".join([summary, "", *lines, "", rest])


def _words(parameter: inspect.Parameter) -> str:
    """Type of a parameter as docstrings write it."""
    hint, optional = parameter.annotation, ""
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    if len(kinds) < len(get_args(hint)):
        optional = ", optional"
        hint = kinds[0]
    if get_origin(hint) is Literal:
        return "{" + ", ".join(f'"{word}"' for word in get_args(hint)) + "}"
    if any(get_origin(kind) is PathLike for kind in kinds):
        return f"str or path{optional}"
    return inspect.formatannotation(hint).rpartition("abc.")[2] + optional


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
        In one line, with the file, key or option that is wrong. What is not possible beside the
        maps (a diagnosis, a correction) is a warning.
    """
    from pixcal.stages import chain

    notes: list[str] = []
    chain.run(Path(acquisition), Path(out), options, runtime or Runtime(), note=notes.append)
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
    from pixcal.stages import ingest as stage

    stage.run(Path(acquisition), Path(out), options, runtime or Runtime())
    return open_run(out)


@function_of(of.Reduce)
def reduce(run: StrPath, options: of.Reduce, *, runtime: Runtime | None = None) -> Run:
    """Measure the detector and write the fringes in electrons.

    Raises
    ------
    InputError
        If the run was not ingested, or its gain is to be measured and cannot be.
    """
    from pixcal.stages import reduce as stage

    stage.run(Path(run), options, runtime or Runtime())
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
    from pixcal.stages import correct
    from pixcal.stages import fit as stage

    if options.own and not options.with_diagnosis:
        raise InputError("pixcal.fit: own: of use with with_diagnosis only; give that as well")
    body = correct.run if options.with_diagnosis else stage.run
    body(Path(run), options, runtime or Runtime())
    return open_run(run)


@function_of(of.Allan)
def allan(run: StrPath, options: of.Allan, *, runtime: Runtime | None = None) -> Run:
    """Measure how the error falls with the number of frames (paper, section 4.3).

    Raises
    ------
    InputError
        If the run was not fitted, or a region is not inside its window.
    """
    from pixcal.stages import allan as stage

    stage.run(Path(run), options, runtime or Runtime())
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
    from pixcal.stages import report as stage

    stage.run(Path(run), options, runtime or Runtime())
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
    from pixcal.stages import crests as stage

    stage.run(Path(run), options, runtime or Runtime())
    found: Json = read_json(Path(run) / "crests" / "crests.json")
    return found


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
    from pixcal.stages import diagnose as stage

    stage.run(Path(run), options, runtime or Runtime())
    found: Json = read_json(Path(run) / "products" / "diagnosis.json")
    return found


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
    from pixcal.stages import astrometry as stage

    stage.run(Path(run), options, runtime or Runtime())
    found: Json = read_json(Path(run) / "products" / "astrometry.json")
    return found


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
    from pixcal.stages import compare as stage

    stage.run([Path(one) for one in runs], Path(out), options, runtime or Runtime())
    found: Json = read_json(Path(out) / "compare.json")
    return found


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
    from pixcal.stages import budget as stage

    return stage.run(Path(bench), options, None if out is None else Path(out))


@function_of(of.Simulate)
def simulate(
    bench: StrPath, out: StrPath, options: of.Simulate, *, runtime: Runtime | None = None
) -> Path:
    """Simulate a bench and write an acquisition, and its truth apart from it.

    Returns
    -------
    Path
        The acquisition.

    Raises
    ------
    InputError
        If the bench is wrong, or a directory holds what simulate did not put there.
    """
    from pixcal.stages import simulate as stage

    stage.run(Path(bench), Path(out), options, runtime or Runtime())
    return Path(out)
