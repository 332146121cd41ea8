"""The page shows every figure beside what the paper states; nothing is left out in silence."""

import ast
import json
from pathlib import Path

import pytest

from reproduction import page
from reproduction.outcome import Outcome, Row
from reproduction.paper import STATEMENTS

MODULES = sorted(Path(page.__file__).parent.glob("figure_*.py"))


def outcome(figure: str, *rows: Row) -> Outcome:
    return Outcome(
        figure, "A title", "Some frames.", "What is seen.", rows, "None.", {"value": 1.5}, b"png"
    )


def test_a_page_holds_pictures_statements_and_numbers(tmp_path: Path) -> None:
    rows = (Row("slope", "−0.5", "slope"), Row("other | thing", "2 px"))
    written = page.write(tmp_path, [outcome("11", *rows), outcome("16-17")], full=False)
    text = (tmp_path / "figure-11.md").read_text()
    said = STATEMENTS["slope"]
    assert f"| slope | {said.text} | {said.place} | −0.5 |" in text
    assert "| other \\| thing | – | – | 2 px |" in text
    assert (tmp_path / "figure-16-17.md").read_text().startswith("# Figures 16-17: A title\n")
    lead = written.read_text()
    assert "- [Figure 11: A title](figure-11.md)\n" in lead
    assert "[Figures 16-17: A title](figure-16-17.md)" in lead
    assert "`make reproduce`" in lead
    assert (tmp_path / "figure-16-17.png").read_bytes() == b"png"
    numbers = json.loads((tmp_path / "numbers.json").read_text())
    assert numbers["figures"]["11"] == {"value": 1.5}
    assert not numbers["full"]


def test_a_statement_that_the_paper_does_not_make_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(KeyError, match="nowhere"):
        page.write(tmp_path, [outcome("5", Row("a", "1", "nowhere"))], full=True)


def test_an_outcome_survives_being_kept() -> None:
    one = outcome("9", Row("a", "1", "target"))
    assert Outcome.of_plain(json.loads(json.dumps(one.plain())), one.picture) == one


def test_every_statement_is_held_against_a_measurement_and_exists() -> None:
    """The third word of each ``Row`` of the figures, against the paper's table."""
    used = set()
    for module in MODULES:
        for node in ast.walk(ast.parse(module.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "Row":
                used |= {a.value for a in node.args[2:] if isinstance(a, ast.Constant)}
    assert used == set(STATEMENTS)
