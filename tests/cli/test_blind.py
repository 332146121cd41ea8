"""``pixcal blind`` on the command line."""

import json
from pathlib import Path
from typing import Any

import pytest

from pixcal_cli.main import invoke


@pytest.mark.long
def test_an_examination_from_beginning_to_end(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    exam, sealed = tmp_path / "exam", tmp_path / "truth.json"
    size = ["--cases", "1", "--seed", "1", "--size", "tiny", "--bench", "own", "--quiet"]
    assert invoke(["blind", "make", *size, "--out", str(exam), "--sealed", str(sealed)]) == 0
    assert capsys.readouterr().out == f"cases in {exam}: 1; their truth in {sealed}\n"
    products = exam / "runs" / "case-0001" / "products"
    products.mkdir(parents=True)
    diagnosis: dict[str, Any] = {"verdict": "no gap", "causes": [], "candidates": []}
    diagnosis["gap"] = {"after": 1.0, "where": []}
    (products / "diagnosis.json").write_text(json.dumps(diagnosis))
    done = {"code": "a", "seconds": {"diagnosis": 1.0, "maps": 0.0}, "no_maps": "not diagnosed"}
    (products.parent / "done.json").write_text(json.dumps(done))
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


def sat(folder: Path, seed: int, size: str, capsys: pytest.CaptureFixture[str]) -> list[str]:
    """An examination of one case, in which nothing was found: folder and truth."""
    exam, sealed = folder / f"exam-{seed}", folder / f"truth-{seed}.json"
    drawn = ["--cases", "1", "--seed", str(seed), "--size", size, "--bench", "own", "--quiet"]
    assert invoke(["blind", "make", *drawn, "--out", str(exam), "--sealed", str(sealed)]) == 0
    products = exam / "runs" / "case-0001" / "products"
    products.mkdir(parents=True)
    gap = {"after": 1.0, "where": []}
    diagnosis = {"verdict": "no gap", "causes": [], "candidates": [], "gap": gap}
    (products / "diagnosis.json").write_text(json.dumps(diagnosis))
    capsys.readouterr()
    return [str(exam), str(sealed)]


def test_examinations_are_scored_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (one, its), (other, others) = (sat(tmp_path, seed, "tiny", capsys) for seed in (3, 1004))
    command = ["blind", "score", one, "--sealed", its, "--quiet"]
    assert invoke([*command, "--also", other, others]) == 0
    assert "note: exam-3/case-0001: " in capsys.readouterr().out
    score = json.loads((Path(one) / "score.json").read_text())
    assert score["seed"] == [3, 1004]
    assert score["made"] == 2
    assert [case["case"] for case in score["cases"]] == ["exam-3/case-0001", "exam-1004/case-0001"]
    assert score["parts"]["1"]["cases"] == 2
    # One of them is for development.
    assert score["purpose"] == "development"
    assert "seeds 3, 1004" in (Path(one) / "score.md").read_text()
    assert not (Path(other) / "score.json").exists()


def test_what_does_not_go_together_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (one, its), (other, others) = (
        sat(tmp_path, seed, size, capsys) for seed, size in ((3, "tiny"), (4, "small"))
    )
    command = ["blind", "score", one, "--sealed", its, "--quiet"]
    assert invoke([*command, "--also", one, its]) == 2
    assert "given twice; name each once" in capsys.readouterr().err
    assert invoke([*command, "--also", other, others]) == 2
    assert "of size small" in capsys.readouterr().err
    assert invoke([*command, "--also", other, its]) == 2
    assert not (Path(one) / "score.json").exists()


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
