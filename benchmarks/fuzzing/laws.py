"""Rules for any input: exit 2 with one helpful line, or a truthful result."""

import atexit
import io
import json
import os
import re
import shutil
import signal
import sys
import traceback
import warnings
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile, mkdtemp
from types import FrameType
from typing import Literal

import numpy as np

from pixcal_cli.main import invoke

SECONDS = 60
"""A case that takes longer hangs; the slowest takes some seconds."""
MEMORY = 1 << 30
"""What commands are allowed by ``--memory``."""
INTERPRETER = 350 << 20
"""Of that, what an interpreter with all libraries takes, which here is there before."""
SCRATCH = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""Where cases lie: thousands of small files take long to remove from a disk."""
LONGEST = 700
"""Characters of a message, paths left out: more is no line that helps."""
RUNTIME = ("--cluster", "sync", "--memory", "1GiB", "--quiet")

MENDS = re.compile(
    r"; |expected|must be|is (above|below)|not one of|the keys here are|missing|known are"
    r"|are needed|not valid YAML|not allowed|twice|not found|number too large|in the range"
    r"|too large|is not |cannot be (read|used|written)|the limit is|Did you mean|Possible|choose"
    r"|no room|do not fit|at least|more than half|is zero|no frames at all|not a |not in UTC"
    r"|no permission|empty"
)
"""Words by which a message says what would mend the input, or what was expected instead."""


class Broken(AssertionError):
    """A rule is broken; the message says which."""


class Refused(Exception):
    """A command refused its input; the message is the line it printed."""


class Hang(BaseException):
    """The time limit of a case is over (no Exception, so that nothing swallows it)."""


@dataclass(frozen=True)
class Case:
    """One bad input."""

    number: int  # of the case among its kind; kinds that count through a list take it from there
    rng: np.random.Generator  # for everything that is drawn; from the kind and the number alone
    folder: Path  # an empty directory of its own

    def pick(self, *choices: object) -> object:
        """One of some values."""
        return choices[int(self.rng.integers(len(choices)))]


@dataclass(frozen=True)
class Kind:
    """A kind of bad input: its name, what the table calls it, and what makes and judges a case."""

    name: str
    title: str
    judge: Callable[[Case], object]
    cases: int = 1000
    """In the long version."""


@dataclass(frozen=True)
class Verdict:
    """How a case ended; ``why`` is the law that was broken, or the message of a refusal."""

    outcome: Literal["refused", "truthful", "failed"]
    why: str = ""


def judged(kind: Kind, number: int) -> Verdict:
    """Make a case, run pixcal on it, and check the rules."""
    rng = np.random.default_rng([zlib.crc32(kind.name.encode()), number])
    verdict = Verdict("truthful")
    with TemporaryDirectory(dir=SCRATCH, prefix="pixcal-fuzz-") as folder:
        try:
            with time_limit(SECONDS), memory_limit(), warnings.catch_warnings():
                warnings.simplefilter("ignore")  # as the command line does
                try:
                    kind.judge(Case(number, rng, Path(folder)))
                except Refused as refusal:
                    verdict = Verdict("refused", str(refusal))
        except Broken as error:
            return Verdict("failed", str(error))
        except Hang:
            return Verdict("failed", f"still at work after {SECONDS} s")
        except Exception as error:
            where = traceback.extract_tb(error.__traceback__)[-1]
            told = " ".join(f"{type(error).__name__}: {error}".split())
            return Verdict("failed", f"{told:.300} ({Path(where.filename).name}:{where.lineno})")
    return verdict


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `Hang` in this thread when the time is over."""

    def over(_signal: int, _frame: FrameType | None) -> None:
        raise Hang

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


@contextmanager
def memory_limit() -> Iterator[None]:
    """Raise `Broken` where this process grew by more than a plan for `MEMORY` allows."""
    most = MEMORY - INTERPRETER
    status, clear = Path("/proc/self/status"), Path("/proc/self/clear_refs")
    try:
        clear.write_text("5")  # the peak from now on
    except OSError:
        yield
        return
    before = _kib(status, "VmRSS")
    yield
    grown = (_kib(status, "VmHWM") - before) << 10
    if grown > most:
        raise Broken(f"took {grown >> 20} MiB where {most >> 20} MiB are planned")


def _kib(status: Path, key: str) -> int:
    found = re.search(rf"{key}:\s+(\d+) kB", status.read_text())
    return int(found[1]) if found else 0


def pixcal(*args: str | Path, names: Sequence[str] = ()) -> None:
    """Run a command in this process and check how it ends.

    ``names``: a refusal must name one of these: the file, the key or the option that is bad. Raises
    Refused for exit code 2 with one line that helps; Broken for any other failure.
    """
    # As the interpreter makes its own: what cannot be encoded is an error on stdout only.
    out = io.TextIOWrapper(io.BytesIO(), "utf-8", "strict")
    err = io.TextIOWrapper(io.BytesIO(), "utf-8", "backslashreplace")
    words = [str(arg) for arg in args]
    with below_python() as below, redirect_stdout(out), redirect_stderr(err):
        try:
            code = invoke(words)
        except SystemExit as error:
            raise Broken(f"{_line(words)}: left by SystemExit({error.code})") from error
        out.flush()
    said = told(err) + below[0]
    if code == 0:
        if said:
            raise Broken(f"{_line(words)}: success, and on stderr {said[:200]!r}")
        return
    if code != 2:
        raise Broken(f"{_line(words)}: exit code {code}: {said:.300}")
    check_line(said, names, _line(words))
    raise Refused(said.strip())


@contextmanager
def good_input() -> Iterator[None]:
    """What is not to be refused."""
    try:
        yield
    except Refused as refusal:
        raise Broken(f"good input is refused: {refusal}") from refusal


@contextmanager
def below_python() -> Iterator[list[str]]:
    """What libraries write to the process's own stderr, past Python; a list, filled at the end."""
    found: list[str] = []
    kept = os.dup(2)
    with TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield found
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            found.append(file.read().decode("utf-8", "replace"))


def told(stream: io.TextIOWrapper) -> str:
    """What was written to a stream."""
    stream.flush()
    raw = stream.buffer
    assert isinstance(raw, io.BytesIO)
    return raw.getvalue().decode("utf-8")


def check_line(said: str, names: Sequence[str], where: str) -> None:
    """Raise `Broken` unless a refusal is one line that names the fault and the remedy."""
    if not said.startswith("pixcal: ") or not said.endswith("\n") or len(said.splitlines()) != 1:
        raise Broken(f"{where}: not one line: {said[:300]!r}")
    if any(ord(c) < 32 or ord(c) == 127 for c in said[:-1]):
        raise Broken(f"{where}: control characters in {said[:300]!r}")
    if len(re.sub(r"/\S+", "", said)) > LONGEST:
        raise Broken(f"{where}: {len(said)} characters: {said[:200]!r}…")
    if "Traceback" in said or "internal error" in said:
        raise Broken(f"{where}: {said:.300}")
    if names and not any(name in said for name in names):
        raise Broken(f"{where}: names none of {', '.join(names):.200}: {said:.300}")
    if not MENDS.search(said):
        raise Broken(f"{where}: does not say what mends it: {said:.300}")


def _line(words: Sequence[str]) -> str:
    return " ".join(f"{word:.60}" for word in words if word not in RUNTIME)


def calibrate(acquisition: Path, run: Path, names: Sequence[str] = (), *more: str) -> None:
    """Run ingest, reduce, fit, allan and ``more`` on an acquisition, as far as they get.

    ``names``: what a refusal of ingest must name one of; later steps name the set or the run.
    """
    pixcal("ingest", acquisition, "--out", run, *RUNTIME, names=names)
    for command in ("reduce", "fit", "allan", *more):
        named = [str(run), "--memory", "frames.", "fringe set", *names]
        pixcal(command, run, *RUNTIME, names=named)


def describe_calibration(folder: Path, **frames: list[str]) -> None:
    """Write ``acquisition.yaml`` with globs of bias, dark or flat frames."""
    described = {
        "schema": "pixcal/acquisition/1",
        "detector": {"pitch_um": 4.4, "gain_e_per_adu": 1.0, "read_noise_e": 16.0},
        "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
        "frames": frames,
    }
    (folder / "acquisition.yaml").write_text(json.dumps(described))


def lasting_folder() -> Path:
    """A directory for what many cases read; removed when the process ends."""
    folder = mkdtemp(dir=SCRATCH, prefix="pixcal-fuzz-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def encodable(text: str) -> bool:
    """Whether a text can be a file name here (NUL and lone surrogates of no byte cannot)."""
    try:
        return b"\0" not in text.encode(sys.getfilesystemencoding(), "surrogateescape")
    except UnicodeEncodeError:
        return False
