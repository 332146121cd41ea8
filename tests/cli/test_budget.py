"""``pixcal budget`` on the command line."""

import json
from pathlib import Path

import pytest

from pixcal_cli.main import invoke

DEMO = Path(__file__).parents[2] / "configs/demo.yaml"


def printed(capsys: pytest.CaptureFixture[str], *args: str) -> str:
    assert invoke(["budget", str(DEMO), *args]) == 0
    return capsys.readouterr().out


def test_what_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys)
    assert text.startswith(f"budget: {DEMO}, 96 × 80 px, 16 e- rms without light\n")
    rows = {line.split("  ")[1].strip(): line.split() for line in text.splitlines() if "  " in line}
    assert rows["vertical alone"][2:5] == ["65792", "2.56", "h"]
    assert float(rows["delta_x, all sets"][3]) == pytest.approx(2 * 65792, rel=1e-3)
    for words in (
        "for 5e-05 px",
        "alternatives",
        "calibration frames",
        "read noise 8 e-",
        "left out:",
    ):
        assert words in text
    assert "with " not in text.split("frames for photon noise")[0]


def test_frames_instead_of_a_precision(capsys: pytest.CaptureFixture[str]) -> None:
    text = printed(capsys, "--frames", "960")
    assert "with 960 frames of each set" in text
    assert "px on each axis" not in text
    # Four times the planned 240: half the error.
    assert "0.000414" in text
    both = printed(capsys, "--frames", "960", "--precision", "1e-3")
    assert "for 0.001 px on each axis" in both
    assert "with 960 frames" in both


@pytest.mark.long
def test_json_and_files_are_the_same(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    out = tmp_path / "out"
    text = printed(capsys, "--json", "--out", str(out))
    assert json.loads(text) == json.loads((out / "budget.json").read_text())
    assert (out / "budget.png").read_bytes().startswith(b"\x89PNG")
    assert f"  {out / 'budget.png'}\n" in printed(capsys, "--out", str(out))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--precision", "0"], "--precision"),
        (["--precision", "2"], "--precision"),
        (["--frames", "0"], "--frames"),
        (["--precision", "1e-300"], "--precision"),
        (["--precision", "nan"], "--precision"),
    ],
)
def test_mistakes(args: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["budget", str(DEMO), *args]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert words in error


def test_an_acquisition_is_no_bench(capsys: pytest.CaptureFixture[str]) -> None:
    sample = DEMO.parents[1] / "data_samples/demo/acquisition.yaml"
    assert invoke(["budget", str(sample)]) == 2
    assert "schema: 'pixcal/acquisition/1' is not one of" in capsys.readouterr().err
