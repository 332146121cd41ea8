"""``pixcal astrometry``: options to the stage, its numbers to stdout."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixcal.stages import astrometry
from pixcal.stages.astrometry.summary import axis_facts
from pixcal.storage.manifest import write_json
from pixcal_cli.main import invoke


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    """The stage's body replaced by one that notes its arguments and leaves numbers."""
    made: list[tuple[Any, ...]] = []

    def body(run: Path, config: Any, runtime: Any) -> None:
        made.append((run, config, runtime))
        rng = np.random.default_rng(1)
        errors = rng.normal(size=(50, 4, 6)) * [3e-3, 2e-4, 3e-3, 3e-4, 3e-3, 2e-4]
        axis = axis_facts(errors, 1e-4, 7000.0, drawn=False, rng=rng)
        (run / "astrometry").mkdir(parents=True)
        write_json(
            run / "astrometry" / "astrometry.json",
            {
                "telescope": {
                    "diameter_m": 7.0,
                    "focal_length_m": 130.0,
                    "wavelength_nm": 600.0,
                    "uas_per_px": 7000.0,
                    "px_per_lambda_over_d": 2.5,
                },
                "stars": {"electrons": 1e8, "positions": 4, "number": 50},
                "axes": {"x": axis, "y": axis},
                "warnings": ["a sentence"],
            },
        )

    monkeypatch.setattr(astrometry, "run", body)
    return made


def test_options_reach_the_stage(calls: list[tuple[Any, ...]], tmp_path: Path) -> None:
    options = (
        "--truth there --diameter 2.4 --focal-length 57.6 --wavelength 500 --obscuration 0.3 "
        "--electrons 1e6 --background 9 --window 15 --stars 30 --positions 4 --dither 7 --seed 5"
    )
    assert invoke(["astrometry", str(tmp_path), *options.split(), "--quiet"]) == 0
    ((run, config, runtime),) = calls
    assert run == tmp_path
    assert config == astrometry.Config(
        Path("there"), 2.4, 57.6, 500.0, 0.3, 1e6, 9.0, 15, 30, 4, 7.0, 5
    )
    assert runtime.quiet


def test_the_defaults_are_the_papers(calls: list[tuple[Any, ...]], tmp_path: Path) -> None:
    assert invoke(["astrometry", str(tmp_path)]) == 0
    assert calls[0][1] == astrometry.Config()


def test_what_is_printed(
    calls: list[tuple[Any, ...]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert invoke(["astrometry", str(tmp_path), "--quiet"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == f"astrometry: {tmp_path / 'astrometry'} (written)"
    assert "7 mas/px" in lines[1]
    assert " ".join(lines[2].split()) == (
        "error of a centroid along perfect grid measured maps gain"
    )
    rows = [line for line in lines if " px, " in line and "µas" in line][1:]
    assert [row.split("  ")[1] for row in rows[::2]] == [
        "no photon noise",
        "1e8 e-",
        "mean of 4 positions",
        "between two stars",
    ]
    assert any("positions to 5e-05 px along y" in line for line in lines)
    assert lines[-2:] == ["  note: a sentence", f"  {tmp_path / 'products' / 'astrometry.png'}"]


@pytest.mark.parametrize(
    "option",
    [
        "--diameter 0",
        "--electrons nan",
        "--window 2",
        "--obscuration 1",
        "--stars 1",
        "--background inf",
        "--window 12",
        "--electrons 1e17",
    ],
)
def test_what_cannot_be(option: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["astrometry", str(tmp_path), *option.split()]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert option.split()[0] in error


def test_a_run_that_is_not_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert invoke(["astrometry", str(tmp_path / "nowhere")]) == 2
    assert "pixcal ingest" in capsys.readouterr().err
