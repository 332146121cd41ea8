"""Frames whose transfer was cut off are named and left out; dark or saturated rows are not."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr
from astropy.io import fits
from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.stages import reduce
from pixcal.stages.ingest import stage as ingest
from pixcal.stages.reduce.ingested import Ingested

KINDS = ("bias", "dark", "flat", "fringes")
LEVELS = {"bias": 300, "dark": 320, "flat": 9000, "fringes": 8000}
YAML = """\
schema: pixcal/acquisition/1
detector: {pitch_um: 4.4, gain_e_per_adu: 1.0, read_noise_e: 16.0}
optics: {wavelength_nm: 632.8, distance_mm: 400.0, frame_period_s: 0.14}
frames:
  bias: ["bias*"]
  dark: ["dark*"]
  flat: ["flat*"]
  fringes: [{name: one, files: ["fringes*"], baseline_mm: [6.0, 0.0]}]
"""


def frames(shape: tuple[int, int], count: int = 9) -> dict[str, NDArray[np.uint16]]:
    """Of every kind, with noise."""
    rng = np.random.default_rng(1)
    return {
        kind: rng.normal(LEVELS[kind], 12, (count, *shape)).round().astype("u2") for kind in KINDS
    }


def ingested(folder: Path, taken: dict[str, NDArray[Any]], suffix: str = ".fits") -> Any:
    folder.mkdir()
    (folder / "acquisition.yaml").write_text(YAML)
    for kind, cube in taken.items():
        hdu = fits.CompImageHDU(cube) if suffix.endswith("fz") else fits.PrimaryHDU(cube)
        hdu.header["EXPTIME"] = {"bias": 0.0, "dark": 1.0}.get(kind, 0.02)
        hdu.writeto(folder / f"{kind}{suffix}")
    run = folder.parent / f"{folder.name} run"
    return run, ingest.run(folder, run, ingest.Config(), Runtime(cluster="sync", quiet=True))


def cut_from_rows(run: Path) -> dict[str, list[int | None]]:
    tables = json.loads((run / "ingest/frames.json").read_text())
    return {name.partition("/")[0]: table["cut_from_row"] for name, table in tables.items()}


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    ("shape", "value", "suffix"),
    [
        ((7, 5), 0, ".fits"),
        ((33, 47), 65535, ".fits"),
        ((128, 31), 700, ".fits"),
        ((301, 37), 0, ".fits"),
        ((33, 47), 700, ".fits.fz"),
        ((301, 37), 0, ".fits.fz"),
    ],
)
def test_cut_frames_are_as_if_never_recorded(
    tmp_path: Path, shape: tuple[int, int], value: int, suffix: str
) -> None:
    """Whatever the kind, the rows, the value that fills them, and where in its row the cut is."""
    taken = frames(shape)
    rng = np.random.default_rng(shape)
    expected: dict[str, list[int | None]] = {kind: [None] * 9 for kind in KINDS}
    for kind, cube in taken.items():
        if kind == "flat" and value == 65535:
            continue  # as the saturated flats of a ladder
        for n, row in zip(rng.choice(9, 3, replace=False), (0, shape[0] // 2, shape[0] - 1)):  # noqa: B905
            start = row * shape[1] - (int(rng.integers(shape[1])) if row else 0)
            cube[n].reshape(-1)[start:] = value
            expected[kind][n] = row
    run, manifest = ingested(tmp_path / "cut", taken, suffix)
    assert cut_from_rows(run) == expected
    named = [w for w in manifest.summary["warnings"] if "incomplete frames are left out" in w]
    assert len(named) == sum(any(r is not None for r in rows) for rows in expected.values())
    assert all(f"all samples {value} from row" in sentence for sentence in named)
    source = Ingested(run / "ingest")
    for name, reader in source.arrays.items():
        kind = name.partition("/")[0]
        whole = [n for n in range(9) if expected[kind][n] is None]
        assert source.tables[name]["plane"] == whole
        np.testing.assert_array_equal(reader.read(), taken[kind][whole])
        part = reader.read((1, 4), (2, 5), (1, 4))
        np.testing.assert_array_equal(part, taken[kind][whole][1:4, 2:5, 1:4])


def test_maps_are_those_without_the_cut_frames(tmp_path: Path) -> None:
    taken = frames((41, 53))
    less = {kind: np.delete(cube, 4, axis=0) for kind, cube in taken.items()}
    for cube in taken.values():
        cube[4, 20:] = 0
    maps = []
    for name, cubes in (("cut", taken), ("less", less)):
        run, _ = ingested(tmp_path / name, cubes)
        reduce.run(run, reduce.Config(), Runtime(cluster="sync", quiet=True))
        found = zarr.open_group(run / "reduce/calibration.zarr", mode="r")
        maps.append({key: array[...] for key, array in found.arrays()})
    cut, whole = maps
    assert cut.keys() >= {"bias", "flat", "read_noise"}
    for key, values in cut.items():
        np.testing.assert_array_equal(values, whole[key])


def dark_rows(taken: dict[str, NDArray[Any]]) -> None:
    """No light reaches the last rows, which have read noise."""
    rng = np.random.default_rng(2)
    for cube in taken.values():
        cube[:, 25:] = rng.normal(300, 2, cube[:, 25:].shape).round()


def filled_rows(taken: dict[str, NDArray[Any]]) -> None:
    """The camera fills the last rows with zeros, in every frame."""
    for cube in taken.values():
        cube[:, 25:] = 0


def cut_noise(taken: dict[str, NDArray[Any]]) -> None:
    """Noise is cut off at code zero, and above it in one sample of a hundred."""
    rng = np.random.default_rng(3)
    taken["bias"][...] = rng.random(taken["bias"].shape) < 0.01
    assert (taken["bias"][:, -1] == 0).all(axis=1).any()


def saturated_flats(taken: dict[str, NDArray[Any]]) -> None:
    """The longest exposures of a ladder fill the converter."""
    taken["flat"][6:] = 4095
    taken["flat"][:6] //= 10


def full_wells(taken: dict[str, NDArray[Any]]) -> None:
    """Full wells are read as one of two codes; the last row happens to hold one of them."""
    taken["flat"][6:] = 3277 + (np.random.default_rng(4).random(taken["flat"][6:].shape) < 0.02)
    taken["flat"][7, -1] = 3277
    taken["flat"][:6] //= 10
    taken["flat"][:, 3, 4] = 3278  # hot


def bright_crests(taken: dict[str, NDArray[Any]]) -> None:
    """Crests saturate, in some frames on the last rows."""
    cube = np.minimum(taken["fringes"], 4090)
    cube[:4, -4:], cube[4:, 10:15] = 4095, 4095
    taken["fringes"][...] = cube


@pytest.mark.parametrize(
    "spoil", [dark_rows, filled_rows, cut_noise, saturated_flats, full_wells, bright_crests]
)
def test_ordinary_frames_are_not_taken_for_cut_ones(tmp_path: Path, spoil: Any) -> None:
    taken = frames((33, 47))
    spoil(taken)
    run, manifest = ingested(tmp_path / "acq", taken)
    assert cut_from_rows(run) == {kind: [None] * 9 for kind in KINDS}
    assert not any("left out" in sentence for sentence in manifest.summary["warnings"])
