"""The effects of a bench and its detector, one file each; found by `effects`.

A new one is a file here with one subclass of `pixcal.simulation.effect.Effect`, and its test. One
that is not part of pixcal is such a file anywhere (`pixcal.simulation.own_effect`). The pages in
docs/reference/effects/ describe each effect, and how it is measured and corrected.
"""

import difflib
import importlib
import pkgutil
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from typing import Any

from pixcal.model.config import parse
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect
from pixcal.simulation.own_effect import effect_of_file, only_effect


@cache
def effects() -> dict[str, type[Effect]]:
    """All effects that pixcal knows, by name."""
    by_name = {}
    for module in pkgutil.iter_modules(__path__):
        if not module.name.startswith("_"):
            effect = only_effect(importlib.import_module(f"{__name__}.{module.name}"))
            by_name[effect.name] = effect
    return by_name


def known_effects(own: Iterable[Path] = ()) -> dict[str, type[Effect]]:
    """All effects by name, those of own files included; InputError if a name is taken twice."""
    known = dict(effects())
    for file in own:
        effect = effect_of_file(file)
        if effect.name in known:
            raise InputError(f"{file}: there is an effect {effect.name!r} already; rename this one")
        known[effect.name] = effect
    return known


def check_known(name: str, known: Mapping[str, type[Effect]], where: str) -> None:
    """Raise InputError if there is no effect of this name."""
    if name not in known:
        near = difflib.get_close_matches(name, known, n=1)
        meant = f"did you mean {near[0]!r}? Known" if near else "known"
        raise InputError(
            f"{where}: unknown effect {name!r:.80}; {meant} are {', '.join(known)}; give the file "
            "of your own effect with --own"
        )


def parse_effects(
    plain: Mapping[str, Any], where: str, known: Mapping[str, type[Effect]] | None = None
) -> tuple[Effect, ...]:
    """Effects from the section ``effects`` of a bench file: name to parameters.

    Raises InputError for the first name or key that is unknown, or value out of range.
    """
    known = effects() if known is None else known
    parsed = []
    for name, values in plain.items():
        check_known(name, known, f"{where}: effects")
        parameters = {} if values is None else values
        parsed.append(parse(known[name], parameters, where, key=f"effects.{name}"))
    return tuple(parsed)
