"""``pixcal centroids`` and ``pixcal wcs`` on the maps of a run."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

import pixcal
from pixcal.estimators.star_centroids import gaussian_star
from pixcal_cli.main import invoke

SHAPE = (50, 60)


@pytest.fixture(scope="module")
def run(make_bench: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> pixcal.Run:
    folder = tmp_path_factory.mktemp("centroids")
    make_bench(shape=SHAPE, frames=70).write(folder / "acq")
    return pixcal.run(folder / "acq", folder / "run", diagnosed=False)


def command(*words: Any) -> int:
    return invoke([str(word) for word in words])


def stars(count: int = 30) -> np.ndarray[Any, Any]:
    return np.random.default_rng(2).uniform(10, 40, (count, 2))


@pytest.mark.parametrize(("suffix", "origin"), [("csv", 0), ("ecsv", 1), ("fits", 1), ("vot", 0)])
def test_a_table_is_corrected_as_by_the_function(
    run: pixcal.Run, tmp_path: Path, suffix: str, origin: int
) -> None:
    place = stars()
    table = Table({"id": np.arange(30), "xc": place[:, 0] + origin, "yc": place[:, 1] + origin})
    kind = {"csv": "ascii.csv", "ecsv": "ascii.ecsv", "vot": "votable"}.get(suffix, suffix)
    table.write(tmp_path / f"in.{suffix}", format=kind)
    out = tmp_path / f"out.{suffix}"
    files = (run.path, tmp_path / f"in.{suffix}", "--out", out, "--fwhm", 2.5)
    words = ("centroids", *files, "--x", "xc", "--y", "yc", "--origin", origin)
    assert command(*words) == 0
    found = Table.read(out, format=kind)
    x, y, error_x, error_y = pixcal.correct_centroids(run, *place.T, fwhm_px=2.5)
    np.testing.assert_allclose(found["xc_corrected"] - origin, x, atol=1e-9)
    np.testing.assert_allclose(found["yc_corrected"] - origin, y, atol=1e-9)
    np.testing.assert_allclose(found["xc_map_error"], error_x, rtol=1e-6)
    np.testing.assert_allclose(found["yc_map_error"], error_y, rtol=1e-6)
    np.testing.assert_array_equal(found["id"], np.arange(30))
    assert command(*words) == 2
    assert command(*words, "--overwrite") == 0


def test_true_stars_are_found_better_with_the_maps(run: pixcal.Run, make_bench: Any) -> None:
    """A star rendered on the detector as it is, measured on a perfect grid, then corrected."""
    truth = np.stack([(b := make_bench(shape=SHAPE, frames=70)).delta_x, b.delta_y])
    # What no fringes can tell is neither in the maps nor counted.
    truth = np.stack(
        [b.without_modes(d, n) for d, n in zip(truth, ("vertical", "horizontal"), strict=True)]
    )
    star, place = gaussian_star(2.5, None, 0.0), stars(200)
    middle, side = np.rint(place).astype(int), np.arange(-star.half, star.half + 1)
    window = np.stack([truth[:, y + side[:, None], x + side[None, :]] for x, y in middle])
    data = star.expected(place - middle, window)
    seen = middle + star.fit(data, 0 * window, np.ones_like(data, bool))[:, :2]
    x, y, error_x, error_y = pixcal.correct_centroids(run, *seen.T, fwhm_px=2.5)
    after = np.stack([x, y], axis=1) - place
    assert np.nanstd(after) < 0.5 * np.nanstd(seen - place)
    pull = after / np.stack([error_x, error_y], axis=1)
    assert 0.85 < np.nanstd(pull) < 1.2


def test_the_wcs_adds_the_map(run: pixcal.Run, tmp_path: Path) -> None:
    out = tmp_path / "d.fits"
    assert command("wcs", run.path, "--out", out) == 0
    with fits.open(out) as hdus:
        wcs = WCS(hdus[0].header, hdus)
    y, x = np.indices(SHAPE).astype(float)
    corrected = wcs.det2im(x.ravel(), y.ravel(), 0)
    for name, moved, at in zip(("delta_x", "delta_y"), corrected, (x, y), strict=True):
        expected = np.nan_to_num(run.maps[name].delta)
        np.testing.assert_allclose((moved - at.ravel()).reshape(SHAPE), expected, atol=1e-6)
    # Between pixels linearly; FITS counts from 1.
    between = wcs.det2im(11.5, 8.0, 1)[0] - 11.5
    assert between == pytest.approx(run.delta_x.delta[7, 10:12].mean(), abs=1e-6)
    # The linear transformation follows it.
    assert wcs.all_pix2world(10.0, 7.0, 0)[0] - 11 == pytest.approx(
        run.delta_x.delta[7, 10], abs=1e-6
    )


def test_the_wcs_of_stars_is_what_centroids_are_corrected_by(run: pixcal.Run) -> None:
    wcs = pixcal.distortion_wcs(run, fwhm_px=2.5)
    place = np.random.default_rng(5).integers(15, 35, (20, 2)).astype(float)
    x, y, *_ = pixcal.correct_centroids(run, *place.T, fwhm_px=2.5)
    np.testing.assert_allclose(wcs.det2im(*place.T, 0), [x, y], atol=1e-6)


def test_maps_are_ccddata(run: pixcal.Run) -> None:
    data = run.delta_x.ccddata()
    assert str(data.unit) == "pix"
    np.testing.assert_array_equal(data.data, run.delta_x.delta)
    np.testing.assert_array_equal(data.uncertainty.array, run.delta_x.sigma)
    np.testing.assert_array_equal(data.mask, run.delta_x.mask != 0)
    assert data.meta["PIXSIZE1"] == 4.4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"table": "nowhere.csv"}, "nowhere.csv: cannot be read as a table (no such file)"),
        ({"--x": "xx"}, "--x: "),
        ({"--fwhm": "0.1"}, "'--fwhm': 0.1 is not in the range 0.5<=x<=50"),
        ({"--electrons": "-1"}, "'--electrons': -1.0 is not in the range x>0"),
        ({"--x": "name"}, "--x: column 'name'"),
        ({"--out": "out.doc"}, "must be one of .csv"),
    ],
)
def test_mistakes_are_named(
    run: pixcal.Run,
    tmp_path: Path,
    changes: dict[str, str],
    words: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "in.csv").write_text("name,x,y\na,10,11\n")
    options = {"--out": "out.csv", "--fwhm": "2"} | changes
    table = tmp_path / options.pop("table", "in.csv")
    options["--out"] = str(tmp_path / options["--out"])
    given = [word for pair in options.items() for word in pair]
    assert command("centroids", run.path, table, *given) == 2
    said = capsys.readouterr().err
    assert words in said
    assert said.count("\n") == 1
