"""Every type and container of the interface comes back to the exact values; bad files are named."""

import gzip
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

from pixcal.model.errors import InputError
from pixcal.storage.fits_in import inspect
from pixcal.storage.frame_decoding import BAND, by_fact, read_rows, unpack
from pixcal.storage.frame_file import FrameFile
from pixcal.storage.sources import SourceFile

EXTREMES = {
    "uint8": (0, 255),
    "int8": (-128, 127),
    "int16": (-32768, 32767),
    "uint16": (0, 65535),
    "int32": (-(2**31), 2**31 - 1),
    "uint32": (0, 2**32 - 1),
}
SHAPES = [(7, 5), (67, 131), (3, 67, 131), (1, 7, 5)]


def samples(dtype: str, shape: tuple[int, ...]) -> NDArray[np.generic]:
    """Random values of a type, its extremes (NaN and infinities too) among them."""
    rng = np.random.default_rng(5)
    if dtype == "float32":
        data = rng.normal(1000, 300, shape).astype("f4")
        data.flat[:4] = (np.nan, np.inf, -np.inf, -0.0)
        return data
    low, high = EXTREMES[dtype]
    data = rng.integers(low, high, shape, dtype, endpoint=True)
    data.flat[:2] = (low, high)
    return data


def save(path: Path, data: NDArray[np.generic], container: str, **options: object) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    if container == "tiles":
        if data.dtype.kind == "f":
            options |= {"compression_type": "GZIP_2", "quantize_level": 0}
        fits.CompImageHDU(data, **options).writeto(path)
    elif container == "extension":
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(data)]).writeto(path)
    else:
        fits.PrimaryHDU(data).writeto(path)  # gzipped by astropy where the name ends in .gz
    return path


def source(path: Path) -> SourceFile:
    facts = path.stat()
    return SourceFile(path, path.name, facts.st_size, facts.st_mtime_ns)


def load(file: FrameFile, scratch: Path, band: int = 13) -> NDArray[np.generic]:
    """All samples, in bands of rows that do not divide the frame."""
    if file.container != "plain":
        file = unpack(file, scratch)
    planes, ny, _ = file.shape
    out = np.zeros(file.shape, file.coding.dtype)
    for y0 in range(0, ny, band):
        y1 = min(y0 + band, ny)
        part = np.zeros((planes, y1 - y0, file.shape[2]), out.dtype)
        read_rows(file, range(planes), (y0, y1), part)
        out[:, y0:y1] = part
    return out


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("name", ["plain.fits", "gzip.fits.gz", "tiles.fits.fz", "extension.fits"])
@pytest.mark.parametrize("dtype", [*EXTREMES, "float32"])
def test_round_trip(tmp_path: Path, dtype: str, name: str, shape: tuple[int, ...]) -> None:
    data = samples(dtype, shape)
    file = inspect(source(save(tmp_path / "é t" / name, data, name.split(".")[0])))
    assert file.coding.dtype == np.dtype(dtype)
    found = load(file, tmp_path / "scratch")
    assert found.tobytes() == data.reshape(file.shape).tobytes()


@pytest.mark.parametrize("scale", [None, (0.5, 7)], ids=["exact", "scaled"])
@pytest.mark.parametrize("dtype", [*EXTREMES, "float32"])
def test_facts_of_bands_are_those_of_their_values(
    tmp_path: Path, dtype: str, scale: tuple[float, float] | None
) -> None:
    data = samples(dtype, (2, 2 * BAND + 9, 1500))
    data[1, -4:] = data[1, 0, 0]
    path = save(tmp_path / "a.fits", data, "plain")
    if scale is not None:
        for key, number in zip(("BSCALE", "BZERO"), scale, strict=True):
            fits.setval(path, key, value=number)
    file = inspect(source(path))
    values, (_, ny, _) = load(file, tmp_path), file.shape
    facts = by_fact(read_rows(file, [1, 0], (0, ny)))
    for n, b in np.ndindex(2, 3):
        band = values[1 - n, b * BAND : (b + 1) * BAND]
        bits = band.view(f"u{band.itemsize}")
        same = bits == bits[-1, -1]
        constant = 4 if (n, b) == (0, 2) else 0
        expected = (np.fmax.reduce(band, axis=None), band[-1, -1], same[-1].mean(), constant)
        found = [facts[name][n, b] for name in ("largest", "last", "share", "constant")]
        np.testing.assert_array_equal(found, np.array(expected, float))


@pytest.mark.parametrize("tile", [(1, 9, 131), (2, 20, 50), (3, 67, 131)], ids=str)
@pytest.mark.parametrize("codec", ["RICE_1", "GZIP_1", "GZIP_2", "PLIO_1"])
def test_tiles_of_any_shape(tmp_path: Path, codec: str, tile: tuple[int, ...]) -> None:
    data = samples("uint8", (3, 67, 131)).astype("i2")
    path = save(tmp_path / "a.fits", data, "tiles", compression_type=codec, tile_shape=tile)
    assert load(inspect(source(path)), tmp_path / "scratch").tobytes() == data.tobytes()


def test_quantised_floats_as_astropy_reads_them(tmp_path: Path) -> None:
    data = np.random.default_rng(0).normal(1000, 30, (67, 131)).astype("f4")
    path = tmp_path / "a.fz"
    fits.CompImageHDU(data, compression_type="RICE_1", quantize_level=16).writeto(path)
    np.testing.assert_array_equal(
        load(inspect(source(path)), tmp_path / "scratch")[0], fits.getdata(path, 1)
    )


@pytest.mark.parametrize("zero", [100.0, 32768.0])
def test_scaled_integers_become_float(tmp_path: Path, zero: float) -> None:
    hdu = fits.PrimaryHDU(samples("int16", (67, 131)))
    hdu.header["BSCALE"], hdu.header["BZERO"] = 0.25, zero
    hdu.writeto(tmp_path / "a.fits")
    file = inspect(source(tmp_path / "a.fits"))
    assert file.coding.dtype == np.float32
    expected = fits.getdata(tmp_path / "a.fits")
    np.testing.assert_array_equal(load(file, tmp_path / "s")[0], expected.astype("f4"))


def test_blank_samples_are_missing_not_numbers(tmp_path: Path) -> None:
    data = samples("int16", (7, 5))
    data[3, 2] = -999
    hdu = fits.PrimaryHDU(data)
    hdu.header["BLANK"] = -999
    hdu.writeto(tmp_path / "a.fits")
    found = load(inspect(source(tmp_path / "a.fits")), tmp_path / "s")[0]
    np.testing.assert_array_equal(np.isnan(found), data == -999)
    np.testing.assert_array_equal(found[data != -999], data[data != -999])


def test_axes_of_length_one_are_dropped(tmp_path: Path) -> None:
    data = samples("uint16", (1, 3, 1, 7, 5))
    for name, container in (("a.fits", "plain"), ("b.fz", "tiles")):
        file = inspect(source(save(tmp_path / name, data, container)))
        assert file.shape == (3, 7, 5)
        assert load(file, tmp_path / "s").tobytes() == data.tobytes()


def test_first_image_with_data_is_used(tmp_path: Path) -> None:
    table = fits.BinTableHDU.from_columns([fits.Column("a", "J", array=np.arange(2000))])
    first, second = samples("int16", (7, 5)), samples("uint8", (67, 131))
    hdus = [fits.PrimaryHDU(), table, fits.ImageHDU(first), fits.ImageHDU(second)]
    fits.HDUList(hdus).writeto(tmp_path / "a.fits")
    file = inspect(source(tmp_path / "a.fits"))
    assert file.hdu == 2
    assert load(file, tmp_path / "s").tobytes() == first.tobytes()


def test_wider_type_holds_the_values(tmp_path: Path) -> None:
    data = samples("uint16", (7, 5))
    file = inspect(source(save(tmp_path / "a.fits", data, "plain")))
    out = np.zeros((1, 7, 5), "i4")
    read_rows(file, [0], (0, 7), out)
    np.testing.assert_array_equal(out[0], data)


# Header facts


def with_header(path: Path, **cards: object) -> FrameFile:
    hdu = fits.PrimaryHDU(np.zeros((7, 5), "i2"))
    for key, value in cards.items():
        hdu.header[key.replace("_", "-")] = value
    hdu.writeto(path, overwrite=True)
    return inspect(source(path))


@pytest.mark.parametrize(
    ("cards", "mjd"),
    [
        ({"MJD_OBS": 60310.25}, 60310.25),
        ({"MJD_OBS": 60310.25, "DATE_OBS": "1999-01-01T00:00:00"}, 60310.25),
        ({"DATE_OBS": "2024-01-01T06:00:00"}, 60310.25),
        ({"DATE_OBS": "2024-01-01T06:00:00.125"}, 60310.25 + 0.125 / 86400),
        ({"DATE_OBS": "2024-01-01T06:00:00Z"}, 60310.25),
        ({"DATE_OBS": "2024-01-01", "TIME_OBS": "06:00:00"}, 60310.25),
        ({"DATE_OBS": "2024-01-01"}, None),
        ({"DATE_OBS": "yesterday at Ten"}, None),
        ({"MJD_OBS": "unknown"}, None),
        ({"MJD_OBS": 2e303}, None),
        ({"MJD_OBS": 2460310.75e3, "DATE_OBS": "2024-01-01T06:00:00"}, 60310.25),
        ({}, None),
    ],
)
def test_time_stamp(tmp_path: Path, cards: dict[str, object], mjd: float | None) -> None:
    found = with_header(tmp_path / "a.fits", **cards).mjd
    assert found == (None if mjd is None else pytest.approx(mjd, abs=1e-10))


def test_exposure_and_temperature(tmp_path: Path) -> None:
    path = tmp_path / "a.fits"
    assert with_header(path, EXPTIME=0.5, EXPOSURE=7.0).exptime_s == 0.5
    assert with_header(path, EXPOSURE=7.0).exptime_s == 7.0
    assert with_header(path, EXPTIME=-1.0).exptime_s is None
    for comment, unit in (("[s]", 1.0), ("[ms]", 1e-3), ("exposure, microseconds", 1e-6)):
        assert with_header(path, EXPTIME=(20.0, comment)).exptime_s == 20 * unit
    assert with_header(path, EXPTIME=(20.0, "seconds, to 1 ms")).exptime_s == 20
    for key in ("CCD_TEMP", "DET_TEMP", "TEMPERAT", "CCDTEMP", "TEMP"):
        assert with_header(path, **{key: -10.5}).temperature_c == -10.5
    kelvin = with_header(path, TEMP=(263.15, "[K] detector")).temperature_c
    assert kelvin == pytest.approx(-10)
    assert with_header(path).temperature_c is None


def test_facts_of_the_primary_header_count_for_an_extension(tmp_path: Path) -> None:
    for name, image in (("a.fits", fits.ImageHDU), ("b.fz", fits.CompImageHDU)):
        hdus = fits.HDUList([fits.PrimaryHDU(), image(samples("uint16", (7, 5)))])
        hdus[0].header["MJD-OBS"], hdus[0].header["EXPTIME"] = 60000.5, 2.0
        hdus.writeto(tmp_path / name)
        file = inspect(source(tmp_path / name))
        assert (file.mjd, file.exptime_s) == (60000.5, 2.0)


# Bad files


def refused(path: Path) -> str:
    with pytest.raises(InputError) as caught:
        inspect(source(path))
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    return message


@pytest.mark.parametrize("name", ["a.fits", "a.fz", "a.fits.gz"])
@pytest.mark.parametrize("keep", [0.001, 0.3, 0.9])
def test_cut_file_is_found_before_reading(tmp_path: Path, name: str, keep: float) -> None:
    container = "tiles" if name.endswith("fz") else "plain"
    path = save(tmp_path / name, samples("uint16", (100, 144)), container)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * keep)] or whole[:1])
    message = refused(path)
    assert "cut short" in message or "not a FITS file" in message
    assert "copy it again" in message or "remove it" in message


def test_last_byte_missing(tmp_path: Path) -> None:
    # 2880 × 2 bytes of data: no padding that could be cut without loss.
    path = save(tmp_path / "a.fits", samples("int16", (45, 64)), "plain")
    path.write_bytes(path.read_bytes()[:-1])
    message = refused(path)
    assert "8639 bytes" in message
    assert "8640" in message


@pytest.mark.parametrize(
    ("shape", "words"), [((5,), "1-D"), ((2, 3, 7, 5), "4-D data (5 × 7 × 3 × 2)")]
)
@pytest.mark.parametrize("name", ["a.fits", "a.fz"])
def test_other_dimensions(tmp_path: Path, name: str, shape: tuple[int, ...], words: str) -> None:
    save(tmp_path / name, samples("uint16", shape), "tiles" if name == "a.fz" else "plain")
    assert words in refused(tmp_path / name)


def test_other_types(tmp_path: Path) -> None:
    save(tmp_path / "a.fits", np.zeros((7, 5), "f8"), "plain")
    assert "BITPIX -64" in refused(tmp_path / "a.fits")


def test_what_is_not_a_frame(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("no frames today\n")
    assert "not a FITS file" in refused(tmp_path / "notes.txt")
    (tmp_path / "notes.gz").write_bytes(gzip.compress(b"no frames today\n"))
    assert "not a FITS file" in refused(tmp_path / "notes.gz")
    fits.PrimaryHDU().writeto(tmp_path / "empty.fits")
    assert "holds no image" in refused(tmp_path / "empty.fits")


def test_header_without_end(tmp_path: Path) -> None:
    path = save(tmp_path / "a.fits", samples("int16", (300, 500)), "plain")
    path.write_bytes(path.read_bytes().replace(b"END     ", b"COMMENT ", 1))
    assert "header" in refused(path)


@pytest.mark.parametrize("value", ["X", "-5", "2.5"])
def test_header_with_bad_lengths(tmp_path: Path, value: str) -> None:
    path = save(tmp_path / "a.fits", samples("int16", (7, 5)), "plain")
    whole = path.read_bytes()
    assert b"NAXIS1  = %20d" % 5 in whole
    path.write_bytes(whole.replace(b"NAXIS1  = %20d" % 5, b"NAXIS1  = %20b" % value.encode()))
    assert "NAXIS" in refused(path)


def test_gzip_of_several_members_is_whole(tmp_path: Path) -> None:
    data = samples("uint16", (67, 131))
    raw = save(tmp_path / "a.fits", data, "plain").read_bytes()
    path = tmp_path / "b.fits.gz"
    path.write_bytes(gzip.compress(raw[:9000]) + gzip.compress(raw[9000:]))
    assert load(inspect(source(path)), tmp_path / "s").tobytes() == data.tobytes()
    path.write_bytes(gzip.compress(raw[:9000]) + gzip.compress(raw[9000:15000]))
    assert "15000 bytes once unpacked" in refused(path)


def test_altered_compressed_data_are_refused_when_unpacked(tmp_path: Path) -> None:
    for name, container in (("a.fits.gz", "plain"), ("b.fz", "tiles")):
        path = save(
            tmp_path / name,
            samples("uint16", (67, 131)),
            container,
            **({"compression_type": "GZIP_1"} if container == "tiles" else {}),
        )
        whole = bytearray(path.read_bytes())
        at = len(whole) // 2
        whole[at : at + 64] = bytes(64)
        path.write_bytes(whole)
        with pytest.raises(InputError, match=name):
            load(inspect(source(path)), tmp_path / "s")


def test_file_that_changed_is_refused(tmp_path: Path) -> None:
    path = save(tmp_path / "a.fits", samples("uint16", (7, 5)), "plain")
    file = inspect(source(path))
    path.write_bytes(path.read_bytes() + b"more")
    with pytest.raises(InputError, match=r"a\.fits: changed while"):
        load(file, tmp_path / "s")
    path.unlink()
    with pytest.raises(InputError, match=r"a\.fits: cannot be read"):
        load(file, tmp_path / "s")


UNPACK = """
import re, sys
from pathlib import Path
from pixcal.storage.fits_in import inspect
from pixcal.storage.frame_decoding import unpack, unpack_bytes
from pixcal.storage.sources import SourceFile
def peak():
    # VmHWM, not ru_maxrss, which begins at the peak of the process that started this one.
    return int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024
small, large = (Path(p) for p in sys.argv[1:3])
for path in (small, large):
    facts = path.stat()
    file = inspect(SourceFile(path, path.name, facts.st_size, facts.st_mtime_ns))
    before = peak()
    unpack(file, path.with_suffix(".scratch"))
print(peak() - before, unpack_bytes(file))
"""


@pytest.mark.quick(1)
@pytest.mark.parametrize("codec", ["RICE_1 whole", "gzip", "RICE_1", "HCOMPRESS_1 whole"])
def test_memory_of_unpacking(tmp_path: Path, codec: str) -> None:
    """A file of 48 MB takes no more than planned (small one first: libraries loaded)."""
    rng = np.random.default_rng(0)
    paths = []
    for name, shape in (("small", (2, 64, 64)), ("large", (6, 2000, 2000))):
        data = rng.poisson(100, shape[1:]).astype("u2") * np.ones((shape[0], 1, 1), "u2")
        if codec == "gzip":
            path = tmp_path / f"{name}.fits"
            fits.PrimaryHDU(data).writeto(path)
            path.write_bytes(gzip.compress(path.read_bytes(), 1))
        else:
            path = tmp_path / f"{name}.fz"
            tile = (1, *shape[1:]) if codec.endswith("whole") else None
            hdu = fits.CompImageHDU(data, compression_type=codec.split()[0], tile_shape=tile)
            hdu.writeto(path)
        paths.append(str(path))
    result = subprocess.run(
        [sys.executable, "-c", UNPACK, *paths], capture_output=True, text=True, check=True
    )
    used, planned = map(int, result.stdout.split())
    assert used < planned
