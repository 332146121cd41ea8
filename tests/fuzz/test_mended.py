"""What bad input once broke, each by itself."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits

from fuzzing.laws import Refused, calibrate, pixcal
from fuzzing.night import Night
from pixcal.model.acquisition import Frames
from pixcal.model.errors import InputError
from pixcal.simulation.own_effect import effect_of_file
from pixcal.storage.sources import find_sources

ONE = {"vertical": (1.18, 0.02)}


def night(seed: int = 1, **options: Any) -> Night:
    return Night(np.random.default_rng(seed), **({"vectors": ONE} | options))


def refused(made: Night, folder: Path, dtype: str = "uint16") -> str:
    with pytest.raises(Refused) as refusal:
        calibrate(made.write(folder / "acq", dtype), folder / "run")
    return str(refusal.value)


def calibrated(made: Night, folder: Path, dtype: str = "uint16") -> None:
    calibrate(made.write(folder / "acq", dtype), folder / "run")
    made.check(folder / "run")


@pytest.mark.parametrize("count", [6, 9, 15, 16])
def test_few_frames_have_no_batches_but_a_map(count: int, tmp_path: Path) -> None:
    calibrated(night(count=count), tmp_path)


def test_fringes_under_two_pixels_are_refused(tmp_path: Path) -> None:
    message = refused(night(vectors={"vertical": (4.0, 0.3)}), tmp_path)
    assert "a fringe period of 1.6 px" in message


def test_fringes_along_another_axis_are_refused(tmp_path: Path) -> None:
    made = night()
    scan = made.described["frames"]["fringes"][0]
    scan["baseline_mm"] = scan["baseline_mm"][::-1]
    assert "degrees from the direction of baseline_mm" in refused(made, tmp_path)


@pytest.mark.parametrize("factor", [0.45, 2.0])
def test_nominal_fringes_of_another_width_lead_nowhere_else(factor: float, tmp_path: Path) -> None:
    made = night(shape=(33, 39))
    made.described["optics"]["wavelength_nm"] /= factor
    calibrated(made, tmp_path)


@pytest.mark.parametrize("phases", ["two", "one other"])
def test_two_phases_are_too_few(phases: str, tmp_path: Path) -> None:
    t = np.arange(40)
    turn = np.pi / 2 * (t % 2) if phases == "two" else np.where(t == 3, 2.0, 0.0)
    assert "scanned too little" in refused(night(phases=turn), tmp_path)


def test_three_phases_are_enough(tmp_path: Path) -> None:
    calibrated(night(phases=2 * np.pi / 3 * (np.arange(40) % 3)), tmp_path)


def test_flats_without_light_are_refused(tmp_path: Path) -> None:
    made = night()
    rng = np.random.default_rng(4)
    made.frames["flat"] = made.bias + rng.normal(0, 16, (10, *made.shape))
    made.described["frames"]["flat"] = ["flat.fits"]
    assert "the flats hold no light" in refused(made, tmp_path)


@pytest.mark.parametrize("level", [300.0, 7000.0])
def test_pixels_of_a_wrong_bias_do_no_harm_to_others(level: float, tmp_path: Path) -> None:
    made = night(shape=(31, 37), level=level)
    wrong = np.random.default_rng(2).random(made.shape) < 0.05
    made.frames["bias"][:, wrong] += 3000.0
    made.spoilt = wrong
    calibrated(made, tmp_path, "int32")


@pytest.mark.parametrize("value", [1e38, -1e38])
def test_an_absurd_sample_costs_no_more_than_its_pixel(value: float, tmp_path: Path) -> None:
    made = night()
    made.frames["vertical"][7, 3, 5] = value
    made.frames["bias"][:, 9, 9] = value
    made.spoilt[9, 9] = True
    del made.described["detector"]["saturation_adu"]
    calibrated(made, tmp_path, "float32")


def test_links_in_circles_are_not_followed(tmp_path: Path) -> None:
    (tmp_path / "b").mkdir()
    (tmp_path / "b/x.fits").write_text("x")
    for name in ("c1", "c2", "b/c3"):
        (tmp_path / name).symlink_to(tmp_path)
    found = find_sources(Frames(bias=("**/*.fits",)), tmp_path / "acquisition.yaml")
    assert [source.name for source in found["bias"]] == ["b/x.fits"]


def test_an_effect_that_leaves_the_interpreter_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "own.py"
    file.write_text("raise SystemExit(0)")
    with pytest.raises(InputError, match=r"own\.py: cannot be imported \(SystemExit: 0\)"):
        effect_of_file(file)


def test_a_name_with_a_line_break_is_refused(tmp_path: Path) -> None:
    made = night()
    made.described["detector"]["name"] = "a\nb"
    assert "name: 'a\\nb' must be text" in refused(made, tmp_path)


def test_the_maps_of_a_detector_with_an_umlaut_are_written(tmp_path: Path) -> None:
    made = night()
    made.described["detector"]["name"] = "Kühlkamera 💥"
    calibrated(made, tmp_path)
    header = fits.getheader(tmp_path / "run" / "products" / "delta_fringe.fits")
    assert header["DETECTOR"] == "K?hlkamera ?"


@pytest.mark.parametrize("level", [3e9, -3e18])
def test_a_wild_sample_among_bias_frames_of_whole_numbers_is_an_outlier(
    level: float, tmp_path: Path
) -> None:
    # Codes were counted from the least to the largest: gigabytes, or beyond an integer.
    made = night()
    for frames in made.frames.values():
        frames[:] = np.rint(frames)
    made.frames["bias"][3, 11, 14] = level
    calibrated(made, tmp_path, "float32")


def test_bias_frames_with_an_exposure_time_need_no_darks(tmp_path: Path) -> None:
    # The dark current was then sought in darks that do not exist.
    made = night()
    seconds = np.repeat([0.0, 2.0], 6)
    bias = made.frames["bias"]
    bias += made.rng.poisson(30 * seconds[:, None, None], bias.shape)
    acq = made.write(tmp_path / "acq")
    (acq / "bias.fits").unlink()
    for number, (frame, time) in enumerate(zip(bias, seconds, strict=True)):
        header = fits.Header({"EXPTIME": time})
        fits.writeto(acq / f"b{number}.fits", frame.round().astype(np.uint16), header)
    made.described["frames"]["bias"] = ["b*.fits"]
    (acq / "acquisition.yaml").write_text(yaml.safe_dump(made.described), encoding="utf-8")
    calibrate(acq, tmp_path / "run")
    figure = json.loads((tmp_path / "run/reduce/reduce.json").read_text())["figures_of_merit"]
    assert figure["dark_current"]["unit"] == "e-/s"


def test_a_damaged_list_of_frames_is_named(tmp_path: Path) -> None:
    run = tmp_path / "run"
    calibrate(night().write(tmp_path / "acq"), run)
    (run / "ingest" / "frames.json").write_text("[]")
    with pytest.raises(Refused, match="ingest"):
        pixcal("reduce", run)


@pytest.mark.parametrize("line", [("fit", ""), ("wcs", "run", "--out", "")])
def test_an_empty_path_is_not_the_current_directory(line: tuple[str, ...]) -> None:
    with pytest.raises(Refused, match="empty; give a path"):
        pixcal(*line)
