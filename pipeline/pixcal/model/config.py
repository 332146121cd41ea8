"""Strict configuration: YAML into frozen dataclasses, every mistake named by its key.

A configuration class is a frozen dataclass whose fields carry their limits in ``metadata``; make
them with `quantity`. `to_plain` and `to_yaml` write out what `parse` reads.
"""

import dataclasses
import difflib
import math
import re
import types
import typing
from os import PathLike, fspath
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args, get_origin

import yaml

from pixcal.model.errors import InputError

T = TypeVar("T")

StrPath = str | PathLike[str]  # a path in any form; an opened `pixcal.Run` is one as well

MAX_CONFIG_BYTES = 1_000_000


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

    Parameters
    ----------
    default : optional
        Value used when the key is absent; without it the key is required.
    unit : str
        Unit, for messages and the documentation.
    low, high : float, optional
        Inclusive limits of a number (of each number of a tuple).
    above : float, optional
        Exclusive lower limit.
    choices : tuple of str, optional
        The only words allowed.
    doc : str
        One line on the meaning.
    **more
        Of options, as `pixcal.model.options` says.
    """
    meta = dict(more, unit=unit, low=low, high=high, above=above, choices=choices, doc=doc)
    if isinstance(default, (list, dict)):
        raise TypeError("defaults of configuration fields are immutable: use tuples")
    return dataclasses.field(default=default, metadata=meta)


class _StrictLoader(yaml.SafeLoader):
    """Plain YAML only: no tags, no aliases, no key twice.

    Bare words mean what YAML 1.2 says: PyYAML by itself would read ``010`` as 8, ``1:30`` as 90,
    ``no`` as false and ``4e2`` as text.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        event: Any = self.peek_event()  # type: ignore[no-untyped-call]
        line = event.start_mark.line + 1
        if isinstance(event, yaml.AliasEvent):
            raise yaml.YAMLError(f"aliases are not allowed (line {line})")
        if getattr(event, "tag", None) is not None:
            raise yaml.YAMLError(f"tags are not allowed (line {line}: {event.tag:.80})")
        return super().compose_node(parent, index)

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        seen: set[Any] = set()
        for key_node, _ in node.value:
            key = self.construct_object(key_node, deep=True)
            if not isinstance(key, str):
                raise yaml.YAMLError(f"line {key_node.start_mark.line + 1}: keys must be words")
            if key in seen:
                raise yaml.YAMLError(f"line {key_node.start_mark.line + 1}: key {key!r:.80} twice")
            seen.add(key)
        return super().construct_mapping(node, deep=deep)


class _StrictDumper(yaml.SafeDumper):
    """Quotes every text that YAML 1.1 or 1.2 would read as something else."""


_StrictLoader.yaml_implicit_resolvers = {}
for _tag, _pattern in {
    "null": r"~|null|Null|NULL|",
    "bool": r"true|True|TRUE|false|False|FALSE",
    "int": r"[-+]?[0-9]+",
    "float": r"[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
    r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN)",
}.items():
    for _class in (_StrictLoader, _StrictDumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(f"(?:{_pattern})\\Z"), None
        )
_StrictLoader.add_constructor("tag:yaml.org,2002:int", lambda _loader, node: int(node.value))


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping, refusing tags, aliases, duplicate keys and oversized files.

    Raises
    ------
    InputError
        If the file is missing, too large, not UTF-8, not YAML, or not a mapping.
    """
    try:
        if path.stat().st_size > MAX_CONFIG_BYTES:
            raise InputError(f"{path}: larger than {MAX_CONFIG_BYTES} bytes; not a configuration")
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "not UTF-8 text"
        raise InputError(f"{path}: cannot be read ({reason})") from error
    try:
        data = _StrictLoader(text).get_single_data()
    except RecursionError as error:
        raise InputError(f"{path}: not a configuration: nested too deeply") from error
    except (yaml.YAMLError, ValueError) as error:
        raise InputError(f"{path}: not valid YAML: {_reason(error)}") from error
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected keys and values at the top level")
    return data


def _reason(error: Exception) -> str:
    """What is wrong with a text and where, in one line."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        mark = error.problem_mark
        return f"{error.problem} (line {mark.line + 1}, column {mark.column + 1})"
    return " ".join(str(error).split())


def parse(cls: type[T], data: Any, where: str, *, key: str = "") -> T:
    """Build the dataclass ``cls`` from plain data.

    Parameters
    ----------
    cls : type
        A frozen dataclass with type-annotated fields.
    data : object
        Mapping as read from YAML or JSON.
    where : str
        Name of the file, for messages.
    key : str
        Dotted path of ``data`` inside the file, for messages.

    Raises
    ------
    InputError
        Naming the first key that is unknown, missing, of the wrong type or out of range.
    """
    place = f"{where}: {key}" if key else where
    if not isinstance(data, dict):
        raise InputError(f"{place}: expected keys and values, found {_kind(data)}")
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls)}  # type: ignore[arg-type]
    for name in data:
        if name not in fields:
            near = difflib.get_close_matches(name, fields, n=1)
            meant = f"; did you mean {near[0]!r}? The" if near else "; the"
            known = ", ".join(fields)
            raise InputError(f"{place}: unknown key {name!r:.80}{meant} keys here are {known}")
    values: dict[str, Any] = {}
    for name, field in fields.items():
        path = f"{key}.{name}" if key else name
        if name in data:
            values[name] = _value(hints[name], data[name], where, path, field.metadata)
        elif field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING:
            unit = field.metadata.get("unit")
            raise InputError(f"{where}: {path}: missing{f' (in {unit})' if unit else ''}")
    try:
        return cls(**values)
    except InputError as error:
        raise InputError(f"{place}: {error}") from error


def to_plain(config: Any) -> Any:
    """Plain data (dicts, lists, numbers, words) of a configuration, as `parse` reads it."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, (tuple, list)):
        return [to_plain(v) for v in config]
    if isinstance(config, dict):
        return {name: to_plain(value) for name, value in config.items()}
    return fspath(config) if isinstance(config, PathLike) else config


def result_options(config: Any, kind: type | None = None) -> dict[str, Any]:
    """Plain data of the options that a result depends on.

    Parameters
    ----------
    config : dataclass
    kind : type, optional
        A dataclass that the configuration inherits from, to look at its options alone.
    """
    return {
        f.name: to_plain(getattr(config, f.name))
        for f in dataclasses.fields(kind or config)
        if f.metadata.get("in_key", True)
    }


def to_yaml(config: Any) -> str:
    """Text of a configuration, as `read_yaml` and `parse` read it."""
    return yaml.dump(
        to_plain(config), Dumper=_StrictDumper, sort_keys=False, default_flow_style=None
    )


def _kind(value: Any) -> str:
    if value is None:
        return "nothing"
    if isinstance(value, dict):
        return "a mapping"
    if isinstance(value, list):
        return "a list"
    return f"the text {value!r:.40}" if isinstance(value, str) else f"{value!r:.40}"


def _value(hint: Any, value: Any, where: str, key: str, meta: Any) -> Any:
    place = f"{where}: {key}"
    origin = get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        hints = get_args(hint)
        if value is None and type(None) in hints:
            return None
        if isinstance(value, PathLike) and any(get_origin(k) is PathLike for k in hints):
            return fspath(value)
        return _value(next(k for k in hints if k is not type(None)), value, where, key, meta)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return parse(hint, value, where, key=key)
    if origin is dict:
        # A section whose keys another module knows.
        if not isinstance(value, dict):
            raise InputError(f"{place}: expected keys and values, found {_kind(value)}")
        return value
    if origin is tuple:
        args = get_args(hint)
        if not isinstance(value, (list, tuple)):
            raise InputError(f"{place}: expected a list, found {_kind(value)}")
        if args[-1] is Ellipsis:
            args = args[:1] * len(value)
        if len(value) != len(args):
            raise InputError(f"{place}: expected {len(args)} values, found {len(value)}")
        return tuple(
            _value(a, v, where, f"{key}[{n}]", meta)
            for n, (a, v) in enumerate(zip(args, value, strict=True))
        )
    if hint is bool:
        if not isinstance(value, bool):
            raise InputError(f"{place}: expected true or false, found {_kind(value)}")
        return value
    if hint is Path and isinstance(value, (str, PathLike)):
        return Path(value)
    if hint in (str, Path) or origin is Literal:
        if not isinstance(value, str):
            raise InputError(f"{place}: expected text, found {_kind(value)}")
        choices = get_args(hint) or meta.get("choices")
        if choices and value not in choices:
            raise InputError(f"{place}: {value!r:.80} is not one of {', '.join(choices)}")
        return value
    if hint in (int, float):
        return _number(hint, value, place, meta)
    raise TypeError(f"{key}: configuration fields cannot be {hint!r}")


def _number(hint: Any, value: Any, place: str, meta: Any) -> Any:
    unit = f" {meta['unit']}" if meta.get("unit") else ""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        hint_text = ""
        if isinstance(value, str):
            hint_text = f" (write the bare number{f', in{unit}' if unit else ''})"
        raise InputError(f"{place}: expected a number, found {_kind(value)}{hint_text}")
    if isinstance(value, int) and abs(value) > 10**18:
        raise InputError(f"{place}: number too large")
    if hint is int and isinstance(value, float):
        if not value.is_integer():
            raise InputError(f"{place}: expected a whole number, found {value!r}")
        value = int(value)
    if not math.isfinite(value):
        raise InputError(f"{place}: expected a finite number, found {value!r}")
    low, high, above = meta.get("low"), meta.get("high"), meta.get("above")
    if low is not None and value < low:
        raise InputError(f"{place}: {value!r} is below {low:g}{unit}")
    if high is not None and value > high:
        raise InputError(f"{place}: {value!r} is above {high:g}{unit}")
    if above is not None and value <= above:
        raise InputError(f"{place}: {value!r} must be greater than {above:g}{unit}")
    return hint(value)
