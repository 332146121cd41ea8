"""``pixcal electrons``: other frames of a detector in electrons, with their errors."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from astropy.nddata import CCDData
from PIL import Image

import pixcal
from pixcal.effects.ipc import Ipc
from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.model.config import to_plain
from pixcal.stages import electrons
from pixcal.stages.reduced_set import ReducedSet
from pixcal.storage.artefact import build
from pixcal.storage.cube import write_array
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import write_json
from pixcal.storage.stage import require
from pixcal_cli.main import invoke

SHAPE = (37, 61)
BAND = 15  # rows at a time, which do not divide evenly
SIGNAL = np.random.default_rng(5).uniform(500, 12_000, SHAPE)
BENT = Nonlinearity(quadratic=-0.1, cubic=0.0, level_e=15_000.0)


def frames(*words: Any) -> int:
    return invoke(["electrons", *(str(word) for word in words)])


@pytest.fixture(scope="module")
def bench(make_bench: Callable[..., Any]) -> Any:
    return make_bench(shape=SHAPE, frames=24)


@pytest.fixture(scope="module")
def run(bench: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("frames")
    bench.write(folder / "acq")
    pixcal.ingest(folder / "acq", folder / "run")
    pixcal.reduce(folder / "run")
    return folder / "run"


def written(folder: Path, bench: Any, act: Callable[[Any], Any] = lambda e: e) -> Path:
    """A stack of sixteen frames of ``SIGNAL``."""
    rng = np.random.default_rng(6)
    charge = act(rng.poisson(SIGNAL * bench.flat, (16, *SHAPE)).astype(np.float32))
    adu = (charge + rng.normal(0, bench.read_noise, charge.shape)) / bench.gain + bench.bias
    path = folder / "sky.fits"
    image = fits.PrimaryHDU(np.rint(adu).astype(np.uint16))
    image.header["EXPTIME"], image.header["OBJECT"] = 0.02, "a field of stars"
    image.writeto(path)
    return path


def stack(folder: Path) -> list[CCDData]:
    return [CCDData.read(path) for path in sorted(folder.glob("*.fits"))]


@pytest.fixture(autouse=True)
def few_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(electrons, "_BAND", BAND)


def test_signal_errors_mask_and_header_of_a_cube(run: Path, bench: Any, tmp_path: Path) -> None:
    sky = written(tmp_path, bench)
    assert frames(run, sky, "--out", tmp_path / "out") == 0
    every = stack(tmp_path / "out")
    data = np.array([c.data for c in every])
    error = np.array([c.uncertainty.array for c in every])
    good = ~every[0].mask
    assert good.mean() > 0.98
    assert (~np.isfinite(data[:, ~good])).all()
    pulls = ((data - data.mean(axis=0)) / error)[:, good] * np.sqrt(16 / 15)
    assert np.std(pulls) == pytest.approx(1.0, abs=0.02)
    # The flat is that of few frames, so single pixels are off by its error.
    assert np.median(data.mean(axis=0)[good] / SIGNAL[good]) == pytest.approx(1.0, abs=0.01)
    assert {c.unit.to_string() for c in every} == {"electron"}
    assert every[0].header["OBJECT"] == "a field of stars"
    assert every[0].header["EFFECTS"] == "none"


def test_fringe_frames_come_out_as_in_the_cube(run: Path, tmp_path: Path) -> None:
    folder = next((run / "reduce" / "reduced.zarr").glob("[!.]*/signal")).parent
    source = next((run.parent / "acq").rglob(f"*{folder.name}*.fits"))
    assert frames(run, source, "--out", tmp_path) == 0
    fringes = ReducedSet(folder)
    own = stack(tmp_path)[0]
    step = fringes.coding.scale
    codes = fringes.signal.read((0, 1), (0, SHAPE[0]), (0, SHAPE[1]))
    cube = fringes.coding.electrons(codes[0])
    good = ~own.mask
    np.testing.assert_allclose(own.data[good], cube[good], atol=0.51 * step + 1e-2)


def test_the_response_of_the_diagnosis_is_straightened(
    run: Path, bench: Any, tmp_path: Path
) -> None:
    run = shutil.copytree(run, tmp_path / "run")
    sky = written(tmp_path, bench, BENT.response)
    inputs = {"reduce": require(run, "reduce").key}
    diagnosed = STAGES["diagnose"].format, {"own": [], "nominal": {}}, inputs
    ratios = []
    for causes in ((), (BENT, Ipc())):
        with build(run, "diagnose", *diagnosed) as made:
            found = [{"effect": c.name, "parameters": to_plain(c)} for c in causes]
            write_json(made.folder / "diagnosis.json", {"verdict": "explained", "causes": found})
        assert frames(run, sky, "--out", tmp_path / "out", "--overwrite") == 0
        every = stack(tmp_path / "out")
        mean, good = np.mean([c.data for c in every], axis=0), ~every[0].mask
        bright, faint = (good & (SIGNAL > 9_000)), (good & (SIGNAL < 3_000))
        ratios.append(
            mean[bright].sum() / SIGNAL[bright].sum() / (mean[faint].sum() / SIGNAL[faint].sum())
        )
    assert every[0].header["EFFECTS"] == "nonlinearity"
    with fits.open(sky) as opened:
        same = pixcal.to_electrons(run, opened[0].data[0], exptime_s=0.02)
    np.testing.assert_array_equal(same.data, every[0].data)
    assert ratios[0] < 0.96
    assert ratios[1] == pytest.approx(1.0, abs=0.005)


def test_what_cannot_be_used_is_named_and_nothing_is_written(
    run: Path, bench: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sky, out = written(tmp_path, bench), tmp_path / "out"
    other = tmp_path / "other.fits"
    fits.PrimaryHDU(np.zeros((5, 7), np.uint16)).writeto(other)
    assert frames(run, sky, other, "--out", out) == 2
    assert "7 x 5 px where the detector of" in capsys.readouterr().err
    (tmp_path / "again").mkdir()
    assert frames(run, sky, written(tmp_path / "again", bench), "--out", out) == 2
    assert "that of another file" in capsys.readouterr().err
    assert frames(run, tmp_path / "none.fits", "--out", out) == 2
    assert "none.fits" in capsys.readouterr().err
    assert not out.exists()
    assert frames(run, sky, "--out", out) == 0
    assert frames(run, sky, "--out", out) == 2
    assert "add --overwrite" in capsys.readouterr().err


def test_raw_frames_are_not_replaced(
    run: Path, bench: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = tmp_path / "sky.fits"
    fits.PrimaryHDU(np.full(SHAPE, 900, np.uint16)).writeto(raw)
    before = raw.read_bytes()
    assert frames(run, raw, "--out", tmp_path, "--overwrite", "--exptime", 1) == 2
    assert "is a raw frame" in capsys.readouterr().err
    assert raw.read_bytes() == before
    assert frames(run, tmp_path, "--out", tmp_path / "out") == 2
    assert frames(run, raw, "--out", raw) == 2
    assert "is a file" in capsys.readouterr().err


@pytest.mark.parametrize(
    "card", ["DATE-OBS= 2026-01-01T00:00:00", "observer= 'x'", "GAIN    = 1.2.3", "COMMENT \x01"]
)
def test_cards_that_fits_does_not_allow_are_mended_or_left_out(
    run: Path, card: str, tmp_path: Path
) -> None:
    raw, image = tmp_path / "sky.fits", fits.PrimaryHDU(np.full(SHAPE, 900, np.uint16))
    image.header["TOSPOIL"] = 1
    image.writeto(raw)
    text = raw.read_bytes()
    at = text.index(b"TOSPOIL")
    raw.write_bytes(text[:at] + card.ljust(80).encode() + text[at + 80 :])
    assert frames(run, raw, "--out", tmp_path / "out") == 0
    assert len(stack(tmp_path / "out")) == 1


def test_a_picture_needs_an_exposure_time_if_there_is_dark_signal(
    run: Path, tmp_path: Path, reseal: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    run = shutil.copytree(run, tmp_path / "run")
    picture = tmp_path / "sky.png"
    Image.fromarray(np.full(SHAPE, 900, np.uint16)).save(picture)
    assert frames(run, picture, "--out", tmp_path / "without") == 0
    dark = np.full(SHAPE, 250.0, np.float32)
    place = run / "reduce" / "calibration.zarr" / "dark_rate"
    shutil.rmtree(place)
    write_array(place, dark, dims=("y", "x"), chunks=(128, 128))
    reseal(run / "reduce")
    assert frames(run, picture, "--out", tmp_path / "with") == 2
    assert "--exptime" in capsys.readouterr().err
    assert frames(run, picture, "--out", tmp_path / "with", "--exptime", 2) == 0
    (without,), (less,) = stack(tmp_path / "without"), stack(tmp_path / "with")
    good = ~without.mask
    assert np.median((without.data - less.data)[good]) == pytest.approx(500, rel=0.01)
