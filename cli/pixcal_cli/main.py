"""The shell command ``pixcal``: its commands, its exit codes, and one line for every error."""

import errno
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Sequence
from types import FrameType

import click

from pixcal import __version__
from pixcal.model.errors import ClusterError, PixcalError
from pixcal_cli import steps
from pixcal_cli.blind import blind
from pixcal_cli.budget import budget
from pixcal_cli.click_options import examples
from pixcal_cli.compare import compare
from pixcal_cli.interrupted import leave

LONG_WORD = 600
"""A longer word of a message, such as a senseless value, is shortened (characters)."""


class InOrder(click.Group):
    """Lists its commands in processing order."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Names of the commands."""
        return list(self.commands)


@click.group(
    cls=InOrder,
    commands=[
        steps.run,
        steps.ingest,
        steps.reduce,
        steps.fit,
        steps.allan,
        steps.crests,
        steps.diagnose,
        steps.astrometry,
        steps.centroids,
        steps.wcs,
        steps.electrons,
        steps.report,
        compare,
        steps.simulate,
        budget,
        blind,
    ],
    invoke_without_command=True,
    context_settings={"help_option_names": ["-h", "--help"]},
    epilog=examples("pixcal run data_samples/demo --out demo"),
)
@click.version_option(__version__, prog_name="pixcal")
@click.pass_context
def cli(ctx: click.Context) -> None:
    """Maps of pixel response offsets from Young's fringes.

    `pixcal run` does everything; ingest to report are its steps. Each step writes a folder in RUN,
    skips what is up to date, and resumes after an interruption.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


def explain(error: BaseException) -> tuple[int, str]:
    """Exit code and line on stderr for an error; an empty line prints nothing."""
    again = "run the same command again to resume"
    match error:
        case click.UsageError(ctx=ctx):
            path = ctx.command_path if ctx else "pixcal"
            return 2, f"{error.format_message().rstrip('.')}; see '{path} --help'"
        case click.ClickException():
            return 2, error.format_message()
        case ClusterError():
            return 1, f"{error}; {again}"
        case PixcalError():
            return 2, str(error)
        case click.Abort() | KeyboardInterrupt():
            return 1, f"interrupted; {again}"
        case BrokenPipeError():
            return 1, ""
        case OSError(errno=errno.ENOSPC | errno.EDQUOT):
            place = f"{error.filename}: " if error.filename else ""
            return 1, f"{place}disk full; complete results are kept: free some space and {again}"
        case OSError(
            errno=errno.ENAMETOOLONG | errno.ELOOP | errno.ENOTDIR, filename=str() | os.PathLike()
        ):
            return 2, f"{error.filename}: cannot be used ({error.strerror}); choose another path"
        case PermissionError(filename=str() | os.PathLike()):
            return 2, f"{error.filename}: no permission; change its owner or mode"
        case OSError(filename=str() | os.PathLike()):
            return 1, f"{error.filename}: {error.strerror}"
        case MemoryError():
            return 1, "out of memory; lower --memory or --workers"
    return 1, f"internal error: {type(error).__name__}: {error} (PIXCAL_DEBUG=1 shows where)"


def one_line(message: str) -> str:
    """A message as one printable line, with long words shortened."""
    words = ("".join(c if c.isprintable() else "�" for c in word) for word in message.split())
    return " ".join(w if len(w) < LONG_WORD else f"{w[:150]}…{w[-150:]}" for w in words)


_interrupted = threading.Event()
PATIENCE_S = 30
"""Wait after Ctrl-C for running tasks, and for locks that the interrupt leaves locked."""


def _interrupt(number: int, frame: FrameType | None) -> None:
    _interrupted.set()
    signal.signal(signal.SIGALRM, leave)
    signal.alarm(PATIENCE_S)
    signal.default_int_handler(number, frame)


def invoke(args: Sequence[str]) -> int:
    """Run a command line; returns 0 on success, 2 for a usage or input error, else 1."""
    try:
        if os.environ.get("_PIXCAL_COMPLETE"):  # a shell asks what may follow
            cli.main(args, prog_name="pixcal", standalone_mode=False)
        code = _run(args)
        sys.stdout.flush()
    except (Exception, KeyboardInterrupt) as raised:
        # Libraries that are interrupted, most of all while they load, raise various errors.
        by_it = not isinstance(raised, PixcalError | click.ClickException)
        error = KeyboardInterrupt() if by_it and _interrupted.is_set() else raised
        if os.environ.get("PIXCAL_DEBUG"):
            traceback.print_exc()
        code, message = explain(error)
        if message:
            click.echo(f"pixcal: {one_line(message)}", err=True)
    return code


def _run(args: Sequence[str]) -> int:
    # Not click's own `main`, which answers Ctrl-C with an empty line.
    try:
        with cli.make_context("pixcal", list(args)) as context:
            cli.invoke(context)
    except click.exceptions.Exit as ended:  # of --help and --version
        return ended.exit_code
    return 0


def main() -> None:
    """Entry point of the shell command."""
    if not sys.warnoptions and not os.environ.get("PIXCAL_DEBUG"):
        # Libraries warn of what pixcal checks itself; what a user must know is in the results.
        warnings.simplefilter("ignore")
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    code = invoke(sys.argv[1:])
    # Nothing is left to be interrupted, and the interpreter would complain as it goes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGALRM, lambda *_: os._exit(code))
    try:
        sys.stdout.flush()
    except OSError:
        # stdout is closed: keep the interpreter from complaining as it flushes it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    sys.exit(code)
