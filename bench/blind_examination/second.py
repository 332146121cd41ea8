"""Cases of the second bench, a separate program that shares no code with pixcal."""

import importlib.util
import json
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from blind_examination.benches import Layout
from pixcal.model.errors import InputError

F64 = NDArray[np.float64]

PROGRAM = "second_bench"
NEEDED = ("hcipy", "galsim")
BIAS, FLATS = 40, 40  # frames of a case; the smallest sizes have fewer
INSTALL = "install them with 'pip install pixcal[second-bench]'"


@dataclass(frozen=True)
class SecondLaw:
    """A law of an effect, as the second bench lists it."""

    effect: str
    name: str
    weak: float  # weak, strong: sizes at strengths 0 and 1
    strong: float
    unit: str
    known: bool  # known, decidable: whether pixcal has the effect, and whether frames can show it
    decidable: bool
    needs: str  # required package

    def size(self, strength: float) -> float:
        """Size of the effect, in its unit."""
        return float(self.weak * (self.strong / self.weak) ** strength)


@dataclass(frozen=True)
class SecondCase:
    """Request to the second bench."""

    case: str
    seed: int
    strength: float  # from 0 to 1


def _there(package: str) -> bool:
    return not package or importlib.util.find_spec(package) is not None


def missing() -> list[str]:
    """Packages that the second bench needs but that are not installed."""
    return [name for name in (PROGRAM, *NEEDED) if not _there(name)]


@cache
def catalogue() -> tuple[tuple[str, ...], tuple[SecondLaw, ...], tuple[str, ...]]:
    """Variations of ordinary benches, available laws, and missing packages for other laws.

    InputError if the second bench cannot be run.
    """
    if missing():
        raise InputError(
            f"the second bench needs {', '.join(missing())}; {INSTALL}, or use --bench own"
        )
    listing = json.loads(_asked("--list", "--json"))
    laws = [SecondLaw(**facts) for facts in listing["laws"]]
    absent = sorted({law.needs for law in laws if not _there(law.needs)})
    available = tuple(law for law in laws if law.needs not in absent)
    return tuple(listing["variations"]), available, tuple(absent)


def _asked(*line: str | Path) -> str:
    """Standard output of the program for given arguments."""
    command = [sys.executable, "-m", PROGRAM, *map(str, line)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(f"the second bench failed: {reason}")
    return done.stdout


def _options(case: SecondCase, layout: Layout) -> Sequence[str]:
    # The case may come from a file, and must not be taken for an option.
    if not re.fullmatch(r"[a-z0-9_]+(/[a-z0-9_]+)?(\+[a-z0-9_]+(/[a-z0-9_]+)?)*", case.case):
        raise InputError(f"{case.case!r}: not a case of the second bench; give another sealed file")
    (ny, nx), many = layout.shape, min(FLATS, layout.frames // 2)
    line = f"{case.case} --seed {case.seed} --strength {case.strength} --size {ny} {nx}"
    return f"{line} --frames {layout.frames} --bias {min(BIAS, many)} --flats {many}".split()


def record_second(case: SecondCase, layout: Layout, out: Path) -> None:
    """Record a case into a new folder."""
    with tempfile.TemporaryDirectory(prefix="pixcal-second-") as scratch:
        truth = Path(scratch) / "truth.json"
        _asked(*_options(case, layout), "--out", out, "--truth", truth)


def second_offsets(case: SecondCase, layout: Layout) -> tuple[F64, F64]:
    """True offsets (y, x) of a case along x and y, px."""
    with tempfile.TemporaryDirectory(prefix="pixcal-second-") as scratch:
        truth = Path(scratch) / "truth.json"
        _asked(*_options(case, layout), "--truth", truth)
        contents: dict[str, Any] = json.loads(truth.read_text())
    return np.asarray(contents["delta_x"], float), np.asarray(contents["delta_y"], float)
