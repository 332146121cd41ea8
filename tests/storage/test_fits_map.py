"""Maps read block by block: as astropy reads them whole, and never when damaged."""

from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from pixcal.model.errors import DamagedError
from pixcal.storage.manifest import file_digest
from pixcal.storage.products import FitsMap, write_map

SHAPE = (61, 67)


@pytest.fixture
def product(tmp_path: Path) -> Path:
    rng = np.random.default_rng(1)
    data, sigma = rng.normal(size=(2, *SHAPE)).astype(np.float32)
    data[3, 4] = np.nan
    file = tmp_path / "delta_x.fits"
    write_map(file, data, sigma, rng.integers(0, 99, SHAPE).astype(np.uint8), [])
    return file


@pytest.mark.parametrize("extension", [0, "SIGMA", "MASK"])
def test_blocks_are_those_of_the_whole(product: Path, extension: int | str) -> None:
    image = FitsMap.open(product, extension)
    whole = fits.getdata(product, extension)
    assert image.shape == SHAPE
    for y, x in (((0, 61), (0, 67)), ((7, 13), (5, 66)), ((60, 61), (66, 67))):
        block = image.read(y, x)
        np.testing.assert_array_equal(block, whole[slice(*y), slice(*x)])
        assert block.dtype.isnative


def test_a_file_without_checksum_is_read(tmp_path: Path) -> None:
    data = np.arange(12.0).reshape(3, 4)
    fits.writeto(tmp_path / "plain.fits", data)
    np.testing.assert_array_equal(
        FitsMap.open(tmp_path / "plain.fits").read((1, 3), (0, 2)), data[1:3, :2]
    )


def flip(file: Path, at: int) -> None:
    content = bytearray(file.read_bytes())
    content[at] ^= 1
    file.write_bytes(content)


@pytest.mark.filterwarnings("ignore:File may have been truncated")
def test_damage_is_told(product: Path) -> None:
    image = FitsMap.open(product)
    whole = product.read_bytes()
    flip(product, image.data_at + 1000)
    with pytest.raises(DamagedError, match=r"delta_x\.fits.*altered"):
        FitsMap.open(product)
    FitsMap.open(product, "SIGMA")
    product.write_bytes(whole[: image.data_at + image.n_bytes // 2])
    with pytest.raises(DamagedError, match=r"delta_x\.fits"):
        FitsMap.open(product)
    with pytest.raises(DamagedError, match="cut short"):
        image.read((0, 61), (0, 67))
    product.write_bytes(b"no map")
    with pytest.raises(DamagedError, match=r"delta_x\.fits"):
        FitsMap.open(product)


@pytest.mark.parametrize(
    "image",
    [
        fits.PrimaryHDU(np.zeros((2, 3, 4), np.float32)),
        fits.PrimaryHDU(np.zeros((3, 4), np.uint16)),
        fits.PrimaryHDU(np.zeros((3, 4), np.int64)),
        fits.PrimaryHDU(),
    ],
)
def test_other_images_are_refused(tmp_path: Path, image: fits.PrimaryHDU) -> None:
    image.writeto(tmp_path / "other.fits")
    with pytest.raises(DamagedError, match=r"other\.fits"):
        FitsMap.open(tmp_path / "other.fits")


def test_what_is_not_there(tmp_path: Path, product: Path) -> None:
    with pytest.raises(DamagedError, match="nowhere"):
        FitsMap.open(tmp_path / "nowhere.fits")
    with pytest.raises(DamagedError, match="nowhere"):
        file_digest(tmp_path / "nowhere.fits")
    with pytest.raises(DamagedError, match="delta_x"):
        FitsMap.open(product, "WEIGHT")


def test_the_digest_is_of_the_content(product: Path, tmp_path: Path) -> None:
    before = file_digest(product)
    (tmp_path / "copy.fits").write_bytes(product.read_bytes())
    assert file_digest(tmp_path / "copy.fits") == before
    flip(product, 5000)
    assert file_digest(product) != before
