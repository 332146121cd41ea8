"""Blocks of a section of the page: figures, tables, paragraphs, and collapsible parts."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass

from matplotlib.figure import Figure

from pixcal.report.drawing import DPI, png
from pixcal.report.tables import Table


@dataclass(frozen=True)
class Plate:
    """A figure with its title, and a caption that says what is good and what is bad."""

    title: str
    caption: str
    picture: str
    width: int
    height: int
    kind: str = "plate"


@dataclass(frozen=True)
class Words:
    """A paragraph; ``role`` is ``plain``, ``heading``, ``answer``, or ``advice``.

    ``level`` is that of an answer: ``good``, ``check`` or ``bad``.
    """

    text: str
    role: str = "plain"
    level: str = ""
    kind: str = "words"


@dataclass(frozen=True)
class Fold:
    """A collapsible group of blocks."""

    title: str
    blocks: Sequence["Plate | Table | Words"]
    kind: str = "fold"


Block = Plate | Table | Words | Fold


@dataclass(frozen=True)
class Section:
    """A chapter of the page."""

    id: str
    title: str
    lead: str
    blocks: Sequence[Block]


def plate(title: str, caption: str, figure: Figure) -> Plate:
    """A figure as a PNG that is part of the page."""
    body = png(figure)
    # The size in the page is the figure's in inches at 106 px an inch: text of 10 pt is 15 px.
    width, height = (round(v * 106) for v in figure.get_size_inches())
    data = base64.b64encode(body).decode("ascii")
    assert figure.dpi == DPI
    return Plate(title, caption, f"data:image/png;base64,{data}", width, height)


def folded(table: Table, shown: int, what: str) -> list[Block]:
    """A table whose rows beyond the first ones are collapsed; ``what`` names them."""
    if len(table.rows) <= shown + 2:
        return [table]
    rest = table.rows[shown:]
    title = f"{len(rest)} more {what}"
    return [
        Table(table.title, table.header, table.rows[:shown]),
        Fold(title, [Table(f"{table.title}, continued", table.header, rest)]),
    ]
