"""What maps bring for stars: known detectors, two ways to the same error, any runtime."""

import shutil
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray
from PIL import Image
from scipy.signal import correlate

from pixcal.engine.run import Runtime
from pixcal.kernels.optics import Geometry, phase
from pixcal.model.acquisition import Detector as Declared
from pixcal.model.errors import InputError, PlanError
from pixcal.report.drawing import png
from pixcal.stages import astrometry
from pixcal.stages.astrometry import Config, stage, stars
from pixcal.stages.astrometry.detector import (
    DegenerateModes,
    PixelPositions,
    free_from_modes,
    open_components,
)
from pixcal.stages.astrometry.stars import (
    KINDS,
    Telescope,
    exposures,
    observe,
    place_errors,
    star,
    tile_side,
)
from pixcal.stages.astrometry.summary import scientific, table, with_error
from pixcal.stages.fitted_shape import fitted_shape
from pixcal.storage.artefact import build
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import read_json, write_json
from pixcal.storage.products import write_map

F64 = NDArray[np.float64]
SYNC = Runtime("sync")
SHAPE = (97, 131)
K = 2 * np.pi / 9.5
PAPER = Telescope(7.0, 130.0, 600.0, 0.0, 4.4)
DECLARED = Declared(4.4, read_noise_e=16.0, gain_e_per_adu=1.0, full_well_e=50_000.0)
PARAXIAL = {"model": "paraxial", "phase_at_origin_rad": 0.0}
STRAIGHT = {
    "vertical": PARAXIAL | {"kx": K, "ky": 0.0, "axis": [1.0, 0.0]},
    "horizontal": PARAXIAL | {"kx": 0.0, "ky": K, "axis": [0.0, 1.0]},
}


def make_run(
    run: Path,
    maps: dict[str, F64],
    sigma: F64 | float,
    masked: Any = (),
    sets: dict[str, Any] = STRAIGHT,
) -> Path:
    """What ingest and fit leave, as far as stars are concerned."""
    shape = next(iter(maps.values())).shape
    description = {
        "schema": "pixcal/acquisition/1",
        "detector": {
            "pitch_um": 4.4,
            "gain_e_per_adu": 1.0,
            "read_noise_e": 16.0,
            "full_well_e": 50_000.0,
        },
        "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
        "frames": {"bias": ["bias.fits"]},
    }
    with build(run, "ingest", 1, {}, {}) as made:
        write_json(made.folder / "acquisition.json", description)
    with build(run, "fit", 1, {}, {}) as made:
        write_json(made.folder / "fit.json", {"outputs": list(maps), "sets": sets})
    mask = np.zeros(shape, np.uint8)
    for y, x in masked:
        mask[y, x] = 4
    for name, values in maps.items():
        data = np.where(mask, np.nan, values).astype(np.float32)
        error = np.where(mask, np.nan, sigma).astype(np.float32)
        write_map(run / "products" / f"{name}.fits", data, error, mask, [])
    return run


def write_truth(folder: Path, maps: dict[str, F64]) -> Path:
    folder.mkdir(exist_ok=True)
    for name, values in maps.items():
        fits.writeto(folder / f"{name}.fits", values.astype(np.float32), overwrite=True)
    return folder


def offsets(seed: int, scatter: float, shape: tuple[int, int] = SHAPE) -> dict[str, F64]:
    rng = np.random.default_rng(seed)
    return {name: rng.normal(0, scatter, shape) for name in ("delta_x", "delta_y")}


def added(a: dict[str, F64], b: dict[str, F64]) -> dict[str, F64]:
    return {name: a[name] + b[name] for name in a}


MASKED = ((40, 60), (41, 60), (70, 20), (12, 100))
SIGMA, SCATTER = 2e-4, 3e-3


@pytest.fixture(scope="module", autouse=True)
def _undrawn() -> Iterator[None]:
    """Pictures take longer than what is tested here; `tests/report` looks at them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "png", lambda figure: b"")
        yield


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run (``run``) with good maps, and its truth (``truth``)."""
    folder = tmp_path_factory.mktemp("astrometry")
    true = offsets(1, SCATTER)
    make_run(folder / "run", added(true, offsets(2, SIGMA)), SIGMA, MASKED)
    write_truth(folder / "truth", true)
    return folder


def result_of(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = read_json(run / "products" / "astrometry.json")
    return found


def the_detector(run: Path, truth: Path | None = None, seed: int = 0) -> PixelPositions:
    fit = read_json(run / "fit" / "fit.json")
    components = open_components(run, fit, truth)
    if truth is not None:
        sets = (fitted_shape(run, s, None, SHAPE) for s in fit["sets"].values())  # type: ignore[arg-type]
        components, _ = free_from_modes(components, DegenerateModes(SHAPE, tuple(sets)), SYNC)
    return PixelPositions(tuple(components), seed)


def the_star(electrons: float = 1e8) -> Any:
    psf, half = PAPER.psf(None)
    return star(psf, half, electrons, 0.0, DECLARED)


@pytest.fixture(scope="module")
def results(case: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Of the maps alone, and with the truth."""
    folder = tmp_path_factory.mktemp("results")
    found = {}
    for name, truth in (("drawn", None), ("true", case / "truth")):
        shutil.copytree(case / "run", folder / name)
        astrometry.run(folder / name, Config(truth=truth, stars=150, positions=7), SYNC)
        found[name] = result_of(folder / name) | {"run": folder / name}
    return found


def test_the_maps_alone_tell_what_the_truth_tells(results: dict[str, dict[str, Any]]) -> None:
    """The gain, with the maps' errors drawn and taken off again, is that against the truth."""
    for axis in ("x", "y"):
        drawn, true = (results[n]["axes"][axis] for n in ("drawn", "true"))
        for key in ("floor", "photons"):
            for grid in ("perfect", "measured"):
                a, b = drawn[key][grid], true[key][grid]
                # One small detector: its pixels, not only its stars, are few.
                assert a["px"] == pytest.approx(b["px"], rel=0.1), (axis, key, grid)
        gain = drawn["floor"]["gain"]
        assert gain["value"] == pytest.approx(SCATTER / SIGMA, rel=0.12)
        assert 0 < gain["err"] < 0.1 * gain["value"]
    assert results["true"]["detector"]["pixels"] == "truth"


def test_white_offsets_average_as_the_weights_say(results: dict[str, dict[str, Any]]) -> None:
    seen = the_star()
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 2))
    norm = np.sqrt(np.mean([np.sum(seen.weights(p)[0] ** 2) for p in places]))
    axis = results["drawn"]["axes"]["x"]
    assert axis["floor"]["measured"]["px"] == pytest.approx(SIGMA * norm, rel=0.06)
    assert axis["floor"]["perfect"]["px"] == pytest.approx(SCATTER * norm, rel=0.1)
    assert axis["everywhere"]["measured_px"] == pytest.approx(SIGMA * norm, rel=0.08)
    assert axis["second_order_px"] < 0.02 * axis["floor"]["perfect"]["px"]


def test_photon_noise_adds_in_square(results: dict[str, dict[str, Any]]) -> None:
    axis = results["drawn"]["axes"]["x"]
    bound = axis["photon_bound"]["px"]
    assert bound == pytest.approx(float(the_star().bound()[0]))
    expected = np.hypot(axis["floor"]["measured"]["px"], bound)
    assert axis["photons"]["measured"]["px"] == pytest.approx(expected, rel=0.08)


def test_units_and_what_they_come_from(results: dict[str, dict[str, Any]]) -> None:
    """The paper's section 2: a pixel sees 7 mas; 5e-5 of it is the 0.3 µas of an Earth."""
    telescope = results["drawn"]["telescope"]
    assert telescope["uas_per_px"] == pytest.approx(4.4e-6 / 130 / np.pi * 180 * 3600e6)
    assert telescope["uas_per_px"] / 1e3 == pytest.approx(7, abs=0.05)
    assert 5e-5 * telescope["uas_per_px"] == pytest.approx(0.35, abs=0.01)
    # 17 mas at 600 nm (lambda / D), so 2.5 pixels.
    assert telescope["px_per_lambda_over_d"] == pytest.approx(600e-9 / 7 * 130 / 4.4e-6)
    entry = results["drawn"]["axes"]["y"]["floor"]["measured"]
    assert entry["uas"] == pytest.approx(entry["px"] * telescope["uas_per_px"])
    assert results["drawn"]["stars"]["exposures"] == exposures(the_star().psf, 1e8, DECLARED) > 200


def test_more_positions_less_error(results: dict[str, dict[str, Any]]) -> None:
    found = results["drawn"]["axes"]["x"]
    assert found["averaging"]["positions"] == [1, 2, 4, 7]
    for grid in ("perfect", "measured"):
        px = np.array(found["averaging"][f"{grid}_px"])
        assert np.all(np.diff(px) < 0)
        np.testing.assert_allclose(px[0] / px[-1], np.sqrt(7), rtol=0.3)
        assert found["averaged"][grid]["px"] == px[-1]
        ratio = found["separation"][grid]["px"] / px[-1]
        assert ratio == pytest.approx(np.sqrt(2), rel=0.3)
    need = found["positions_to_target"]
    assert need["measured"] == np.ceil((found["photons"]["measured"]["px"] / 5e-5) ** 2)
    assert need["perfect"] > 20 * need["measured"]


def test_perfect_maps_leave_photon_noise_alone(tmp_path: Path) -> None:
    true = offsets(3, SCATTER)
    run = make_run(tmp_path / "run", true, SIGMA)
    truth = write_truth(tmp_path / "truth", true)
    astrometry.run(run, Config(truth=truth, stars=40, positions=4), SYNC)
    for axis in result_of(run)["axes"].values():
        assert axis["floor"]["measured"]["px"] < 1e-8
        assert axis["everywhere"]["measured_px"] < 1e-8
        assert axis["photons"]["measured"]["px"] == pytest.approx(
            axis["photon_bound"]["px"], rel=4 / np.sqrt(2 * 160)
        )


@pytest.mark.long
def test_maps_of_noise_are_told_from_maps_that_help(tmp_path: Path) -> None:
    nothing = make_run(tmp_path / "nothing", offsets(4, 1e-3), 1e-3)
    astrometry.run(nothing, Config(stars=60, positions=3), SYNC)
    found = result_of(nothing)
    assert found["axes"]["x"]["floor"]["perfect"]["px"] is None
    assert found["axes"]["x"]["floor"]["gain"]["value"] is None
    assert any("below the errors of the maps" in w for w in found["warnings"])
    assert "not significant" in table(found)[0][2]
    worse = make_run(tmp_path / "worse", added(offsets(4, 1e-3), offsets(5, 2e-3)), 2e-3)
    truth = write_truth(tmp_path / "truth", offsets(4, 1e-3))
    astrometry.run(worse, Config(truth=truth, stars=60, positions=3), SYNC)
    assert any("make centroids worse" in w for w in result_of(worse)["warnings"])


GEOMETRY = Geometry(632.8e-6, 4.4e-3, 18.0, 12.0, 400.0, 6.0, 0.0, 0.0)
HYPERBOLIC = {
    "model": "hyperbolic",
    "kx": 0.1,
    "ky": 0.0,
    "axis": [1.0, 0.0],
    "phase_at_origin_rad": 0.0,
    "geometry": {
        f"{n}_mm": float(v)
        for n, v in zip(
            ("centre_x", "centre_y", "distance", "baseline_x", "baseline_y", "baseline_z"),
            GEOMETRY.vector(),
            strict=True,
        )
    },
}


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize("exact", [False, True])
def test_modes_of_the_bench_are_no_errors_of_the_maps(
    case: Path, tmp_path: Path, exact: bool
) -> None:
    """Planes, curvature and fringes that no fringes can tell are taken off the truth."""
    sets = dict(STRAIGHT) | ({"vertical": HYPERBOLIC} if exact else {})
    true = offsets(1, SCATTER)
    run = make_run(tmp_path / "run", added(true, offsets(2, SIGMA)), SIGMA, MASKED, sets)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]].astype(float)
    psi = phase(x, y, GEOMETRY) if exact else K * x
    moved = replace(GEOMETRY, centre_x=19.0, distance=402.0)
    bent = 0.05 * (phase(x, y, moved) - phase(x, y, GEOMETRY)) if exact else 0 * x
    fringe = 3e-3 * np.cos(psi - 1) + 1e-3 * np.cos(2 * psi)
    other = {"delta_x": 0.02 + 1e-4 * x + bent + fringe, "delta_y": 2e-4 * y + 0 * x}
    found = {}
    for name, values in (("plain", true), ("with", added(true, other))):
        truth = write_truth(tmp_path / name, values)
        astrometry.run(run, Config(truth=truth, stars=30, positions=2), SYNC)
        found[name] = result_of(run)
    for axis in ("x", "y"):
        a, b = (found[n]["axes"][axis]["everywhere"] for n in ("plain", "with"))
        # float32 files; the curvature to first order.
        assert a["measured_px"] == pytest.approx(b["measured_px"], rel=2e-2 if exact else 1e-4)
        assert a["perfect_px"] == pytest.approx(b["perfect_px"], rel=1e-3)
    removed = found["with"]["detector"]["modes_removed_px"]
    assert removed["x"]["fringe"] == pytest.approx(np.hypot(3e-3, 1e-3) / np.sqrt(2), rel=0.05)
    smooth = other["delta_x"] - fringe
    assert removed["x"]["smooth"] == pytest.approx(np.sqrt(np.mean(smooth**2)), rel=0.02)
    assert removed["y"]["fringe"] < 1e-4
    assert found["plain"]["detector"]["modes_removed_px"]["x"]["smooth"] < 1e-4


def test_the_map_of_errors_is_what_fits_give(case: Path) -> None:
    """Stars in the middle of pixels, fitted; masked ones near them included."""
    detector, seen = the_detector(case / "run"), the_star()
    errors = place_errors(detector, seen, (0, SHAPE[0]), (0, SHAPE[1]))
    half, zero = seen.half, np.zeros((1, 2))
    assert np.all(np.isnan(errors[:, :, :half])) and np.all(np.isnan(errors[:, :, :, -half:]))  # noqa: PT018
    free, near = [], []
    for y, x in [(30, 40), (50, 77), (44, 64), (41, 64), (40, 56), (66, 25), (17, 93), (60, 100)]:
        patch = detector.patch((y - half, y + half + 1), (x - half, x + half + 1))
        data = seen.expected(zero, patch.true[None])
        found = np.stack(
            [
                seen.fit(data, grid[None], patch.good[None])[0, :2]
                for grid in (np.zeros_like(patch.true), patch.known)
            ]
        )
        (free if patch.good.all() else near).append((errors[:, :, y, x], found))
    assert len(free) >= 2
    assert len(near) >= 4
    for predicted, found in free:
        assert np.abs(predicted[0] - found[0]).max() < 3e-5
        assert np.abs(predicted[1] - found[1]).max() < 3e-6
    for predicted, found in near:
        assert np.abs(predicted[0] - found[0]).max() < 0.05 * SCATTER
        assert np.abs(predicted[1] - found[1]).max() < 0.05 * SIGMA
    # Where a masked pixel holds much of the position, no star is counted.
    assert np.all(np.isnan(errors[:, :, 41, 58]))


def test_first_order_predicts_every_star(case: Path) -> None:
    config = Config(stars=30, positions=4, dither_px=20.0)
    found = observe(the_detector(case / "run"), the_star(), config, SYNC)
    errors = dict(zip(KINDS, np.moveaxis(found, 2, 0), strict=True))
    good = np.isfinite(errors["perfect"])
    for kind, linear in (("perfect", "linear"), ("measured", "linear_measured")):
        assert np.all(np.isfinite(errors[kind]) == good)
        rest = (errors[kind] - errors[linear])[good]
        assert np.sqrt(np.mean(rest**2)) < 0.02 * np.std(errors[kind][good])


@pytest.mark.parametrize("tile", [24, 40, 1000])
def test_the_map_does_not_depend_on_the_tiles(
    case: Path, tmp_path: Path, tile: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stars, "TILE", tile)
    detector, seen = the_detector(case / "run"), the_star()
    maps = stars.error_maps(tmp_path / "maps", detector, seen, Runtime(workers=3))
    whole = place_errors(detector, seen, (0, SHAPE[0]), (0, SHAPE[1]))
    for n, grid in enumerate(("perfect", "measured")):
        for k, name in enumerate("xy"):
            written = ArrayReader(tmp_path / "maps" / f"{grid}_{name}").read()
            np.testing.assert_allclose(written, whole[n, k], atol=1e-9)
    good = np.isfinite(whole[0, 0])
    assert maps.places.sum() == good.sum()
    np.testing.assert_allclose(maps.mean_square, np.nanmean(whole**2, axis=(2, 3)), rtol=1e-9)
    side = maps.block
    block = whole[:, :, 3 * side : 4 * side, 5 * side : 6 * side]
    expected = np.sqrt(np.nanmean(block**2, axis=(2, 3)))
    np.testing.assert_allclose(maps.rms[:, :, 3, 5], expected, rtol=1e-9)


def test_a_part_of_the_detector_is_a_part_of_the_whole(case: Path) -> None:
    """The draw belongs to the pixels, whoever looks at them; beyond the edge nothing is good."""
    detector = the_detector(case / "run")
    whole = detector.patch((0, SHAPE[0]), (0, SHAPE[1]))
    part = detector.patch((53, 88), (-6, 79))
    for a, b in ((whole.true, part.true), (whole.known, part.known)):
        np.testing.assert_array_equal(a[:, 53:88, :79], b[:, :, 6:])
    assert not part.good[:, :6].any()
    np.testing.assert_array_equal(part.good[:, 6:], whole.good[53:88, :79])
    draw = (whole.true - whole.known)[:, whole.good] / SIGMA
    assert np.std(draw) == pytest.approx(1, abs=0.03)
    assert abs(np.corrcoef(*draw)[0, 1]) < 0.03
    assert not detector.patch((200, 210), (0, 5)).good.any()
    other = the_detector(case / "run", seed=1).patch((0, 10), (0, 10))
    assert np.all(other.true != whole.true[:, :10, :10])


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "runtime", [Runtime("threads", workers=3), Runtime("processes", workers=2)]
)
def test_the_same_bits_however_it_runs(case: Path, tmp_path: Path, runtime: Runtime) -> None:
    config = Config(truth=case / "truth", stars=20, positions=3)
    found = []
    for name, how in (("one", SYNC), ("other", runtime)):
        shutil.copytree(case / "run", tmp_path / name)
        astrometry.run(tmp_path / name, config, how)
        found.append((tmp_path / name / "astrometry" / "astrometry.json").read_bytes())
    assert found[0] == found[1]


@pytest.mark.long
def test_it_is_made_once_and_again_when_maps_change(
    case: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    monkeypatch.setattr(stage, "png", png)
    shutil.copytree(case / "run", run)
    config = Config(stars=10, positions=2)
    first = astrometry.run(run, config, SYNC)
    manifest = run / "astrometry" / "manifest.json"
    made = manifest.stat().st_mtime_ns
    (run / "products" / "astrometry.png").unlink()
    assert astrometry.run(run, config, SYNC).key == first.key
    assert manifest.stat().st_mtime_ns == made
    with Image.open(run / "products" / "astrometry.png") as picture:
        assert min(picture.size) > 1000
    monkeypatch.undo()
    assert astrometry.run(run, replace(config, seed=1), SYNC).key != first.key
    make_run(tmp_path / "next", offsets(8, 1e-3), SIGMA)
    shutil.copyfile(
        tmp_path / "next" / "products" / "delta_y.fits", run / "products" / "delta_y.fits"
    )
    assert astrometry.run(run, config, SYNC).key != first.key


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize("truth", [False, True])
def test_one_fringe_axis(tmp_path: Path, truth: bool) -> None:
    """Along that axis only; what lies across it is not known and said to be missing."""
    axis = np.array([0.6, 0.8])
    true = offsets(1, SCATTER)
    along = axis[0] * true["delta_x"] + axis[1] * true["delta_y"]
    sets = {"slanted": PARAXIAL | {"kx": 0.6 * K, "ky": 0.8 * K, "axis": axis.tolist()}}
    error = np.random.default_rng(3).normal(0, SIGMA, SHAPE)
    run = make_run(tmp_path / "run", {"delta_fringe": along + error}, SIGMA, (), sets)
    folder = write_truth(tmp_path / "truth", true) if truth else None
    astrometry.run(run, Config(truth=folder, stars=100, positions=5), SYNC)
    found = result_of(run)
    assert list(found["axes"]) == ["fringe"]
    gain = found["axes"]["fringe"]["floor"]["gain"]["value"]
    assert gain == pytest.approx(SCATTER / SIGMA, rel=0.12)
    assert any("one axis only" in w for w in found["warnings"])
    seen = the_star()
    weights = np.einsum("a,abyx,b->yx", axis, seen.weights(np.zeros(2)), axis)
    expected = SIGMA * np.sqrt(np.sum(weights**2))
    # Stars at neighbouring places have pixels in common: of a map's rms that is its chance.
    shared = np.sum(correlate(weights, weights) ** 2) / np.sum(weights**2) ** 2
    chance = np.sqrt(shared / (2 * SHAPE[0] * SHAPE[1]))
    assert chance < 0.06
    everywhere = found["axes"]["fringe"]["everywhere"]["measured_px"]
    assert everywhere == pytest.approx(expected, rel=4 * chance)
    assert (run / "astrometry" / "astrometry.zarr" / "measured_fringe").is_dir()


def broken(case: Path, tmp_path: Path, breaking: Callable[[Path], None]) -> Path:
    run = tmp_path / "run"
    shutil.copytree(case / "run", run)
    breaking(run)
    return run


def test_mistakes_are_told(case: Path, tmp_path: Path) -> None:
    run = case / "run"
    for config, word in (
        (Config(window=99), "--window"),
        (Config(truth=tmp_path), "--truth"),
        (Config(truth=tmp_path / "nowhere"), "--truth"),
    ):
        with pytest.raises(InputError, match=word):
            astrometry.run(run, config, SYNC)
    with pytest.raises(InputError, match="--focal-length"):
        astrometry.run(run, Config(focal_length_m=1.0), SYNC)
    with pytest.raises(InputError, match="--window 12"):
        Config(window=12)
    with pytest.raises(InputError, match="--electrons"):
        Config(electrons=1e16)
    other = write_truth(tmp_path / "other", offsets(1, 1e-3, (31, 33)))
    with pytest.raises(InputError, match=r"other/delta_x\.fits.*31, 33.*97, 131"):
        astrometry.run(run, Config(truth=other), SYNC)
    with pytest.raises(InputError, match="pixcal fit"):
        astrometry.run(
            broken(case, tmp_path / "1", lambda r: shutil.rmtree(r / "fit")), Config(), SYNC
        )
    with pytest.raises(InputError, match=r"delta_y\.fits.*pixcal fit"):
        astrometry.run(
            broken(case, tmp_path / "2", lambda r: (r / "products" / "delta_y.fits").unlink()),
            Config(),
            SYNC,
        )
    with pytest.raises(PlanError, match="--memory"):
        astrometry.run(run, Config(stars=10), Runtime("sync", memory=300 << 20))


def test_no_place_for_a_star(tmp_path: Path) -> None:
    shape = (30, 34)
    masked = [(y, x) for y in range(0, 30, 2) for x in range(0, 34, 2)]
    run = make_run(tmp_path / "run", offsets(1, 1e-3, shape), SIGMA, masked)
    with pytest.raises(InputError, match=r"delta_x\.fits.*no place for a star"):
        astrometry.run(run, Config(stars=4), SYNC)


def test_masked_pixels_take_places_away(results: dict[str, dict[str, Any]]) -> None:
    plan = results["drawn"]["stars"]
    assert 0 < plan["number"] * plan["positions"] - plan["positions_used"] < 100
    assert any("too close to masked pixels" in w for w in results["drawn"]["warnings"])
    half = the_star().half
    inside = (SHAPE[0] - 2 * half) * (SHAPE[1] - 2 * half)
    assert inside - 200 < results["drawn"]["detector"]["places"] < inside


@pytest.mark.parametrize("truth", [False, True])
def test_tasks_stay_within_their_plan(case: Path, truth: bool) -> None:
    detector = the_detector(case / "run", case / "truth" if truth else None)
    modes = DegenerateModes(SHAPE, ()).n_smooth + 8 if truth else 0
    seen, config = the_star(), Config(positions=9, dither_px=60.0)
    planned, _ = stage.planned(SHAPE, modes, seen.side, config)
    core = stars.core_weights(seen, detector.axes)
    tasks: list[Callable[[], Any]] = [
        lambda: place_errors(detector, seen, (0, SHAPE[0]), (0, SHAPE[1])),
        lambda: stars.observe_star(detector, seen, config, core, 1),
    ]
    for task in tasks:
        task()
        tracemalloc.start()
        task()
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert peak < planned
    assert planned < 400 << 20


def test_blocks_fill_the_parts() -> None:
    for shape in ((61, 67), (5456, 8320), (400, 400), (20000, 27000)):
        side, block = tile_side(shape)
        assert side % block == 0
        assert -(-max(shape) // block) <= 96


@pytest.mark.long
def test_undersampled_and_oversampled_telescopes(case: Path, tmp_path: Path) -> None:
    """Fewer pixels a star, more of their scatter: the floor follows."""
    floors = []
    for n, focal_length in enumerate((30.0, 130.0, 260.0)):
        run = tmp_path / str(n)
        shutil.copytree(case / "run", run)
        config = Config(focal_length_m=focal_length, stars=40, positions=2, obscuration=0.2)
        astrometry.run(run, config, SYNC)
        found = result_of(run)
        floors.append(found["axes"]["x"]["floor"]["perfect"]["px"])
        assert found["axes"]["x"]["floor"]["gain"]["value"] > 7
    assert floors[0] > 1.3 * floors[1] > 1.3**2 * floors[2]


@pytest.mark.parametrize(
    ("value", "error", "text"),
    [
        (3.2517e-3, 1.63e-5, "(3.252 ± 0.016)e-3"),
        (6.27e-5, 2.4e-6, "(6.3 ± 0.2)e-5"),
        (9.98e-4, 2e-5, "(1.00 ± 0.02)e-3"),
        (14.603, 0.11, "14.60 ± 0.11"),
        (1e-3, None, "0.001"),
        (2.0, 0.0, "2"),
    ],
)
def test_numbers_with_their_errors(value: float, error: float | None, text: str) -> None:
    assert with_error(value, error) == text


def test_short_exponents() -> None:
    assert [scientific(v) for v in (1e8, 2.5e11, 3000.0, 12345.0)] == [
        "1e8",
        "2.5e11",
        "3e3",
        "1.23e4",
    ]
