"""The effects of a bench and its detector, one file each; found by `effects`.

A new one is a file here with one subclass of `pixcal.simulation.effect.Effect`, and its test. One
that is not part of pixcal is such a file anywhere: `effect_of_file`.
"""

import importlib
import importlib.util
import inspect
import pkgutil
from collections.abc import Iterable, Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

from pixcal.effects._own import checked
from pixcal.model.config import parse
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect


@cache
def effects() -> dict[str, type[Effect]]:
    """All effects that pixcal knows, by name."""
    found = {}
    for module in pkgutil.iter_modules(__path__):
        if not module.name.startswith("_"):
            effect = _only_effect(importlib.import_module(f"{__name__}.{module.name}"))
            found[effect.name] = effect
    return found


def effect_of_file(path: Path) -> type[Effect]:
    """The effect of a Python file of the user's own; InputError if it does not hold just one."""
    if not path.is_file():
        raise InputError(f"{path}: not found; give a Python file that holds an effect")
    spec = importlib.util.spec_from_file_location(f"pixcal_effect_{path.stem}", path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file (its name must end in .py)")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise InputError(f"{path}: cannot be imported ({reason:.200}); fix it") from error
    try:
        return checked(_only_effect(module), path)
    except TypeError as error:
        raise InputError(f"{path}: {error}") from error


def known_effects(own: Iterable[Path] = ()) -> dict[str, type[Effect]]:
    """All effects by name, also of own files; InputError if the name of one is taken."""
    known = dict(effects())
    for file in own:
        effect = effect_of_file(file)
        if effect.name in known:
            raise InputError(f"{file}: there is an effect {effect.name!r} already; rename this one")
        known[effect.name] = effect
    return known


def parse_effects(
    plain: Mapping[str, Any], where: str, known: Mapping[str, type[Effect]] | None = None
) -> tuple[Effect, ...]:
    """Effects from the section ``effects`` of a bench file: name to parameters.

    Raises InputError for the first name or key that is unknown, or value out of range.
    """
    known = effects() if known is None else known
    found = []
    for name, values in plain.items():
        if name not in known:
            raise InputError(
                f"{where}: effects: unknown effect {name!r:.80}; known are {', '.join(known)}; "
                "give the file of your own effect with --own"
            )
        parameters = {} if values is None else values
        found.append(parse(known[name], parameters, where, key=f"effects.{name}"))
    return tuple(found)


def _only_effect(module: ModuleType) -> type[Effect]:
    own = [
        cls
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if issubclass(cls, Effect) and cls is not Effect and cls.__module__ == module.__name__
    ]
    if len(own) != 1:
        raise TypeError(f"{len(own)} effects found where one subclass of Effect is expected")
    return own[0]
