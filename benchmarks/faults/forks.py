"""Commands of pixcal in separate processes that start immediately.

They are forked from a server that has loaded all libraries and compiled all kernels, so that a
fault at a random moment hits the work, not the imports.
"""

import multiprocessing
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.context import ForkServerContext, ForkServerProcess
from multiprocessing.synchronize import Event
from pathlib import Path

PATIENCE_S = 120.0
"""A command that takes longer hangs."""


@dataclass(frozen=True)
class Ended:
    """How a command ended."""

    code: int  # exit code, or minus the number of the signal
    # out, err: what it printed
    out: str
    err: str
    seconds: float  # time that it took

    def succeeded(self) -> "Ended":
        """Itself, when all is well."""
        assert self.code == 0, self.err
        assert self.err == ""
        return self

    def refused(self, code: int, *words: str) -> "Ended":
        """Itself, when it ended with this exit code and one line that holds some words."""
        assert self.code == code, (self.code, self.err, self.out)
        assert self.err.startswith("pixcal: "), (self.err, self.seconds)
        assert self.err.count("\n") == 1, self.err
        for word in words:
            assert word in self.err, (word, self.err)
        return self


@lru_cache
def _server() -> ForkServerContext:
    context = multiprocessing.get_context("forkserver")
    here = str(Path(__file__).parents[1])
    # The server does not take over sys.path before it loads what it is told to.
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [here, os.environ.get("PYTHONPATH")]))
    context.set_forkserver_preload(["faults.warm"])
    return context


class Command:
    """A command line of pixcal that has begun.

    ``args``: as typed after ``pixcal``; ``--quiet`` is added. ``before``: called in the process
    before the command (a function of a module, or a partial of one).
    """

    def __init__(self, args: Sequence[str], before: Callable[[], None] | None = None) -> None:
        self._files = tempfile.TemporaryDirectory()
        self._out, self._err = (Path(self._files.name) / name for name in ("out", "err"))
        self._begun = time.monotonic()
        self._listens = _server().Event()
        self.process: ForkServerProcess = _server().Process(
            target=_main, args=([*args, "--quiet"], self._out, self._err, before, self._listens)
        )
        self.process.start()

    def send(self, number: signal.Signals) -> None:
        """Send it a signal, if it still runs; Ctrl-C once it listens, and kill at any time."""
        while number == signal.SIGINT and self.process.is_alive() and not self._listens.wait(0.01):
            pass
        if self.process.is_alive() and self.process.pid is not None:
            with suppress(ProcessLookupError):
                os.kill(self.process.pid, number)

    def end(self) -> Ended:
        """Wait for its end."""
        self.process.join(PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            raise AssertionError(f"hangs: {self._err.read_text()}")
        seconds = time.monotonic() - self._begun
        assert self.process.exitcode is not None
        out, err = (f.read_text() if f.exists() else "" for f in (self._out, self._err))
        self._files.cleanup()
        return Ended(self.process.exitcode, out, err, seconds)


def pixcal(*args: str | Path, before: Callable[[], None] | None = None) -> Ended:
    """Run a command line to its end."""
    return Command([str(arg) for arg in args], before).end()


def _main(
    args: Sequence[str], out: Path, err: Path, before: Callable[[], None] | None, listens: Event
) -> None:
    for number, file in ((1, out), (2, err)):
        os.dup2(os.open(file, os.O_WRONLY | os.O_CREAT), number)
    sys.stdout = open(1, "w", closefd=False)  # noqa: SIM115
    sys.stderr = open(2, "w", closefd=False, buffering=1)  # noqa: SIM115
    from pixcal_cli.interrupted import leave
    from pixcal_cli.main import main

    if before is not None:
        before()
    sys.argv = ["pixcal", *args]
    try:
        # A shell that starts us in the background may have it ignored.
        signal.signal(signal.SIGINT, signal.default_int_handler)
        listens.set()
        main()
    except KeyboardInterrupt:  # as `pixcal_cli.__main__` does
        leave()
