"""The page of the products tells all that there is in them."""

import json
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
from astropy.io import fits

import pixcal
from pixcal.model.flags import PixelFlag

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "reference" / "products.md").read_text(encoding="utf-8")
STRUCTURE = {
    "SIMPLE",
    "BITPIX",
    "NAXIS",
    "NAXIS1",
    "NAXIS2",
    "EXTEND",
    "XTENSION",
    "PCOUNT",
    "GCOUNT",
    "EXTNAME",
}


@pytest.fixture(scope="module")
def run(make_bench: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> pixcal.Run:
    """A run with a saturated pixel."""
    folder = tmp_path_factory.mktemp("products")
    make_bench(shape=(37, 41), frames=70).write(folder / "acquisition")
    return pixcal.run(
        folder / "acquisition", folder / "run", diagnosed=False, runtime=pixcal.Runtime("sync")
    )


def section(title: str) -> str:
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def test_every_file_is_told(run: pixcal.Run) -> None:
    for file in (run.path / "products").iterdir():
        assert file.name in PAGE


@pytest.mark.parametrize("name", ["fit", "allan"])
def test_every_key_is_told(run: pixcal.Run, name: str) -> None:
    found = json.loads((run.path / "products" / f"{name}.json").read_text(encoding="utf-8"))
    told = section(f"{name}.json")
    assert f"`{found['schema']}`" in told
    for key in (set(found) - {"schema"}) | set(found["sets"]["vertical"]):
        assert f"`{key}`" in told, key


def test_every_keyword_and_image_is_told(run: pixcal.Run) -> None:
    with fits.open(run.path / "products" / "delta_x.fits") as hdus:
        keywords = {key for key in hdus[0].header if key not in STRUCTURE}
        assert [hdu.name for hdu in hdus[1:]] == ["SIGMA", "MASK"]
    numbered = {key.replace("2", "1") if "2" in key else key for key in keywords}
    for key in numbered:
        known = key if not key.startswith("M1_") else "M1_1"
        assert f"`{known}`" in PAGE, key


def test_every_flag_is_told() -> None:
    for flag in PixelFlag:
        assert f"| {flag.value} | {str(flag.name).lower()} |" in PAGE


def test_xarray_opens_the_fit(run: pixcal.Run) -> None:
    maps = xarray.open_zarr(run.path / "fit" / "fit.zarr", consolidated=False)
    for name in ("delta_x", "delta_y"):
        np.testing.assert_array_equal(maps[name], run.maps[name].delta)
    for name, fringes in run.sets.items():
        found = xarray.open_zarr(run.path / "fit" / "fit.zarr" / name, consolidated=False)
        np.testing.assert_array_equal(found.iota, fringes.iota)
        assert found.batch_delta.dims == ("batch", "y", "x")


def test_verifiers_find_nothing(run: pixcal.Run) -> None:
    """astropy's, and that of CFITSIO where it is installed."""
    for file in (run.path / "products").glob("*.fits"):
        with fits.open(file, checksum=True) as hdus:
            hdus.verify("exception")
        if shutil.which("fitsverify"):
            told = subprocess.run(
                ["fitsverify", "-q", file], capture_output=True, text=True, check=False
            )
            assert "verification OK" in told.stdout, told.stdout
