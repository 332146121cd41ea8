"""A function whose options are one dataclass, called with the dataclass's fields as keywords."""

import functools
import inspect
import operator
from collections.abc import Callable, Sequence
from dataclasses import Field, fields
from os import PathLike
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from pixcal.model.config import StrPath, parse

T = TypeVar("T")

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

    What is given is checked as a file's keys are. Signature and docstring list every option;
    type checkers find them in ``pixcal/__init__.pyi``, which ``make doc-pages`` writes.

    Parameters
    ----------
    kind : type
        Of the parameter ``options``.
    """

    def decorate(body: Callable[..., T]) -> Callable[..., T]:
        declared = inspect.signature(body)
        hints = get_type_hints(kind)
        given = [p for p in declared.parameters.values() if p.name != "options"]
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
        signature = declared.replace(parameters=[*before, *keywords, *given[len(before) :]])

        @functools.wraps(body)
        def function(*args: Any, **values: Any) -> T:
            bound = signature.bind(*args, **values).arguments
            chosen = {p.name: bound.pop(p.name) for p in keywords if p.name in bound}
            options: Any = parse(kind, chosen, f"pixcal.{body.__name__}")
            return body(**bound, options=options)

        function.__signature__ = signature  # type: ignore[attr-defined]
        function.__doc__ = _with_parameters(body.__doc__ or "", fields(kind), signature)
        return function

    return decorate


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


def _with_parameters(text: str, options: Sequence[Field[Any]], signature: inspect.Signature) -> str:
    """A docstring with its parameters, before what it says of results and errors."""
    fields_by_name = {field.name: field for field in options}
    lines = ["Parameters", "----------"]
    for parameter in signature.parameters.values():
        name = parameter.name
        if name not in fields_by_name:
            lines.append(f"{name} : {_ARGUMENTS[name]}")
            continue
        lines += [f"{name} : {_words(parameter)}", f"    {fields_by_name[name].metadata['doc']}"]
    summary, _, rest = inspect.cleandoc(text).partition("\n\n")
    return "\n".join([summary, "", *lines, "", rest])


def _words(parameter: inspect.Parameter) -> str:
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
