"""The pages: every figure with its picture, next to the statements of the paper."""

import json
import os
from collections.abc import Sequence
from pathlib import Path

from pixcal import __version__
from reproduction.lab import CONFIGS
from reproduction.outcome import Outcome, Row
from reproduction.paper import STATEMENTS, Statement

LEAD = """\
Figures of Rousset et al., "Pixel-Level Calibration for Space-Based High Precision Astrometry Using
Young's Fringes", simulated and analysed with the benches in [`configs/paper`]({configs}).
`{command}` ({version}) writes these pages. Numbers in the column "here" are measured in that run;
[numbers.json](numbers.json) holds all of them. {size}
"""
QUICK = (
    "Windows and frames are smaller than the paper's; `make reproduce-full` uses those of the "
    "paper."
)
FULL = "Windows and frames are the paper's."


def write(folder: Path, outcomes: Sequence[Outcome], *, full: bool) -> Path:
    """Write a page and a picture of each figure, ``numbers.json``, and ``README.md``, returned."""
    folder.mkdir(parents=True, exist_ok=True)
    lead = LEAD.format(
        configs=Path(os.path.relpath(CONFIGS, folder)).as_posix(),
        command="make reproduce-full" if full else "make reproduce",
        version=f"pixcal {__version__}",
        size=FULL if full else QUICK,
    )
    links = [f"- [{_heading(o)}](figure-{o.figure}.md)\n" for o in outcomes]
    for outcome in outcomes:
        file = folder / f"figure-{outcome.figure}.png"
        file.write_bytes(outcome.picture)
        file.with_suffix(".md").write_text(_figure(outcome, file.name), encoding="utf-8")
    page = folder / "README.md"
    page.write_text(f"# The paper's figures\n\n{lead}\n{''.join(links)}", encoding="utf-8")
    numbers = {outcome.figure: outcome.numbers for outcome in outcomes}
    (folder / "numbers.json").write_text(
        json.dumps({"pixcal": __version__, "full": full, "figures": numbers}, indent=1),
        encoding="utf-8",
    )
    return page


def _heading(outcome: Outcome) -> str:
    plural = "s" if "-" in outcome.figure else ""
    return f"Figure{plural} {outcome.figure}: {outcome.title}"


def _figure(outcome: Outcome, picture: str) -> str:
    table = ["| | the paper | where | here |", "|---|---|---|---|"]
    table += [_line(row) for row in outcome.rows]
    return "\n".join(
        [
            f"# {_heading(outcome)}\n",
            f"{outcome.run}\n",
            f"![{_heading(outcome)}]({picture})\n",
            f"{outcome.caption}\n",
            *table,
            f"\n**Difference.** {outcome.difference}\n",
        ]
    )


def _line(row: Row) -> str:
    said = STATEMENTS[row.paper] if row.paper else Statement("–", "–")
    cells = (row.quantity, said.text, said.place, row.here)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"
