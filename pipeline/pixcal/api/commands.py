"""The commands as functions: the same stages, options and artefacts.

The keywords of a function are the fields of the dataclass of its command's options.

Stages are imported when they are called, so that opening a run is quick.
"""

import functools
import inspect
import operator
import warnings
from collections.abc import Callable, Sequence
from dataclasses import fields
from importlib import import_module
from inspect import Parameter
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pixcal.api.opened import Run, open_run
from pixcal.engine.run import Runtime
from pixcal.model import options as of
from pixcal.model.config import StrPath, meanings, parse
from pixcal.storage.manifest import read_json

Json = dict[str, Any]
T = TypeVar("T")

# type and meaning of the arguments that are not options
_ARGUMENTS: dict[str, tuple[Any, str]] = {
    "acquisition": (StrPath, "str or path\n    Directory with ``acquisition.yaml``."),
    "bench": (StrPath, "str or path\n    Bench file (schema ``pixcal/bench/1``)."),
    "run": (StrPath, "Run, str or path\n    A run directory."),
    "runs": (
        Sequence[StrPath],
        "sequence of Run, str or path\n    Fitted runs; one alone is compared with itself.",
    ),
    "out": (StrPath, "str or path\n    Directory of the results; created if missing."),
    "runtime": (Runtime, "Runtime, optional\n    Where and with how much memory tasks run."),
}


def _call(stage: str, *args: Any, **values: Any) -> Any:
    return import_module(f"pixcal.stages.{stage}").run(*args, **values)


def _all_steps(acquisition: StrPath, out: StrPath, options: of.Run, runtime: Runtime) -> Run:
    notes: list[str] = []
    _call("whole_run", Path(acquisition), Path(out), options, runtime, note=notes.append)
    for note in notes:
        warnings.warn(note, stacklevel=3)
    return open_run(out)


def _ingest(acquisition: StrPath, out: StrPath, options: of.Ingest, runtime: Runtime) -> Run:
    _call("ingest", Path(acquisition), Path(out), options, runtime)
    return open_run(out)


def _step(stage: str) -> Callable[..., Run]:
    def body(run: StrPath, options: Any, runtime: Runtime) -> Run:
        corrected = getattr(options, "with_diagnosis", False)
        _call("correct" if corrected else stage, Path(run), options, runtime)
        return open_run(run)

    return body


def _compare(runs: Sequence[StrPath], out: StrPath, options: of.Compare, runtime: Runtime) -> Json:
    _call("compare", [Path(one) for one in runs], Path(out), options, runtime)
    return dict(read_json(Path(out) / "compare.json"))


def _budget(bench: StrPath, options: of.Budget, out: StrPath | None) -> Json:
    return dict(_call("budget", Path(bench), options, None if out is None else Path(out)))


def _simulate(bench: StrPath, out: StrPath, options: of.Simulate, runtime: Runtime) -> Path:
    _call("simulate", Path(bench), Path(out), options, runtime)
    return Path(out)


def function_of(
    kind: type, body: Callable[..., T], fails: str, returns: str = "", name: str = ""
) -> Callable[..., T]:
    """The function of a command, which takes the fields of its options as keywords.

    Arguments are checked like the keys of a file. Signature and docstring list every option; type
    checkers find them in ``pixcal/__init__.pyi``, which ``make doc-pages`` writes.

    Parameters
    ----------
    kind : of the options; its docstring says what the command does
    body : called by keywords, ``options`` and ``runtime`` among them; parameters after ``options``
        can only be given by name
    fails : when the function raises InputError
    returns : what it returns, where that is not simply the run
    name : of the function, where that is not the one of its options
    """
    name = name or kind.__name__.lower()
    declared, hints = inspect.signature(body), get_type_hints(kind)
    options, names = {f.name: f for f in fields(kind)}, list(declared.parameters)
    meaning = meanings(kind)
    before, after = names[: names.index("options")], names[names.index("options") + 1 :]

    def keyword(name: str, hint: Any, default: Any = None) -> Parameter:
        return Parameter(name, Parameter.KEYWORD_ONLY, default=default, annotation=hint)

    parameters = [declared.parameters[n].replace(annotation=_ARGUMENTS[n][0]) for n in before]
    parameters += [keyword(n, accepted(hints[n]), f.default) for n, f in options.items()]
    parameters += [keyword(n, _ARGUMENTS[n][0] | None) for n in after]
    signature = declared.replace(parameters=parameters)

    def function(*args: Any, **values: Any) -> T:
        bound = signature.bind(*args, **values).arguments
        chosen = {n: bound.pop(n) for n in options if n in bound}
        bound["options"] = parse(kind, chosen, f"pixcal.{name}")
        if "runtime" in after:
            bound["runtime"] = bound.get("runtime") or Runtime()
        return body(**{n: bound.get(n) for n in names})

    lines = [inspect.getdoc(kind) or "", "", "Parameters", "----------"]
    for n, parameter in signature.parameters.items():
        described = f"{_words(parameter)}\n    {meaning[n]}" if n in options else ""
        lines.append(f"{n} : {described or _ARGUMENTS[n][1]}")
    lines += ["", "Returns", "-------", returns] if returns else []
    lines += ["", "Raises", "------", "InputError", f"    If {fails}."]
    function.__name__ = function.__qualname__ = name
    function.__doc__ = "\n".join(lines)
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function


def _with_json(kind: type, file: str, fails: str) -> Callable[..., Json]:
    """The function of a command whose result is a file of the run."""
    stage = kind.__name__.lower()

    def body(run: StrPath, options: Any, runtime: Runtime) -> Json:
        _call(stage, Path(run), options, runtime)
        return dict(read_json(Path(run) / stage / file))

    return function_of(kind, body, fails, f"dict\n    Contents of ``{file}``.")


def accepted(hint: Any) -> Any:
    """Type that a caller may pass for a field: any path for a Path, a sequence for a tuple."""
    if hint is Path:
        return StrPath
    arguments = get_args(hint)
    if get_origin(hint) is UnionType:
        return functools.reduce(operator.or_, map(accepted, arguments))
    if get_origin(hint) is tuple and arguments[-1] is Ellipsis:
        return Sequence[accepted(arguments[0])]  # type: ignore[misc]
    return hint


def _words(parameter: Parameter) -> str:
    """Type of a parameter as docstrings write it."""
    hint, optional = parameter.annotation, ""
    hints = [kind for kind in get_args(hint) if kind is not type(None)]
    if len(hints) < len(get_args(hint)):
        optional = ", optional"
        hint = hints[0]
    if get_origin(hint) is Literal:
        return "{" + ", ".join(f'"{word}"' for word in get_args(hint)) + "}"
    if any(get_origin(kind) is PathLike for kind in hints):
        return f"str or path{optional}"
    return inspect.formatannotation(hint).rpartition("abc.")[2] + optional


run = function_of(
    of.Run,
    _all_steps,
    "a file, key or option is wrong. A diagnosis or correction that is not possible is a warning",
    "Run\n    Without fringes in the acquisition, it holds only the measurements of the detector.",
)
ingest = function_of(of.Ingest, _ingest, "a file, key or option is wrong")
reduce = function_of(
    of.Reduce,
    _step("reduce"),
    "the run was not ingested, or its gain is to be measured and cannot be",
)
fit = function_of(
    of.Fit,
    _step("fit"),
    "the run was not reduced, was not diagnosed (for ``with_diagnosis``), or holds no fringes that "
    "can be fitted",
)
allan = function_of(
    of.Allan, _step("allan"), "the run was not fitted, or a region is not inside its window"
)
write_report = function_of(
    of.Report,
    _step("report"),
    "the run was not reduced",
    "Run\n    Its ``report`` is the page.",
    "write_report",
)
crests = _with_json(
    of.Crests, "crests.json", "the run was not reduced, or a set has too few fringes"
)
diagnose = _with_json(
    of.Diagnose, "diagnosis.json", "the run was not reduced, or an effect is not known"
)
astrometry = _with_json(
    of.Astrometry,
    "astrometry.json",
    "the run was not fitted, or the truth is not that of this detector",
)
compare = function_of(
    of.Compare,
    _compare,
    "a run was not fitted, or the windows differ",
    "dict\n    Contents of ``compare.json``; pictures are beside it in ``out``.",
)
budget = function_of(
    of.Budget,
    _budget,
    "the bench cannot be read, or its frames determine nothing",
    "dict\n    Contents of ``budget.json``, which is also written to ``out`` with ``budget.png``.",
)
simulate = function_of(
    of.Simulate,
    _simulate,
    "the bench is wrong, or a directory holds files that simulate did not write",
    "Path\n    The acquisition.",
)
