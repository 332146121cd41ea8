"""Outcome of a figure: a picture and measured numbers, described in words."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """One line of a figure's table."""

    quantity: str
    here: str  # what this run measured, with its unit
    paper: str = ""  # key of `paper.STATEMENTS`; empty where the paper says nothing of it


@dataclass(frozen=True)
class Outcome:
    """A reproduced figure."""

    figure: str  # number or numbers in the paper
    title: str
    run: str  # what was simulated, and how it differs from the paper's own size
    caption: str  # what the picture shows
    rows: tuple[Row, ...]
    difference: str  # why the numbers differ from the paper's, or do not
    numbers: dict[str, Any]  # everything measured, for programs
    picture: bytes  # PNG

    def plain(self) -> dict[str, Any]:
        """All but the picture, for JSON."""
        plain = asdict(self)
        del plain["picture"]
        return plain

    @classmethod
    def of_plain(cls, plain: dict[str, Any], picture: bytes) -> "Outcome":
        """From what `plain` gave."""
        rows = tuple(Row(**row) for row in plain["rows"])
        return cls(**plain | {"rows": rows, "picture": picture})
