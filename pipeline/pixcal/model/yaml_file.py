"""YAML files of settings: plain data with the line of each key."""

import re
from pathlib import Path
from typing import Any

import yaml

from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, reason_of

MAX_CONFIG_BYTES = 1_000_000


class _Section(dict[str, Any]):
    """A mapping of a YAML file with the line of each key."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: dict[str, int] = {}


class _StrictLoader(yaml.SafeLoader):
    """Plain YAML only: no tags, no aliases, no duplicate keys.

    Bare words have their YAML 1.2 meaning: by default, PyYAML reads ``010`` as 8, ``1:30`` as 90,
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

    def construct_section(self, node: Any) -> _Section:
        section = _Section()
        for key_node, value_node in node.value:
            key, line = key_node.value, key_node.start_mark.line + 1
            if key_node.tag != "tag:yaml.org,2002:str":
                raise yaml.YAMLError(
                    f"line {line}: the key {key or 'nothing'!r:.80} is not a name; in numbers "
                    "write a decimal point, not a comma"
                )
            if key in section:
                raise yaml.YAMLError(f"line {line}: key {key!r:.80} is given twice")
            section[key] = self.construct_object(value_node, deep=True)
            section.lines[key] = line
        return section


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
_StrictLoader.add_constructor("tag:yaml.org,2002:map", _StrictLoader.construct_section)


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a YAML mapping, refusing tags, aliases, duplicate keys and oversized files."""
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
    """The fault of a text and its place, in one line."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem and error.problem_mark:
        mark = error.problem_mark
        tab = "; indent by spaces, not by tabs" if "'\\t'" in error.problem else ""
        return f"{error.problem} (line {mark.line + 1}, column {mark.column + 1}){tab}"
    return reason_of(error)


def to_yaml(config: Any) -> str:
    """YAML text of a configuration, for `read_yaml` and `parse`."""
    return yaml.dump(
        to_plain(config), Dumper=_StrictDumper, sort_keys=False, default_flow_style=None
    )
