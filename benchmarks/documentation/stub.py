"""``pixcal/__init__.pyi``: the public names, and the commands with all their options."""

import inspect
from pathlib import Path
from typing import Any

import pixcal
from pixcal.api import commands

STUB = Path(pixcal.__file__).with_suffix(".pyi")
HEAD = """# What `pixcal` gives, for type checkers and editors: written by `make doc-pages`.
import collections.abc
import os
import pathlib
import typing
from typing import Literal

import pixcal.api.opened
import pixcal.engine.run
"""


def stub() -> str:
    """The text of the stub."""
    taken, functions = [], []
    for home, names in pixcal._HOMES.items():
        for name in sorted(names):
            if f"pixcal.{home}" == commands.__name__:
                functions.append(_function(name, getattr(pixcal, name)))
            else:
                taken.append(f"from pixcal.{home} import {name} as {name}")
    names = "".join(f'    "{name}",\n' for name in pixcal.__all__)
    listed = f"__version__: str\n__all__ = [\n{names}]\n"
    return "\n".join([HEAD.rstrip(), *taken, "", listed, *functions])


def _function(name: str, function: Any) -> str:
    signature = inspect.signature(function)
    lines, keywords = [], False
    for parameter in signature.parameters.values():
        if parameter.kind is parameter.KEYWORD_ONLY and not keywords:
            lines.append("*")
            keywords = True
        default = "" if parameter.default is parameter.empty else f" = {parameter.default!r}"
        lines.append(f"{parameter.name}: {_type(parameter.annotation)}{default}")
    arguments = "".join(f"    {line},\n" for line in lines)
    text = inspect.getdoc(function) or ""
    told = "\n".join(f"    {line}".rstrip() for line in text.splitlines())
    result = _type(signature.return_annotation)
    return f'def {name}(\n{arguments}) -> {result}:\n    """{told.strip()}\n    """\n'


def _type(annotation: Any) -> str:
    return inspect.formatannotation(annotation)
