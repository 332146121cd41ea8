"""Ladders of flats as cameras record them: saturated, curved, of one exposure time or several."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy_detectors import Detector, reduced

LEVELS = tuple(np.linspace(0.05, 1.0, 12))
CAMERA = {"gain": 2.3, "noise": 8.0, "bias": 200.4, "scatter": 2.0, "top": 4095, "rate": 8000.0}


def ladder(steps: Sequence[tuple[float, float]], frames: int = 2) -> list[tuple[float, int, float]]:
    """Flats of exposure times (s) and lamps."""
    return [(float(t), frames, float(lamp)) for t, lamp in steps]


BOTH = [(0.5, lamp) for lamp in LEVELS[5:]] + [(0.1, 4 * lamp) for lamp in LEVELS[5:]]


@pytest.mark.parametrize(
    "steps",
    [[(t, 1) for t in LEVELS], [(0.5, 2 * lamp) for lamp in LEVELS], BOTH],
    ids=["exposure times", "lamps", "both"],
)
def test_any_ladder_tells_the_gain(steps: list[tuple[float, float]], tmp_path: Path) -> None:
    _, report = reduced(Detector(**CAMERA, flats=ladder(steps)), 1, tmp_path)
    gain = report["gain_e_per_adu"]
    assert gain["measured"] == pytest.approx(2.3, abs=4 * gain["error"])
    assert gain["error"] < 0.025
    assert gain["chi2_reduced"] < 2
    assert report["read_noise_e"]["measured"] == pytest.approx(8.0, rel=0.01)
    assert report["flags"]["good"] >= 96 * 96 - 2
    assert report["warnings"] == []


def test_levels_of_one_exposure_time_are_told_apart(tmp_path: Path) -> None:
    flats = ladder([(0.5, lamp) for lamp in (0.2, 0.6, 1.0)], 4)
    evidence, report = reduced(Detector(**CAMERA, flats=flats), 2, tmp_path)
    assert [len(stack.adu) for stack in evidence.of_kind("flat")] == [4, 4, 4]
    assert not evidence.steady_lamp
    assert report["linearity"] is None


def test_saturation_is_found_and_what_is_below_it_used(tmp_path: Path) -> None:
    camera = Detector(**CAMERA, flats=ladder([(2.4 * t, 1) for t in LEVELS]))
    evidence, report = reduced(camera, 3, tmp_path)
    assert report["saturation_adu"]["found"] == report["saturation_adu"]["used"] == 4095
    left_out = report["saturation_adu"]["levels_left_out"]
    assert 4 < left_out < 8
    assert any("saturate at 4095 ADU" in warning for warning in report["warnings"])
    assert report["gain_e_per_adu"]["measured"] == pytest.approx(2.3, rel=0.02)
    assert report["linearity"]["max_deviation_percent"] < 0.2
    assert len(evidence.ladder) == len(LEVELS) - left_out
    _, plain = reduced(
        Detector(**CAMERA, flats=ladder([(t, 1) for t in LEVELS])), 3, tmp_path / "b"
    )
    assert plain["saturation_adu"]["found"] is None


def test_a_curve_that_all_pixels_share_is_no_defect(tmp_path: Path) -> None:
    flats = ladder([(t, 1) for t in LEVELS], 4)
    curved = Detector(**CAMERA, flats=flats, prnu=0.1, response=lambda e: e * (1 - 0.12 * e / 8000))
    _, report = reduced(curved, 4, tmp_path)
    assert report["flags"]["nonlinear"] <= 0.001 * 96**2
    assert report["linearity"]["max_deviation_percent"] > 3
    assert any("no straight line" in warning for warning in report["warnings"])
    assert any("straight line over exposure time" in warning for warning in report["warnings"])
