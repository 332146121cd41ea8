"""Strict configuration: plain data into frozen dataclasses, with errors that name the key.

A configuration class is a frozen dataclass whose fields have their limits in ``metadata``; make
them with `quantity`. Its class variable ``moved`` gives the replacement of keys of old files.
`to_plain` is the inverse of `parse`.
"""

import ast
import dataclasses
import difflib
import functools
import math
import re
import sys
import types
import typing
from itertools import pairwise
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

from pixcal.model.errors import InputError

T = TypeVar("T")

StrPath = str | PathLike[str]  # a path in any form; an opened `pixcal.Run` is one as well


def quantity(
    default: Any = dataclasses.MISSING,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    above: float | None = None,
    choices: tuple[str, ...] | None = None,
    doc: str = "",
    **more: Any,
) -> Any:
    """Declare a configuration field with its unit and range.

    default : value used when the key is absent; without it the key is required
    unit : unit, for messages and the documentation
    low, high : inclusive limits of a number (of each number of a tuple)
    above : exclusive lower limit
    choices : the allowed words
    doc : one line on the meaning; in pixcal's own modules it may be a string below the field
    **more : further metadata of options, see `pixcal.model.options`
    """
    meta = dict(more, unit=unit, low=low, high=high, above=above, choices=choices, doc=doc)
    if isinstance(default, (list, dict)):
        raise TypeError("defaults of configuration fields are immutable: use tuples")
    return dataclasses.field(default=default, metadata=meta)


def meanings(kind: type) -> dict[str, str]:
    """What each field means: its ``doc``, or else the string below it in the source."""
    words: dict[str, str] = {}
    for parent in reversed(kind.__mro__):
        file = getattr(sys.modules.get(parent.__module__), "__file__", None)
        words |= _strings_below(file).get(parent.__qualname__, {}) if file else {}
    fields = dataclasses.fields(kind)
    return {f.name: f.metadata.get("doc") or words.get(f.name, "") for f in fields}


@functools.cache
def _strings_below(file: str) -> dict[str, dict[str, str]]:
    """The string below each field, by class and field, of a source file."""
    words: dict[str, dict[str, str]] = {}
    statements = ast.parse(Path(file).read_bytes()).body
    for declared in (one for one in statements if isinstance(one, ast.ClassDef)):
        for pair in pairwise(declared.body):
            match pair:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    words.setdefault(declared.name, {})[name] = " ".join(text.split())
    return words


def as_in(kind: type, name: str, **changes: Any) -> Any:
    """Declare a field as in another class, with changes of the arguments of `quantity`."""
    (field,) = (f for f in dataclasses.fields(kind) if f.name == name)
    meaning = {"doc": meanings(kind)[name]}
    return quantity(**{"default": field.default, **field.metadata, **meaning, **changes})


@dataclasses.dataclass(frozen=True)
class _Place:
    """Place of a value: file, dotted key, and line if known."""

    file: str
    key: str
    line: int | None = None

    def inside(self, name: str, line: int | None = None) -> "_Place":
        joint = "." if self.key and not name.startswith("[") else ""
        return _Place(self.file, f"{self.key}{joint}{name}", line or self.line)

    def wrong(self, text: str) -> InputError:
        key = f"{self.key}: " if self.key else ""
        line = f" (line {self.line})" if self.line else ""
        return InputError(f"{self.file}: {key}{text}{line}")


def parse(cls: type[T], data: Any, where: str, *, key: str = "") -> T:
    """Build the dataclass ``cls`` from plain data.

    Raises InputError naming the first key that is unknown, missing, of the wrong type or out of
    range.

    cls : a frozen dataclass with type-annotated fields
    data : mapping as read from YAML (errors then name the line) or JSON
    where : name of the file, for messages
    key : dotted path of ``data`` inside the file, for messages
    """
    return _section(cls, data, _Place(where, key))


def _section(cls: type[T], data: Any, place: _Place) -> T:
    if not isinstance(data, dict):
        raise place.wrong(f"expected keys and values, found {_kind(data)}")
    lines = getattr(data, "lines", {})  # of `pixcal.model.yaml_file`
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in data:
        if name not in fields:
            if name in (moved := getattr(cls, "moved", {})):
                raise place.inside(name, lines.get(name)).wrong(f"instead, write {moved[name]}")
            near = difflib.get_close_matches(name, fields, n=1)
            meant = f"; did you mean {near[0]!r}? The" if near else "; the"
            text = f"unknown key {name!r:.80}{meant} keys here are {', '.join(fields)}"
            raise dataclasses.replace(place, line=lines.get(name)).wrong(text)
    values: dict[str, Any] = {}
    for name, field in fields.items():
        at = place.inside(name, lines.get(name))
        if name in data:
            values[name] = _value(hints[name], data[name], at, field.metadata)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            unit = field.metadata.get("unit")
            raise at.wrong(f"missing{f' (in {unit})' if unit else ''}")
    try:
        return cls(**values)
    except InputError as error:
        # Most messages begin with the key of the inconsistent value.
        line = lines.get(re.split(r"[:\[]", str(error))[0], place.line)
        raise dataclasses.replace(place, line=line).wrong(str(error)) from error


def to_plain(config: Any) -> Any:
    """Plain data (dicts, lists, numbers, words) of a configuration, as input of `parse`."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, (tuple, list)):
        return [to_plain(v) for v in config]
    if isinstance(config, dict):
        return {name: to_plain(value) for name, value in config.items()}
    return fspath(config) if isinstance(config, PathLike) else config


def result_options(config: Any, kind: type | None = None) -> dict[str, Any]:
    """Plain data of options that affect a result; with ``kind``, only of this parent class."""
    return {
        f.name: to_plain(getattr(config, f.name))
        for f in dataclasses.fields(kind or config)
        if f.metadata.get("in_key", True)
    }


def _kind(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    return f"the text {value!r:.40}" if isinstance(value, str) else f"{value!r:.40}"


def _value(hint: Any, value: Any, place: _Place, meta: Any) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in arguments:
            return None
        if isinstance(value, PathLike) and any(get_origin(k) is PathLike for k in arguments):
            return fspath(value)
        return _value(next(k for k in arguments if k is not type(None)), value, place, meta)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return _section(hint, value, place)
    if origin is tuple:
        return _items(arguments, value, place, meta)
    if hint in (int, float):
        return _number(hint, value, place, meta)
    if hint is Path and isinstance(value, (str, PathLike)):
        return Path(value)
    kind, expected = {
        dict: (dict, "keys and values"),  # a section whose keys another module checks
        bool: (bool, "true or false"),
        str: (str, "text"),
        Path: (str, "text"),
        Literal: (str, "text"),
    }[origin or hint]
    if not isinstance(value, kind):
        raise place.wrong(f"expected {expected}, found {_kind(value)}")
    choices = arguments if origin is Literal else meta.get("choices")
    if choices and value not in choices:
        raise place.wrong(f"{value!r:.80} is not one of {', '.join(choices)}")
    return value


def _items(hints: tuple[Any, ...], values: Any, place: _Place, meta: Any) -> tuple[Any, ...]:
    if not isinstance(values, (list, tuple)):
        unit = f", in {meta['unit']}" if meta.get("unit") else ""
        example = "[a, b]" if hints[-1] is not Ellipsis else "[a]"
        raise place.wrong(f"expected a list such as {example}{unit}, found {_kind(values)}")
    if hints[-1] is Ellipsis:
        hints = hints[:1] * len(values)
    if len(values) != len(hints):
        raise place.wrong(f"expected {len(hints)} values, found {len(values)}")
    return tuple(
        _value(hint, value, place.inside(f"[{number}]"), meta)
        for number, (hint, value) in enumerate(zip(hints, values, strict=True))
    )


def _number(hint: Any, value: Any, place: _Place, meta: Any) -> Any:
    unit = f" {meta['unit']}" if meta.get("unit") else ""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        bare = f" (write the bare number{f', in{unit}' if unit else ''})"
        advice = bare if isinstance(value, str) else ""
        raise place.wrong(f"expected a number, found {_kind(value)}{advice}")
    if isinstance(value, int) and abs(value) > 10**18:
        raise place.wrong("number too large")
    if not math.isfinite(value):
        raise place.wrong(f"expected a finite number, found {value!r}")
    if hint is int and value != int(value):
        raise place.wrong(f"expected a whole number, found {value!r}")
    low, high, above = meta.get("low"), meta.get("high"), meta.get("above")
    if low is not None and value < low:
        raise place.wrong(f"{value!r} is below {low:g}{unit}")
    if high is not None and value > high:
        raise place.wrong(f"{value!r} is above {high:g}{unit}")
    if above is not None and value <= above:
        raise place.wrong(f"{value!r} must be greater than {above:g}{unit}")
    return hint(value)
