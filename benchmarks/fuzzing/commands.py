"""Bad values of every option and argument of all commands, found by a walk through them."""

import os
import shutil
from collections.abc import Iterator
from contextlib import chdir
from functools import cache
from pathlib import Path

import click
import numpy as np

from fuzzing.laws import (
    RUNTIME,
    Case,
    Kind,
    calibrate,
    check_line,
    good_input,
    lasting_folder,
    pixcal,
)
from fuzzing.night import Night
from fuzzing.settings import small_bench
from pixcal.model.errors import InputError
from pixcal_cli.main import cli, explain, one_line

VALUES = (
    "",
    " ",
    "-",
    "--",
    "---",
    "-1",
    "0",
    "1",
    "7",
    "-0.0",
    "1.5",
    "1e400",
    "-1e400",
    "1e-320",
    "nan",
    "inf",
    "-inf",
    "0x10",
    "1_0",
    "٣",
    "½",
    " 5 ",
    "9" * 25,
    "9" * 5000,
    "true",
    "None",
    "abc",
    "a b",
    "a\tb",
    "a\nb",
    "\x1b[31m",
    "\r",
    "💥",
    "\udcff",
    "e\u0301",
    "x" * 300,
    "x" * 5000,
    "%s%n",
    "{}",
    "$(id)",
    "*",
    "[",
    "[red]",
    "../up",
    "/dev/null",
    "/dev/null/x",
    "/proc/self/x",
    "/etc/passwd",
    "/nowhere/x",
    "~",
    "file",
    "file/x",
    "full",
    "locked",
    "loop",
    "a/" * 1500,
    "acq",
    "run",
    "run/fit",
    "bench.yaml",
    "rubbish.json",
)
OF_OPTION = {
    "cluster": (
        "thread",
        "THREADS",
        "threads ",
        "tcp://",
        "tcp://x",
        "tcp://:",
        "tcp://[::1",
        "://",
        "tcp://127.0.0.1:1",
        "tcp://127.0.0.1:99999",
        "tls://127.0.0.1:1",
        "ftp://x",
        "sync,",
    ),
    "memory": (
        "1GiB",
        "0",
        "1",
        "1MiB",
        "400MiB",
        "999999TiB",
        "1PiB",
        "1.GiB",
        "-1GiB",
        "1 GiB x",
    ),
    "cubes": (
        "s3://",
        "s3://[",
        "s3:x",
        "file:x",
        "file://",
        "file://x",
        "nothing://x",
        "http://",
        "s3://user:word@bucket/x",
        "s3://a b",
        "C:\\x",
        "::",
        "zip://x",
        "x://" + "y" * 300,
    ),
    "regions": (
        "0:1,0:1",
        "0:0,0:0",
        "5:1,0:1",
        "0:999999,0:1",
        "0:9999999,0:1",
        "0:1",
        "a:b,c:d",
        "0:4,0:4,0:4",
        "-1:2,0:3",
        "0:1;0:1",
        "٠:٣,٠:٣",
    ),
    "workers": ("4096", "4097"),
}
BASE = {
    "astrometry": ("--stars", "5", "--positions", "2", "--dither", "4"),
    "budget": ("--precision", "1e-3"),
}
SLOW = {"diagnose", "blind"}
"""Commands that take minutes: only how they are understood is looked at."""


@cache
def _good() -> Path:
    """A calibrated run, the acquisition that it is from, and a bench."""
    folder = lasting_folder()
    night = Night(np.random.default_rng(8), count=20)
    with good_input():
        calibrate(night.write(folder / "acq"), folder / "run")
    (folder / "bench.yaml").write_text(small_bench(), encoding="utf-8")
    return folder


Words = tuple[str, ...]


def commands(group: click.Group = cli, before: Words = ()) -> Iterator[tuple[Words, click.Command]]:
    """All commands, those of groups too, with the words that call them."""
    for name, command in group.commands.items():
        if isinstance(command, click.Group):
            yield from commands(command, (*before, name))
        else:
            yield (*before, name), command


@cache
def choices() -> list[tuple[Words, click.Command, click.Parameter, str]]:
    """Every bad value of every parameter of every command, in a shuffled order."""
    found = [
        (words, command, parameter, value)
        for words, command in commands()
        for parameter in command.params
        for value in (*VALUES, *OF_OPTION.get(str(parameter.name), ()))
    ]
    order = np.random.default_rng(0).permutation(len(found))
    return [found[n] for n in order]


def _line(words: Words, command: click.Command, bad: click.Parameter, value: str) -> list[str]:
    """A command line that is good but for one value."""
    good = {"acquisition": "acq", "run": "run", "runs": "run", "bench": "bench.yaml"}
    good |= {"out": "new.fits", "fwhm_px": "2.5", "table": "stars.csv", "files": "sky.fits"}
    if words[0] in ("run", "ingest"):
        good["run"] = "out"
    if words[0] == "simulate":
        good["acquisition"] = "out"
    line, arguments = [*words, *BASE.get(words[0], ())], []
    for parameter in command.params:
        told = value if parameter is bad else good.get(str(parameter.name), "")
        if isinstance(parameter, click.Argument):
            arguments.append(told)
        elif parameter is bad and getattr(parameter, "is_flag", False):
            line.append(f"{parameter.opts[0]}={told}")
        elif parameter is bad or parameter.required:
            line += [parameter.opts[0], told]
    names = {str(parameter.name) for parameter in command.params}
    for option, chosen in zip(RUNTIME[:4:2], RUNTIME[1:4:2], strict=True):
        if option[2:] in names - {bad.name}:
            line += [option, chosen]
    return [*line, *(["--quiet"] if "quiet" in names - {bad.name} else []), *arguments]


def _option(case: Case) -> None:
    """One bad value of one option or argument."""
    words, command, parameter, value = choices()[case.number % len(choices())]
    here = case.folder / "here"
    shutil.copytree(_good(), here)
    (here / "file").write_text("kept")
    (here / "rubbish.json").write_text("{")
    (here / "stars.csv").write_text("x,y\n10.5,12.25\n")
    shutil.copy(next((here / "acq").rglob("*.fits")), here / "sky.fits")
    (here / "loop").symlink_to("loop")
    (here / "full").mkdir()
    (here / "full" / "mine.txt").write_text("kept")
    (here / "locked").mkdir()
    (here / "locked").chmod(0o500)
    label = (parameter.metavar or str(parameter.name)).strip("[].").split("]")[0]
    shown = one_line(value.encode("utf-8", "backslashreplace").decode())
    names = [*parameter.opts, label, label.upper(), "RUN", "ACQ", "run", "option", shown[:40]]
    line = _line(words, command, parameter, value)
    if words[0] in SLOW:
        _parse_only(command, line[len(words) :])
        return
    try:
        with chdir(here):
            pixcal(*line, names=names if value.strip() else ())
    finally:
        for kept in ("file", "full/mine.txt"):
            assert (here / kept).read_text() == "kept", f"{kept} was overwritten"
        os.chmod(here / "locked", 0o700)  # noqa: PTH101


def _parse_only(command: click.Command, line: list[str]) -> None:
    """Parse a command line without running it."""
    try:
        command.make_context(str(command.name), line)
    except (click.UsageError, InputError) as error:
        check_line(f"pixcal: {one_line(explain(error)[1])}\n", (), str(command.name))


KINDS = [Kind("options", "bad values of all options and arguments", _option, 700)]
