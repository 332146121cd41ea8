"""TIFF and PNG stacks: the same frames as from FITS, with what headers.csv says of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits
from numpy.typing import NDArray
from PIL import ExifTags, Image, TiffImagePlugin

from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError
from pixcal.stages import ingest, reduce
from pixcal.storage.cube_reader import ArrayReader

RUNTIME = Runtime("sync", quiet=True)


def stack(dtype: str, count: int = 3) -> NDArray[Any]:
    rng = np.random.default_rng(4)
    top = {"u1": 255, "u2": 65535, "i4": 2**31 - 1, "f4": 1}[dtype]
    return (rng.random((count, 11, 17)) * top).astype(dtype)


def write_tiff(path: Path, frames: NDArray[Any], **options: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    first, *others = (Image.fromarray(frame) for frame in frames)
    first.save(path, save_all=True, append_images=others, **options)


def acquisition(folder: Path, **frames: list[str]) -> Path:
    folder.mkdir(exist_ok=True)
    detector = {"pitch_um": 5.0, "gain_e_per_adu": 2.0, "read_noise_e": 5.0}
    listed = {"schema": "pixcal/acquisition/1", "detector": detector, "frames": frames}
    (folder / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    return folder


def ingested(folder: Path, run: Path, **frames: list[str]) -> tuple[Any, dict[str, Any]]:
    """The bias frames and the tables of an ingest."""
    ingest.run(acquisition(folder, **frames), run, ingest.Config(overwrite=True), RUNTIME)
    tables = json.loads((run / "ingest" / "frames.json").read_text())
    return ArrayReader(run / "ingest" / "raw.zarr" / "bias").read(), tables


@pytest.mark.parametrize("dtype", ["u1", "u2", "i4", "f4"])
@pytest.mark.parametrize("compression", [None, "tiff_lzw", "tiff_adobe_deflate"])
def test_pages_of_a_tiff_are_frames(tmp_path: Path, dtype: str, compression: str | None) -> None:
    frames = stack(dtype)
    write_tiff(tmp_path / "acq" / "b.tif", frames, compression=compression)
    found, tables = ingested(tmp_path / "acq", tmp_path / "run", bias=["b.tif"])
    assert found.dtype == frames.dtype
    np.testing.assert_array_equal(found, frames)
    assert tables["bias"]["plane"] == [0, 1, 2]
    assert tables["bias"]["exptime_s"] == [None] * 3


@pytest.mark.parametrize("dtype", ["u1", "u2"])
def test_png_files_are_frames_in_the_order_of_their_numbers(tmp_path: Path, dtype: str) -> None:
    frames = stack(dtype, count=11)
    (tmp_path / "acq").mkdir()
    for n, frame in enumerate(frames):
        Image.fromarray(frame).save(tmp_path / "acq" / f"b{n}.png")
    found, _ = ingested(tmp_path / "acq", tmp_path / "run", bias=["*.png"])
    np.testing.assert_array_equal(found, frames)


def test_a_big_endian_tiff_is_read(tmp_path: Path) -> None:
    frames = stack("u2", count=1)
    picture = Image.frombytes("I;16B", (17, 11), frames.astype(">u2").tobytes())
    (tmp_path / "acq").mkdir()
    picture.save(tmp_path / "acq" / "b.tif")
    found, _ = ingested(tmp_path / "acq", tmp_path / "run", bias=["b.tif"])
    np.testing.assert_array_equal(found, frames)


def test_the_exif_exposure_time_is_used_unless_the_table_has_one(tmp_path: Path) -> None:
    exif = {ExifTags.Base.ExposureTime: TiffImagePlugin.IFDRational(1, 250)}
    for name in "bc":
        write_tiff(tmp_path / "acq" / f"{name}.tif", stack("u2", 1), tiffinfo=exif)
    (tmp_path / "acq" / "headers.csv").write_text("file,EXPTIME,CCD-TEMP\nc.tif,0.5,-20\n")
    _, tables = ingested(tmp_path / "acq", tmp_path / "run", bias=["*.tif"])
    assert tables["bias"]["exptime_s"] == [0.004, 0.5]
    assert tables["bias"]["temperature_c"] == [None, -20.0]


def test_a_camera_in_tiff_is_reduced_as_the_same_in_fits(tmp_path: Path) -> None:
    """Headers in a table stand for those of FITS files, ladder of exposure times included."""
    rng = np.random.default_rng(2)
    lines = ["file, EXPTIME, DATE-OBS"]
    for n, (kind, seconds) in enumerate(
        [("bias", 0.0), ("dark", 20.0), *(("flat", t) for t in (0.01, 0.02, 0.04))]
    ):
        level = {"bias": 0, "dark": 100}.get(kind, 2e5 * seconds)
        frames = np.rint(rng.poisson(level, (6, 64, 70)) / 2 + rng.normal(90, 3, (6, 64, 70)))
        date = f"2026-01-01T00:00:{n:02}"
        header = fits.Header({"EXPTIME": seconds, "DATE-OBS": date})
        (tmp_path / "fits").mkdir(exist_ok=True)
        fits.writeto(tmp_path / "fits" / f"{kind}{n}.fits", frames.astype(np.uint16), header)
        write_tiff(tmp_path / "tiff" / f"{kind}{n}.tif", frames.astype(np.uint16))
        lines.append(f"{kind}{n}.*, {seconds}, {date}")
    (tmp_path / "tiff" / "headers.csv").write_text("\n".join(lines) + "\n")
    reports = []
    for kind in ("fits", "tiff"):
        run = tmp_path / f"run-{kind}"
        globs = {name: [f"{name}*.{kind[:4]}*"] for name in ("bias", "dark", "flat")}
        globs = {n: [g.replace("tiff", "tif") for g in gs] for n, gs in globs.items()}
        ingest.run(acquisition(tmp_path / kind, **globs), run, ingest.Config(), RUNTIME)
        reduce.run(run, reduce.Config(), RUNTIME)
        reports.append((run / "reduce" / "reduce.json").read_bytes())
    assert reports[0] == reports[1]
    assert len(json.loads(reports[0])["linearity"]["levels"]) == 3


def test_another_table_is_another_ingest(tmp_path: Path) -> None:
    write_tiff(tmp_path / "acq" / "b.tif", stack("u2"))
    table = tmp_path / "acq" / "headers.csv"
    keys = []
    for value in ("1", " 1.0", "2"):
        table.write_text(f"file,EXPTIME\nb.tif,{value}\n")
        folder = acquisition(tmp_path / "acq", bias=["b.tif"])
        config = ingest.Config(overwrite=True)
        keys.append(ingest.run(folder, tmp_path / "run", config, RUNTIME).key)
    assert keys[0] == keys[1] != keys[2]


def refused(tmp_path: Path, headers: str | None = None) -> str:
    folder = acquisition(tmp_path / "acq", bias=["b*"])
    if headers is not None:
        (folder / "headers.csv").write_text(headers)
    with pytest.raises(InputError) as caught:
        ingest.run(folder, tmp_path / "run", ingest.Config(), RUNTIME)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_colour_is_refused(tmp_path: Path) -> None:
    write_tiff(tmp_path / "acq" / "b.tif", np.zeros((1, 5, 6, 3), np.uint8))
    assert "greyscale" in refused(tmp_path)


def test_three_frames_written_as_planes_of_colours_are_refused_with_a_remedy(
    tmp_path: Path,
) -> None:
    frames = np.zeros((1, 5, 6, 3), np.uint8)
    write_tiff(tmp_path / "acq" / "b.tif", frames, tiffinfo={284: 2})
    assert "photometric='minisblack'" in refused(tmp_path)


def test_pages_of_two_sizes_are_refused(tmp_path: Path) -> None:
    first, second = (Image.fromarray(np.zeros((5, n), np.uint16)) for n in (6, 7))
    (tmp_path / "acq").mkdir()
    first.save(tmp_path / "acq" / "b.tif", save_all=True, append_images=[second])
    assert "different sizes" in refused(tmp_path)


@pytest.mark.parametrize("name", ["b.tif", "b.png"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.9])
def test_a_file_cut_short_is_refused_by_name(tmp_path: Path, name: str, share: float) -> None:
    frame = np.random.default_rng(1).integers(0, 65535, (200, 300), np.uint16)
    file = tmp_path / "acq" / name
    file.parent.mkdir()
    Image.fromarray(frame).save(file)
    file.write_bytes(file.read_bytes()[: int(share * file.stat().st_size)])
    assert "b." in refused(tmp_path)


@pytest.mark.parametrize(
    ("headers", "words"),
    [
        ("name,EXPTIME\nb.tif,1\n", "the columns are name, EXPTIME; write file"),
        ("file,EXPTME\nb.tif,1\n", "any of EXPTIME"),
        ("file,EXPTIME\nc.tif,1\n", "line 2: 'c.tif' matches no frame"),
        ("file,EXPTIME\nb.tif,one\n", "line 2: EXPTIME 'one' is not a valid number"),
        ("file,EXPTIME\nb.tif,-1\n", "line 2: EXPTIME '-1' is not a valid number"),
        ("file,EXPTIME\nb.tif,1\nb*,2\n", "line 3: b.tif is matched by two lines"),
        ("", "the columns are missing"),
    ],
)
def test_a_slip_in_the_table_is_named(tmp_path: Path, headers: str, words: str) -> None:
    write_tiff(tmp_path / "acq" / "b.tif", stack("u2"))
    message = refused(tmp_path, headers)
    assert words in message
    assert "headers.csv" in message


def test_fits_files_are_not_for_the_table(tmp_path: Path) -> None:
    (tmp_path / "acq").mkdir()
    fits.writeto(tmp_path / "acq" / "b.fits", stack("u2"))
    assert "headers of their own" in refused(tmp_path, "file,EXPTIME\nb.fits,1\n")
