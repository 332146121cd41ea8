"""Compare the parameters of a diagnosis with the truth, given their errors."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from pixcal.effects import parse_effects
from pixcal.model.config import to_plain

Plain = Mapping[str, Any]


@dataclass(frozen=True)
class ParameterCheck:
    """A fitted parameter and its truth."""

    name: str
    true: float
    estimate: float
    error: float

    def within(self, errors: float) -> bool:
        """Whether it deviates by at most a number of its errors."""
        return abs(self.estimate - self.true) <= errors * self.error


def check_parameters(
    effect: str, true: Plain, estimated: Plain, errors: Mapping[str, float]
) -> list[ParameterCheck]:
    """Checks of every parameter for which the diagnosis gives an error.

    ``true``: parameters as in a bench file; missing ones have their defaults. ``estimated``: all.
    ``errors``: by name of the parameter, as in ``uncertainty`` of the diagnosis.
    """
    whole = to_plain(parse_effects({effect: dict(true)}, "truth")[0])
    if "couplings" in whole:
        return list(_couplings(whole["couplings"], estimated["couplings"], errors))
    values, others = dict(_flat(whole)), dict(_flat(estimated))
    pairs = []
    for name, error in errors.items():
        if name in values and name in others and math.isfinite(error):
            value = others[name]
            if name == "phase_rad":
                value = values[name] + math.remainder(value - values[name], 2 * math.pi)
            pairs.append(ParameterCheck(name, values[name], value, error))
    return pairs


def _flat(plain: Plain, prefix: str = "") -> Iterator[tuple[str, float]]:
    """Numbers by their dotted names: ``ramp[0]``."""
    for name, value in plain.items():
        if isinstance(value, (list, tuple)):
            yield from _flat({f"{name}[{n}]": v for n, v in enumerate(value)}, prefix)
        elif isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        elif isinstance(value, (int, float)) and not isinstance(value, bool):
            yield f"{prefix}{name}", float(value)


def _couplings(
    true: Sequence[Plain], estimated: Sequence[Plain], errors: Mapping[str, float]
) -> Iterator[ParameterCheck]:
    """Estimated share of every true coupling: the sum over those with its direction and rows."""
    for one in true:
        matching = [n for n, other in enumerate(estimated) if _meet(one, other)]
        share = sum(float(estimated[n]["share"]) for n in matching)
        error = math.hypot(*(errors.get(f"couplings[{n}].share", 0.0) for n in matching))
        name = f"share of the pixel at (dy, dx) = ({one['dy']}, {one['dx']})"
        if one["every_rows"] > 1:
            name += f", from row {one['row']} of every {one['every_rows']}"
        yield ParameterCheck(name, float(one["share"]), share, error)


def _meet(one: Plain, other: Plain) -> bool:
    if (one["dy"], one["dx"]) != (other["dy"], other["dx"]):
        return False
    common = math.gcd(one["every_rows"], other["every_rows"])
    return bool((one["row"] - other["row"]) % common == 0)
