"""Numbers, tables and notes on stdout."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import click

Columns = Mapping[str, Callable[[Any], Any]]  # by title, the cell made of a record


def number(value: float | None, digits: int = 4) -> str:
    """The value with some digits; a dash where there is none."""
    return "-" if value is None else f"{value:.{digits}g}"


def with_error(value: float | None, error: float | None) -> str:
    """The value rounded to two digits of its error."""
    if value is None or not error:
        return number(value)
    decimals = 1 - math.floor(math.log10(abs(error)))
    return " ± ".join(f"{round(v, decimals):.{max(0, decimals)}f}" for v in (value, error))


def show_table(header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    """Print columns below their titles."""
    cells = [header, *(["-" if value is None else str(value) for value in row] for row in rows)]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        line = "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        click.echo(f"  {line.rstrip()}")


def show_records(first: str, records: Mapping[str, Any], columns: Columns) -> None:
    """Print a row for each record: its name, then a cell for each column."""
    rows = [(name, *(cell(facts) for cell in columns.values())) for name, facts in records.items()]
    show_table((first, *columns), rows)


def show_notes(sentences: Iterable[str]) -> None:
    """Print notes, a line each."""
    for sentence in sentences:
        click.echo(f"  note: {sentence}")


def figure(value: float, error: float | None) -> str:
    """As `with_error`; a large number without error not as a power of ten."""
    return f"{value:.0f}" if error is None and value >= 1e4 else with_error(value, error)
