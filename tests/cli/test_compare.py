"""``pixcal compare`` on the command line."""

import shutil
from pathlib import Path
from typing import Any

import pytest

from pixcal.engine.run import Runtime
from pixcal.stages import fit
from pixcal_cli.main import invoke


@pytest.fixture(scope="module")
def run(make_bench: Any, write_reduced: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A fitted run of nine batches."""
    bench = make_bench(shape=(61, 67), frames=150, laser_noise=0.01)
    folder: Path = write_reduced(bench, tmp_path_factory.mktemp("compare") / "night")
    fit.run(folder, fit.Config(), Runtime())
    return folder


def test_what_is_printed(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    command = ["compare", str(run), "--out", str(out), "--quiet"]
    assert invoke(command) == 0
    text = capsys.readouterr().out
    lines = text.splitlines()
    assert lines[:3] == [f"compare: {out} (written)", "", "night, first half | night, second half"]
    (total,) = (line.split() for line in lines if line.startswith("  delta_x  4087"))
    assert 0.9 < float(total[13]) < 1.1
    assert [line.split()[0] for line in lines if " px " in line][:4] == [
        "pixels",
        "scale",
        "1",
        "2",
    ]
    assert any(line.startswith("  8 px and larger") for line in lines)
    assert "  note: delta_x: consistent with noise" in lines
    assert lines[-2:] == [f"  {out / 'compare.json'}", f"  {out / 'compare.png'}"]
    assert invoke([*command, "--split", "halves"]) == 0
    assert capsys.readouterr().out == text.replace("(written)", "(up to date)")


@pytest.mark.long
def test_three_runs(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    names = []
    for name in ("one", "two", "three"):
        shutil.copytree(run, tmp_path / name)
        names.append(str(tmp_path / name))
    assert invoke(["compare", *names, "--out", str(tmp_path / "out"), "--quiet"]) == 0
    text = capsys.readouterr().out
    for pair in ("one | two", "one | three", "two | three"):
        assert f"\n{pair}\n" in text
    assert "errors of each map beyond noise" in text
    assert "delta_x: the maps agree better than their noise allows" in text


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ([], "Missing argument 'RUN [RUN]...'"),
        (["nowhere"], "nowhere: no such run directory"),
        (["--split", "thirds", "x"], "--split"),
        (["--sigma-accuracy", "2", "x"], "--sigma-accuracy"),
        (["--sigma-accuracy", "nan", "x"], "--sigma-accuracy"),
    ],
)
def test_mistakes(args: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["compare", *args]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error
