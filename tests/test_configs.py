"""Every bench in configs/ loads and says what it claims; mistakes in a bench are named by key."""

import copy
from pathlib import Path
from typing import Any

import pytest
import yaml

from pixcal.kernels.optics import interfringe, paraxial_vector
from pixcal.kernels.scene import geometry
from pixcal.model.bench import Bench, load_bench
from pixcal.model.errors import InputError
from pixcal.model.yaml_file import read_yaml

CONFIGS = Path(__file__).parents[1] / "configs"
FILES = sorted(CONFIGS.glob("*.yaml"))


def frames_of(bench: Bench) -> int:
    f = bench.frames
    ladders = [step.count for step in (*f.darks, *f.flats)]
    return f.bias + sum(ladders) + sum(s.count for s in f.fringes)


def test_there_are_configurations() -> None:
    assert {"demo.yaml", "paper.yaml", "gigapyx-4600.yaml"} <= {file.name for file in FILES}


@pytest.mark.parametrize("file", FILES, ids=lambda f: f.name)
def test_it_loads_or_is_of_another_kind(file: Path) -> None:
    if read_yaml(file)["schema"] != "pixcal/bench/1":
        pytest.skip("not a bench")
    bench = load_bench(file)
    d = bench.detector
    assert d.pitch_um == 4.4
    assert d.chip_shape == (5456, 8320)
    for number, scan in enumerate(bench.frames.fringes):
        expected = 5.0 if file.stem == "precision" else 9.588
        assert interfringe(paraxial_vector(geometry(bench, number))) == pytest.approx(
            expected, abs=1e-3
        )
        # The brightest fringe stays in the converter's range and in the well, with its noise.
        laser = bench.effects.get("intensity_noise", {}).get("rms", 0.0)
        bright = scan.peak_e * (1 + 3 * laser) * (1 + 3 * d.prnu_rms)
        assert d.full_well_e is not None
        assert bright < d.full_well_e
        assert bright / d.gain_e_per_adu + d.bias_adu < d.top_adu


def test_each_is_the_size_that_its_comment_says() -> None:
    demo, paper, whole = (
        load_bench(CONFIGS / f"{name}.yaml") for name in ("demo", "paper", "gigapyx-4600")
    )
    assert frames_of(demo) * 80 * 96 * 2 < 12e6
    assert paper.detector.shape == (400, 400)
    assert 1000 * 400 * 400 * 2 == 0.32e9
    assert frames_of(whole) == 88
    assert frames_of(whole) * 5456 * 8320 * 2 == pytest.approx(8e9, rel=0.01)


def demo() -> dict[str, Any]:
    data: dict[str, Any] = yaml.safe_load((CONFIGS / "demo.yaml").read_text())
    data["frames"]["flat_rate_e_s"] = 1.3e6
    return data


MISTAKES: list[tuple[str, Any, str]] = [
    ("schema", "pixcal/bench/7", "schema: 'pixcal/bench/7' is not one of pixcal/bench/1"),
    ("sead", 3, "unknown key 'sead'"),
    ("detector.pitch", 4.4, "detector: unknown key 'pitch'"),
    ("detector.pitch_um", "4.4 um", "detector.pitch_um: expected a number"),
    ("detector.pitch_um", -4.4, "detector.pitch_um: -4.4 is below 0.01 um"),
    ("detector.pitch_um", 4400.0, "detector.pitch_um: 4400.0 is above 1000 um"),
    ("detector.gain_e_per_adu", 0, "detector.gain_e_per_adu: 0 is below 1e-06 e-/ADU"),
    ("detector.read_noise_e", -1, "detector.read_noise_e: -1 is below 0 e-"),
    ("detector.shape", [80], "detector.shape: expected 2 values, found 1"),
    ("detector.shape", [80, 0], "detector.shape[1]: 0 is below 1 px"),
    ("detector.shape", [80.5, 96], "detector.shape[0]: expected a whole number, found 80.5"),
    ("detector.shape", [6000, 96], "detector: origin_px: 6000 rows"),
    ("detector.origin_px", [10, 8300], "detector: origin_px: 96 columns from number 8300"),
    ("detector.bits", 24, "detector.bits: 24 is above 16"),
    ("detector.bits", 8, "detector: bias_adu: 500 ADU leaves no room below saturation"),
    ("detector.saturation_adu", 70000, "detector: saturation_adu: 70000 ADU is above the largest"),
    ("detector.hot_fraction", 1.2, "detector.hot_fraction: 1.2 is above 0.5"),
    ("detector.prnu_rms", float("nan"), "detector.prnu_rms: expected a finite number"),
    ("detector.delta_rms_px", 2.0, "detector.delta_rms_px: 2.0 is above 0.5 px"),
    ("optics.wavelength_nm", 0, "optics.wavelength_nm: 0 is below 1 nm"),
    ("optics.distance_mm", None, "optics.distance_mm: expected a number, found nothing"),
    ("optics.visibility", 1.01, "optics.visibility: 1.01 is above 1"),
    ("optics.power_ratio", 0, "optics.power_ratio: 0 is below 0.001"),
    ("optics.offset_mm", 18.0, "optics.offset_mm: expected a list"),
    ("optics.pointing_a_mm", ["x", 0], "optics.pointing_a_mm[0]: expected a number"),
    ("frames.exptime_s", 0, "frames.exptime_s: 0 is below 1e-09 s"),
    ("frames.period_s", 0.01, "frames: period_s: shorter than exptime_s (0.02 s)"),
    ("frames.start", "yesterday", "frames: start: 'yesterday' is not like 2026-01-01T00:00:00"),
    ("frames.start", "2026-01-01T00:00:00+02:00", "frames: start:"),
    ("frames.start", "9999-12-31", "frames: start: '9999-12-31' and"),
    ("detector.name", "a\nb", "detector: name: 'a\\nb' must be text without line breaks"),
    ("frames.per_file", 0, "frames.per_file: 0 is below 1"),
    ("frames.compress", ["diagonal"], "frames: compress: 'diagonal' is not one of bias"),
    ("frames.flat_rate_e_s", None, "frames: flat_rate_e_s: missing (in e-/s)"),
    ("frames.darks", [{"exptime_s": 1, "count": 0}], "frames.darks[0].count: 0 is below 1"),
    (
        "frames.darks",
        [{"exptime_s": 1, "count": 2}, {"exptime_s": 1.0, "count": 3}],
        "frames: darks: two entries have the same exptime_s",
    ),
    ("frames.fringes.0.name", "a b", "frames.fringes[0]: name: 'a b' is not made of"),
    ("frames.fringes.0.name", "flat", "frames.fringes[0]: name: 'flat' is the folder"),
    ("frames.fringes.0.name", "horizontal", "fringes: two sets are named 'horizontal'"),
    ("frames.fringes.1.baseline_mm", [0, 0], "frames.fringes[1]: baseline_mm: both components"),
    ("frames.fringes.1.baseline_mm", [6, 0, 1], "frames.fringes[1].baseline_mm: expected 2"),
    ("frames.fringes.0.peak_e", 0, "frames.fringes[0].peak_e: 0 is below 0.001 e-"),
    ("frames.fringes.0.phase_law", "sine", "frames.fringes[0].phase_law: 'sine' is not one of"),
    ("frames.fringes.0.phase_law", "ramp", "frames.fringes[0]: phase_step_rad: zero"),
    ("frames.fringes.0.count", True, "frames.fringes[0].count: expected a number"),
    ("optics.laser_noise_rms", 0.02, "noise_rms: instead, write effects.intensity_noise.rms"),
    ("optics.fringes", "exact", "optics.fringes: instead, write effects.hyperbolic_fringes"),
    ("frames.fringes.0.vector_jitter_rad", 0.1, "rad: instead, write effects.fringe_jitter"),
    ("frames.fringes.0.visibility_jitter_rms", 0.1, "rms: instead, write effects.contrast_noise"),
    ("frames.fringes.0.ghost", 0.005, "frames.fringes[0]: unknown key 'ghost'"),
]


@pytest.mark.parametrize(("place", "value", "message"), MISTAKES)
def test_a_mistake_is_named(place: str, value: Any, message: str, tmp_path: Path) -> None:
    data = copy.deepcopy(demo())
    *path, key = place.split(".")
    section: Any = data
    for step in path:
        section = section[int(step)] if isinstance(section, list) else section[step]
    section[key] = value
    file = tmp_path / "bench.yaml"
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError) as caught:
        load_bench(file)
    assert message in str(caught.value)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("key", ["detector", "optics.beam_radius_mm", "frames.fringes.0.count"])
def test_what_is_missing_is_named(key: str, tmp_path: Path) -> None:
    data = demo()
    *path, last = key.split(".")
    section: Any = data
    for step in path:
        section = section[int(step)] if isinstance(section, list) else section[step]
    del section[last]
    file = tmp_path / "bench.yaml"
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match=f"{last}: missing"):
        load_bench(file)


def test_a_bench_without_frames_is_refused(tmp_path: Path) -> None:
    data = demo()
    data["frames"] = {"exptime_s": 0.02, "period_s": 0.14}
    file = tmp_path / "bench.yaml"
    file.write_text(yaml.safe_dump(data))
    with pytest.raises(InputError, match="no frames at all"):
        load_bench(file)


def test_a_bench_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.yaml: not found"):
        load_bench(tmp_path / "nowhere.yaml")
    with pytest.raises(InputError, match="not found"):
        load_bench(tmp_path)


def test_an_acquisition_is_not_a_bench() -> None:
    sample = CONFIGS.parent / "data_samples/demo/acquisition.yaml"
    with pytest.raises(InputError, match="schema: 'pixcal/acquisition/1' is not one of"):
        load_bench(sample)
