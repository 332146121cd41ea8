"""``pixcal blind`` on the command line."""

import json
from pathlib import Path
from typing import Any

import pytest

from pixcal_cli.main import invoke


def test_an_examination_from_beginning_to_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exam, sealed = tmp_path / "exam", tmp_path / "truth.json"
    size = ["--cases", "1", "--seed", "1", "--size", "tiny", "--quiet"]
    assert invoke(["blind", "make", *size, "--out", str(exam), "--sealed", str(sealed)]) == 0
    assert capsys.readouterr().out == f"cases in {exam}: 1; their truth in {sealed}\n"
    products = exam / "runs" / "case-0001" / "products"
    products.mkdir(parents=True)
    diagnosis: dict[str, Any] = {"verdict": "no gap", "causes": [], "candidates": []}
    diagnosis["gap"] = {"after": 1.0, "where": []}
    (products / "diagnosis.json").write_text(json.dumps(diagnosis))
    sat = {"code": "a", "seconds": {"diagnosis": 1.0, "maps": 0.0}, "no_maps": "not diagnosed"}
    (products.parent / "sat.json").write_text(json.dumps(sat))
    assert invoke(["blind", "run", str(exam), "--limit", "3", "--quiet"]) == 0
    assert capsys.readouterr().out.startswith("cases diagnosed: 0;")
    page = tmp_path / "page.md"
    page.write_text("<!-- blind:tiny -->\n<!-- end -->\n")
    command = ["blind", "score", str(exam), "--sealed", str(sealed), "--quiet"]
    assert invoke([*command, "--write", str(page)]) == 0
    shown = capsys.readouterr().out
    assert "named first" in shown
    assert "note: case-0001: " in shown
    assert "0/1" in shown
    assert "development seed" in page.read_text()
    assert json.loads((exam / "score.json").read_text())["parts"]["1"]["cases"] == 1


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["run", "nowhere"], "nowhere/blind.json: not found"),
        (["score", "nowhere", "--sealed", "truth"], "nowhere/blind.json: not found"),
        (["make", "--cases", "0", "--seed", "1", "--out", "a", "--sealed", "b"], "--cases"),
        (["make", "--cases", "1", "--seed", "1", "--out", "a", "--sealed", "a/b"], "--sealed a/b"),
        (["make", "--cases", "1", "--seed", "1", "--out", "a"], "--sealed"),
    ],
)
def test_what_is_wrong_is_one_line(
    args: list[str],
    words: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert invoke(["blind", *args]) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())
