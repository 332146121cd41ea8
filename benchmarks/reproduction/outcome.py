"""What a figure leaves: a picture and measured numbers, told in words."""

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Row:
    """One line of a figure's table.

    Attributes
    ----------
    quantity : str
    here : str
        What this run measured, with its unit.
    paper : str
        Key of `paper.STATEMENTS`; empty where the paper says nothing of it.
    """

    quantity: str
    here: str
    paper: str = ""


@dataclass(frozen=True)
class Outcome:
    """A figure made again.

    Attributes
    ----------
    figure : str
        Number or numbers in the paper.
    title : str
    run : str
        What was simulated, and how it differs from the paper's own size.
    caption : str
        What the picture shows.
    rows : tuple of Row
    difference : str
        Why the numbers differ from the paper's, or do not.
    numbers : dict
        Everything measured, for programs.
    picture : bytes
        PNG.
    """

    figure: str
    title: str
    run: str
    caption: str
    rows: tuple[Row, ...]
    difference: str
    numbers: dict[str, Any]
    picture: bytes

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
