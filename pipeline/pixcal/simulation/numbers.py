"""Numbers of a model by the keys that errors have, as ``patterns[0].coefficients[3]``."""

import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")


def numbers(value: Any, key: str = "") -> dict[str, float]:
    """All real numbers of a model, of its tuples and of the parts in them."""
    if isinstance(value, float):
        return {key: value}
    parts: list[tuple[str, Any]] = []
    if isinstance(value, tuple):
        parts = [(f"{key}[{n}]", part) for n, part in enumerate(value)]
    elif is_dataclass(value):
        joint = f"{key}." if key else ""
        parts = [(joint + f.name, getattr(value, f.name)) for f in fields(value)]
    return {own: number for at, part in parts for own, number in numbers(part, at).items()}


def field_of(key: str) -> str:
    """Field of the model that a number is in."""
    return re.split(r"\W", key)[0]


def set_of(model: Any, key: str) -> str:
    """Name of the fringe set that the part of a number is of; empty where it is of all sets."""
    for name, place in re.findall(r"([a-z]\w*)|\[(\d+)\]", key):
        model = getattr(model, name) if name else model[int(place)]
        if of := getattr(model, "set", ""):
            return str(of)
    return ""


def with_numbers(model: T, values: Mapping[str, float]) -> T:
    """The model with other numbers, held within their ranges."""
    changed: T = _changed(model, "", values, {})
    return changed


def _changed(value: Any, key: str, values: Mapping[str, float], limits: Mapping[str, Any]) -> Any:
    if isinstance(value, float):
        return within(values[key], limits) if key in values else value
    if isinstance(value, tuple):
        parts = enumerate(value)
        return tuple(_changed(part, f"{key}[{n}]", values, limits) for n, part in parts)
    if is_dataclass(value) and not isinstance(value, type):
        joint = f"{key}." if key else ""
        own = [f for f in fields(value) if any(k.startswith(joint + f.name) for k in values)]
        return replace(
            value,
            **{
                f.name: _changed(getattr(value, f.name), joint + f.name, values, f.metadata)
                for f in own
            },
        )
    return value


def within(value: float, limits: Mapping[str, Any]) -> float:
    """A number that is held within the limits of its field."""
    low, high, above = (limits.get(name) for name in ("low", "high", "above"))
    if above is not None:
        value = max(value, float(np.nextafter(above, np.inf)))
    return float(np.clip(value, -np.inf if low is None else low, np.inf if high is None else high))
