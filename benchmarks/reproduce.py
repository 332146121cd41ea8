"""Reproduction of the paper's figures: ``make reproduce``, or ``python benchmarks/reproduce.py``.

Acquisitions, runs and figures are kept in a work folder and resume after an interruption:
``--figure 9`` repeats one figure, and the page keeps the others.
"""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path

from pixcal.engine.run import Runtime
from pixcal.storage.manifest import read_json, write_json
from reproduction import (
    figure_05,
    figure_09,
    figure_10,
    figure_11,
    figure_12,
    figure_14,
    figure_16,
    page,
)
from reproduction.lab import Lab
from reproduction.outcome import Outcome

ROOT = Path(__file__).parents[1]
FIGURES: dict[str, Callable[[Lab], Outcome]] = {
    "5": figure_05.make,
    "9": figure_09.make,
    "10": figure_10.make,
    "11": figure_11.make,
    "12": figure_12.make,
    "14": figure_14.make,
    "16": figure_16.make,
}
"""By the first figure of the paper that they make."""


def kept(folder: Path, figure: str) -> Outcome | None:
    """A figure as an earlier run left it."""
    told, picture = folder / f"{figure}.json", folder / f"{figure}.png"
    if not (told.exists() and picture.exists()):
        return None
    return Outcome.of_plain(read_json(told), picture.read_bytes())


def keep(folder: Path, figure: str, outcome: Outcome) -> None:
    """Keep a figure for later runs."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{figure}.png").write_bytes(outcome.picture)
    write_json(folder / f"{figure}.json", outcome.plain())


def main() -> None:
    """Make the requested figures, and the page of all existing ones."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--full", action="store_true", help="the paper's own sizes: about an hour")
    parser.add_argument("--figure", action="append", choices=FIGURES, help="only this one; again")
    parser.add_argument("--work", type=Path, default=ROOT / "work" / "reproduction")
    parser.add_argument("--out", type=Path, help="of the page; default: docs/appendix/reproduction")
    parser.add_argument("--quiet", action="store_true", help="no progress")
    options = parser.parse_args()
    work = options.work / ("full" if options.full else "quick")
    default = ROOT / "docs" / "appendix" / "reproduction"
    out = options.out or (default / "full" if options.full else default)
    lab = Lab(work, Runtime(quiet=options.quiet), options.full)
    outcomes = []
    for figure, make in FIGURES.items():
        outcome = None
        if options.figure and figure not in options.figure:
            outcome = kept(work / "figures", figure)
        else:
            begin = time.monotonic()
            outcome = make(lab)
            keep(work / "figures", figure, outcome)
            seconds = time.monotonic() - begin
            print(f"figure {outcome.figure}: {outcome.title} ({seconds:.0f} s)", file=sys.stderr)
        if outcome is not None:
            outcomes.append(outcome)
    print(page.write(out, outcomes, full=options.full))


if __name__ == "__main__":
    main()
