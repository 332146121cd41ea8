"""A function whose keywords are the fields of a dataclass of options."""

import functools
import inspect
import operator
from collections.abc import Callable, Sequence
from dataclasses import fields
from inspect import Parameter
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pixcal.engine.run import Runtime
from pixcal.model.config import StrPath, parse

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


def function_of(
    kind: type, name: str, body: Callable[..., T], fails: str, returns: str = ""
) -> Callable[..., T]:
    """The function of a command, which takes the fields of its options as keywords.

    What is given is checked as a file's keys are. Signature and docstring list every option;
    type checkers find them in ``pixcal/__init__.pyi``, which ``make doc-pages`` writes.

    Parameters
    ----------
    kind : of the options; its docstring says what the command does
    name : of the function
    body : called by keywords, ``options`` and ``runtime`` among them; parameters after ``options``
        can only be given by name
    fails : when the function raises InputError
    returns : what it returns, where that is not simply the run
    """
    declared, hints = inspect.signature(body), get_type_hints(kind)
    options, names = {f.name: f for f in fields(kind)}, list(declared.parameters)
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
        told = f"{_words(parameter)}\n    {options[n].metadata['doc']}" if n in options else ""
        lines.append(f"{n} : {told or _ARGUMENTS[n][1]}")
    lines += ["", "Returns", "-------", returns] if returns else []
    lines += ["", "Raises", "------", "InputError", f"    If {fails}."]
    function.__name__ = function.__qualname__ = name
    function.__doc__ = "\n".join(lines)
    function.__signature__ = signature  # type: ignore[attr-defined]
    return function


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
