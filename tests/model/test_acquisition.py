"""``acquisition.yaml``: the interface's own example is read, and every slip in it is named."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from pixcal.model.acquisition import SCHEMA, Acquisition, FringeScan, load_acquisition
from pixcal.model.config import parse, to_plain
from pixcal.model.errors import InputError

EXAMPLE = """
schema: pixcal/acquisition/1
detector:
  name: GIGAPYX-4600            # optional
  pitch_um: 4.4
  gain_e_per_adu: 1.0
  read_noise_e: 16.0
  full_well_e: 50000            # optional
  saturation_adu: 65535         # optional
optics:
  wavelength_nm: 632.8
  distance_mm: 400.0            # nominal fibre-to-detector distance
  frame_period_s: 0.14          # optional; time stamps in the headers win
frames:                         # globs relative to this file
  bias: ["bias/*.fits"]
  dark: []                      # optional
  flat: ["flat/*.fits"]         # optional
  fringes:
    - {name: vertical,   files: ["vertical/*.fits"],   baseline_mm: [6.0, 0.0]}
    - {name: horizontal, files: ["horizontal/*.fits"], baseline_mm: [0.0, 6.0]}
"""


def example() -> Any:
    return yaml.safe_load(EXAMPLE)


def test_the_example_of_the_interface_is_read(tmp_path: Path) -> None:
    (tmp_path / "acquisition.yaml").write_text(EXAMPLE)
    found = load_acquisition(tmp_path)
    assert found == load_acquisition(tmp_path / "acquisition.yaml")
    assert found.schema == SCHEMA
    assert found.detector.full_well_e == 50000.0
    assert found.frames.bias == ("bias/*.fits",)
    assert found.frames.dark == ()
    assert found.frames.fringes[1] == FringeScan("horizontal", ("horizontal/*.fits",), (0.0, 6.0))
    assert parse(Acquisition, to_plain(found), "f") == found


def test_optional_keys_may_be_absent() -> None:
    data = example()
    for section, keys in {
        "detector": ["name", "full_well_e", "saturation_adu"],
        "optics": ["frame_period_s"],
        "frames": ["dark", "flat", "fringes"],
    }.items():
        for key in keys:
            del data[section][key]
    found = parse(Acquisition, data, "f")
    assert found.detector.full_well_e is None
    assert found.frames.fringes == ()


def test_a_detector_needs_no_optics(tmp_path: Path) -> None:
    data = example()
    del data["optics"], data["frames"]["fringes"]
    found = parse(Acquisition, data, "f")
    assert found.optics is None
    assert parse(Acquisition, to_plain(found), "f") == found


MISTAKES: list[tuple[list[Any], Any, list[str]]] = [
    (["schema"], "pixcal/acquisition/9", ["schema", "pixcal/acquisition/9", SCHEMA]),
    (["detector", "pitch_um"], 0, ["detector.pitch_um", "below 0.01 um"]),
    (["detector", "pitch_um"], "4.4 um", ["detector.pitch_um", "um"]),
    (["detector", "pitch_mm"], 1, ["detector", "pitch_mm", "mean 'pitch_um'?"]),
    (["detector", "read_noise_e"], -1, ["detector.read_noise_e", "below 0 e-"]),
    (["detector", "saturation_adu"], 0, ["detector.saturation_adu"]),
    (["optics", "wavelength_nm"], [632.8], ["optics.wavelength_nm", "list"]),
    (["optics", "frame_period_s"], 0.0, ["optics.frame_period_s"]),
    (["frames", "bias"], "bias/*.fits", ["frames.bias", "list"]),
    (["frames", "bias"], [""], ["frames", "bias[0]", "glob"]),
    (["frames", "flat"], ["a.fits", "/flat/*.fits"], ["frames", "flat[1]", "relative"]),
    (["frames", "dark"], ["a\0b"], ["frames", "dark[0]"]),
    (["frames", "fringes", 0, "name"], "a/b", ["frames.fringes[0]", "name", "a/b"]),
    (["frames", "fringes", 0, "name"], "", ["frames.fringes[0]", "name"]),
    (["frames", "fringes", 0, "name"], "..", ["frames.fringes[0]", "name"]),
    (["frames", "fringes", 0, "name"], "horizontal", ["frames.fringes", "'horizontal'", "two"]),
    (["frames", "fringes", 1, "files"], [], ["frames.fringes[1]", "files", "empty"]),
    (["frames", "fringes", 1, "files"], ["/x"], ["frames.fringes[1]", "files[0]", "relative"]),
    (["frames", "fringes", 1, "baseline_mm"], [0, 0], ["frames.fringes[1]", "baseline_mm"]),
    (["frames", "fringes", 1, "baseline_mm"], [6], ["frames.fringes[1].baseline_mm", "2 values"]),
    (["frames", "fringes", 1, "baseline_mm"], 6.0, ["baseline_mm", "such as [a, b], in mm"]),
    (["frames", "fringes", 1, "baseline_mm"], [0, 6e3], ["fringes[1].baseline_mm", "0.0096 px"]),
    (["optics", "distance_mm"], 0.4, ["frames.fringes[0].baseline_mm", "units"]),
    (["frames"], {}, ["frames", "no files"]),
]


@pytest.mark.parametrize(("path", "value", "names"), MISTAKES)
def test_a_slip_is_named(path: list[Any], value: Any, names: list[str]) -> None:
    data = example()
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    with pytest.raises(InputError) as caught:
        parse(Acquisition, data, "acquisition.yaml")
    message = str(caught.value)
    assert message.startswith("acquisition.yaml: ")
    assert "\n" not in message
    for name in names:
        assert name in message


@pytest.mark.parametrize("section", ["schema", "detector", "optics", "frames"])
def test_a_missing_section_is_named(section: str) -> None:
    data = example()
    del data[section]
    with pytest.raises(InputError, match=f"acquisition.yaml: {section}: missing"):
        parse(Acquisition, data, "acquisition.yaml")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    for path in (tmp_path, tmp_path / "nowhere", tmp_path / "other.yaml"):
        with pytest.raises(InputError, match="not found") as caught:
            load_acquisition(path)
        assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["mask", "delta_x", "delta_fringe_sigma"])
def test_a_set_is_not_named_as_a_result(name):
    with pytest.raises(InputError, match=f"'{name}' is reserved for a result"):
        FringeScan(name, ("a.fits",), (6.0, 0.0))
