"""The commands of the blind examination and their options, as in `pixcal.model.options`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pixcal.model.config import quantity


@dataclass(frozen=True)
class MakeConfig:
    """Simulate cases with no, one or several effects, and seal the truth."""

    cases: int = quantity(low=1, high=9999, metavar="N", doc="Number of cases.")
    seed: int | None = quantity(
        None,
        low=0,
        high=10**18,
        doc="Random seed: below 1000 for development, 1000 and above for examinations. "
        "[default: a secret one, written to FILE]",
    )
    size: Literal["tiny", "small", "standard"] = quantity(
        "small",
        doc="small: 61 x 67 pixels, 2 x 300 frames; standard: 128 x 128, 2 or 3 x 600; "
        "tiny: 33 x 35, 2 x 60, to test the commands.",
    )
    bench: Literal["both", "second", "own"] = quantity(
        "both",
        doc="Simulator of the cases: the second bench, which shares no code with pixcal; "
        "pixcal's own (a self-check); or half of each.",
    )


@dataclass(frozen=True)
class RunConfig:
    """Diagnose every case of DIR that is not done yet."""

    again: bool = quantity(False, doc="Repeat cases that are done.")
    keep: bool = quantity(False, doc="Keep the whole runs, not only their products.")
    limit: int | None = quantity(None, low=1, doc="Diagnose at most N cases now.")


@dataclass(frozen=True)
class ScoreConfig:
    """Compare every diagnosis with its truth."""

    oracle: int = quantity(
        0,
        low=0,
        doc="Also simulate the true effects of the first N cases of parts 1 and 4, and compare the "
        "share of the gap that they close.",
    )
    write: Path | None = quantity(
        None, metavar="PAGE", doc="Markdown page into which to write the tables, between its marks."
    )
    also: tuple[tuple[Path, Path], ...] = quantity(
        (),
        metavar="DIR FILE",
        doc="Another examination to score: its directory and its file of the truth; repeatable.",
    )
