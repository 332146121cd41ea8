"""Click options made from the dataclasses of `pixcal.model.options`; arguments they share."""

import functools
import inspect
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields
from pathlib import Path
from types import UnionType
from typing import Any, Literal, get_args, get_origin, get_type_hints

import click

from pixcal.model.config import meanings
from pixcal.model.options import Region, Running

Command = Callable[..., Any]


def memory_size(text: str) -> int:
    """Bytes of a size written ``512MiB``, ``2GiB``, ``2G`` or plainly; ``GB`` is decimal."""
    match = re.fullmatch(r"(\d{1,15}(?:\.\d{1,9})?) ?([kmgt]?)(i?b)?", text.strip().lower())
    if match is None or (match[3] == "ib" and not match[2]):
        raise click.BadParameter(f"{text!r:.40} is not a size; write for example 512MiB or 2GiB")
    number, prefix, suffix = match.groups()
    base = 1000 if suffix == "b" else 1024
    size = int(float(number) * base ** " kmgt".index(prefix or " "))
    if size < 1 << 20:
        raise click.BadParameter(f"{text!r:.40} is below 1 MiB; write for example 2GiB")
    return size


def region(text: str) -> Region:
    """Limits (y0, y1, x0, x1) of a rectangle written ``y0:y1,x0:x1``, ends excluded."""
    match = re.fullmatch(r"(\d{1,6}):(\d{1,6}),(\d{1,6}):(\d{1,6})", text.strip())
    if match is None:
        raise click.BadParameter(f"{text!r:.40} is not y0:y1,x0:x1, for example 0:128,0:256")
    y0, y1, x0, x1 = map(int, match.groups())
    if y0 >= y1 or x0 >= x1:
        raise click.BadParameter(f"{text!r:.40} is empty: the ends are excluded")
    return y0, y1, x0, x1


def examples(*lines: str) -> str:
    """Text at the foot of a command's help: shell lines that show its use."""
    title = "Example:" if len(lines) == 1 else "Examples:"
    return "\n".join(["\b", title, *(f"  {line}" for line in lines)])


class _Path(click.Path):
    """A path that is not empty, as that of a shell variable without a value is."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if not str(value):
            self.fail("empty; give a path", param, ctx)
        return super().convert(value, param, ctx)


PATH = _Path(path_type=Path)
acquisition_argument = click.argument("acquisition", metavar="ACQ", type=PATH)
run_argument = click.argument("run", metavar="RUN", type=PATH)
bench_argument = click.argument("bench", metavar="BENCH.yaml", type=PATH)
out_run_option = click.option(
    "--out",
    "run",
    metavar="RUN",
    required=True,
    type=PATH,
    help="Directory of the results; created if missing.",
)


class Finite(click.FloatRange):
    """A number in a range; ``nan`` is in none."""

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> float:
        """The number of a text."""
        number = float(super().convert(value, param, ctx))
        if not math.isfinite(number):
            self.fail(f"{value} is not a number.", param, ctx)
        return number


def config_options(kind: type, name: str = "config") -> Callable[[Command], Command]:
    """Add the options of a dataclass; the command receives an instance of it."""
    hints = get_type_hints(kind)
    words = meanings(kind)
    offered = [f for f in fields(kind) if not f.metadata.get("python_only")]

    def decorate(command: Command) -> Command:
        @functools.wraps(command)
        def with_config(*args: Any, **values: Any) -> Any:
            config = kind(**{f.name: values.pop(f.name) for f in offered})
            return command(*args, **{name: config}, **values)

        wrapped: Command = with_config
        for field in reversed(offered):
            wrapped = _option(field, hints[field.name], words[field.name])(wrapped)
        return wrapped

    return decorate


def _option(field: Field[Any], hint: Any, meaning: str) -> Callable[[Command], Command]:
    meta, default = field.metadata, field.default
    flag = meta.get("flag")
    unit = meta["unit"].rstrip("-")
    plain = field.name.removesuffix(f"_{unit}").replace("_", "-")
    if get_origin(hint) is UnionType:
        hint = get_args(hint)[0]
    multiple = get_origin(hint) is tuple and get_args(hint)[-1] is Ellipsis
    if multiple:
        hint = get_args(hint)[0]
    shown: Any = meta.get("shown")
    if meta["unit"] == "bytes":
        default, shown = shown, None  # as it is typed
    shows_default = not (default in (None, (), MISSING) or (hint is bool and not flag))
    number = (unit.upper() or "N") if hint in (int, float) else None
    return click.option(
        flag or f"--{plain}",
        field.name,
        type=_type(hint, meta),
        multiple=multiple,
        is_flag=hint is bool,
        required=default is MISSING,
        default=None if default is MISSING or multiple else default,
        show_default=shown or shows_default,
        metavar=meta.get("metavar", number),
        help=meaning,
    )


def _type(hint: Any, meta: Mapping[str, Any]) -> Any:
    low, high, above = meta["low"], meta["high"], meta["above"]
    if choices := get_args(hint) if get_origin(hint) is Literal else meta["choices"]:
        return click.Choice(choices)
    if hint == Region:
        return region
    if get_origin(hint) is tuple:
        return tuple(_type(one, meta) for one in get_args(hint))
    if meta["unit"] == "bytes":
        return memory_size
    if hint is int:
        return click.IntRange(low, high)
    if hint is float:
        return Finite(low if above is None else above, high, min_open=above is not None)
    return PATH if hint is Path else hint


def runtime_options(command: Command) -> Command:
    """Add the options on how to run; the command receives them as ``runtime``."""

    @click.option("--quiet", is_flag=True, help="No progress on stderr.")
    @config_options(Running, "running")
    @functools.wraps(command)
    def with_runtime(*args: Any, quiet: bool, running: Running, **values: Any) -> Any:
        # Here, not at the top: Dask takes longer to import than all of `pixcal --help`.
        from pixcal.engine.run import Runtime

        return command(*args, runtime=Runtime(**vars(running) | {"quiet": quiet}), **values)

    return with_runtime


def command(
    kind: type,
    *lines: str,
    arguments: Sequence[Callable[[Command], Command]] = (run_argument,),
    tasks: bool = True,
) -> Callable[[Command], click.Command]:
    """A command with the options of a dataclass, whose docstring and ``lines`` are its help.

    The body receives the ``arguments`` and a ``config``; if it runs ``tasks``, also a ``runtime``.
    """

    def decorate(body: Command) -> click.Command:
        body = config_options(kind)(runtime_options(body) if tasks else body)
        for argument in reversed(arguments):
            body = argument(body)
        name = kind.__name__.removesuffix("Config").lower()
        return click.command(name, help=inspect.getdoc(kind), epilog=examples(*lines))(body)

    return decorate
