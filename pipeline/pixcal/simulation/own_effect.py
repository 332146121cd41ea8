"""A user's own effect: a Python file, checked before use.

Errors name the file, whether the check finds them or a step fails later.
"""

import dataclasses
import functools
import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from pixcal.model.config import parse, to_plain
from pixcal.model.errors import InputError, PixcalError
from pixcal.simulation.effect import DOMAINS, Effect, Estimate, LightStart, Stage
from pixcal.simulation.forward import STEPS

OTHERS = ("__post_init__", "check", "predict", "undo", "undo_samples", "noise_factor")
MAX_AROUND = 4096  # rows around a piece, or frames before one, that an effect may ask for


def effect_of_file(path: Path) -> type[Effect]:
    """The effect of a user's Python file; InputError unless it holds exactly one."""
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
        return checked(only_effect(module), path)
    except TypeError as error:
        raise InputError(f"{path}: {error}") from error


def only_effect(module: ModuleType) -> type[Effect]:
    """The effect that a module defines; TypeError unless there is exactly one."""
    classes = [
        cls
        for _, cls in inspect.getmembers(module, inspect.isclass)
        if issubclass(cls, Effect) and cls is not Effect and cls.__module__ == module.__name__
    ]
    if len(classes) != 1:
        raise TypeError(f"{len(classes)} effects found where one subclass of Effect is expected")
    return classes[0]


def checked(effect: type[Effect], file: Path) -> type[Effect]:
    """The class, with steps that name the file on failure; InputError if it is invalid."""
    for name in (*STEPS, *OTHERS):
        if name in vars(effect):
            setattr(effect, name, _checked(vars(effect)[name], file, name in STEPS))
    try:
        _check(effect)
        for name, check in (("estimate", _check_estimate), ("starts", _check_starts)):
            if name in vars(effect):
                setattr(effect, name, _asked(name, vars(effect)[name], check, file))
    except (Exception, SystemExit) as error:
        raise InputError(f"{file}: {_reason(error)}; see docs/how-to/own-effect.md") from error
    return effect


def _check(effect: type[Effect]) -> None:
    for name, kind in (("name", str), ("title", str), ("acts_at", Stage)):
        if not isinstance(getattr(effect, name, None), kind):
            raise InputError(f"{name} is missing or not a {kind.__name__}")
    if not effect.name.isidentifier():
        raise InputError(f"name {effect.name!r:.80} is not made of letters, digits and '_'")
    if "__dataclass_params__" not in vars(effect):
        raise InputError(f"{effect.__name__} is not a dataclass: put @dataclass(frozen=True) there")
    default = effect()
    parse(effect, to_plain(default), effect.__name__)
    fields = {field.name for field in dataclasses.fields(effect)}
    for what in ("strengths", "optional_parameters"):
        if unknown := set(getattr(effect, what)) - fields:
            raise InputError(f"{what} names {', '.join(sorted(unknown))}, which is not a field")
    domains = getattr(effect, "domains", None)
    if not isinstance(domains, tuple) or not domains or not set(domains) <= set(DOMAINS):
        raise InputError(f"domains is missing or not a tuple; choose from {', '.join(DOMAINS)}")
    if default.order < 0:
        raise InputError("order is below zero: the light of the bench comes first")
    for name in ("halo", "frames_back"):
        if not 0 <= getattr(default, name) <= MAX_AROUND:
            raise InputError(f"{name} is not between 0 and {MAX_AROUND}")


def _checked(step: Callable[..., Any], file: Path, gives_back: bool) -> Callable[..., Any]:
    """A method that raises InputError if it fails or returns a wrong result."""

    @functools.wraps(step)
    def explained(self: Effect, *args: Any) -> Any:
        try:
            result = step(self, *args)
            if gives_back:
                _compare(result, args[0])
        except InputError as error:
            raise InputError(f"{file}: {error}" if gives_back else str(error)) from error
        except (Exception, SystemExit) as error:
            raise InputError(f"{file}: {step.__name__}: {_reason(error)}; fix the file") from error
        return result

    return explained


def _asked(name: str, method: Any, check: Callable[[Any, type[Effect]], None], file: Path) -> Any:
    """A class method of the evidence, whose failure or wrong result names the file."""
    if not isinstance(method, classmethod):
        raise InputError(f"{name} is not a class method: put @classmethod above it")

    def asked(cls: type[Effect], evidence: Any) -> Any:
        try:
            answer = method.__func__(cls, evidence)
            if answer is not None:
                check(answer, cls)
        except (InputError, NotImplementedError):
            raise
        except (Exception, SystemExit) as error:
            raise PixcalError(f"{file}: {name}: {_reason(error)}; fix the file") from error
        return answer

    return classmethod(asked)


def _check_starts(starts: Any, effect: type[Effect]) -> None:
    """Raise TypeError or ValueError unless a fit can start there."""
    fields = {field.name for field in dataclasses.fields(effect)}
    for start in starts:
        if not isinstance(start, LightStart) or not isinstance(start.model, effect):
            raise TypeError(f"does not return a list of LightStart for {effect.__name__}")
        if unknown := set(start.free) - fields:
            raise ValueError(f"free: {', '.join(sorted(unknown))} is not a parameter")


def _check_estimate(estimate: Any, effect: type[Effect]) -> None:
    """Raise TypeError or ValueError unless all fields of an estimate are usable."""
    if not isinstance(estimate, Estimate) or not isinstance(estimate.effect, effect):
        raise TypeError(f"does not return an Estimate of {effect.__name__}")
    try:
        parse(effect, to_plain(estimate.effect), effect.__name__)
    except InputError as error:
        raise ValueError(str(error)) from error
    names = {field.name for field in dataclasses.fields(effect)}
    for name, sigma in dict(estimate.errors).items():
        if name.partition("[")[0] not in names or not (np.isfinite(sigma) and sigma >= 0):
            raise ValueError(
                f"errors: {name!r} is not a parameter, or {sigma!r} is not a valid error"
            )
    if not np.isfinite(estimate.significance):
        raise ValueError(f"significance is {estimate.significance!r}")
    if not isinstance(estimate.why, str):
        raise TypeError("why is not a text")


def _compare(result: Any, given: Any) -> None:
    """Raise TypeError unless a result has the type and shape of the argument and is finite."""
    if dataclasses.is_dataclass(given):
        if type(result) is not type(given):
            raise TypeError(f"returns {type(result).__name__}, not {type(given).__name__}")
        for field in dataclasses.fields(given):
            _compare(getattr(result, field.name), getattr(given, field.name))
    elif isinstance(given, np.ndarray):
        if not isinstance(result, np.ndarray) or result.shape != given.shape:
            raise TypeError(f"does not return an array of shape {given.shape}")
        if result.dtype.kind not in "fiub" or not np.isfinite(result).all():
            raise TypeError("returns values that are not finite real numbers")


def _reason(error: BaseException) -> str:
    message = str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
    return f"{' '.join(message.split()):.200}"
