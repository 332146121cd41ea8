"""The public names: the stages as functions, the same maps from arrays as from files."""

import dataclasses
import gc
import inspect
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest
from astropy.io import fits
from numpy.typing import NDArray

import pixcal
from pixcal import api
from pixcal.estimators.fringe_fit.shapes import fringe_models
from pixcal.stages import (
    allan,
    astrometry,
    budget,
    compare,
    crests,
    diagnose,
    fit,
    ingest,
    reduce,
    simulate,
)
from pixcal.storage.products import read_map
from pixcal_cli.main import cli

SYNC = pixcal.Runtime(cluster="sync")
PUBLIC = [name for name in pixcal.__all__ if name != "__version__"]
STAGES = {
    "allan": allan,
    "astrometry": astrometry,
    "budget": budget,
    "compare": compare,
    "crests": crests,
    "diagnose": diagnose,
    "fit": fit,
    "ingest": ingest,
    "reduce": reduce,
    "simulate": simulate,
}
BENCH_OPTIONS = {
    "pitch_um": 4.4,
    "gain_e_per_adu": 1.0,
    "read_noise_e": 16.0,
    "wavelength_nm": 632.8,
    "distance_mm": 400.0,
    "frame_period_s": 0.14,
    "exptime_s": 0.02,
}


@pytest.fixture(scope="module")
def acquired(make_bench: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Any:
    """A bench, its acquisition in files, and the run made of it."""
    bench = make_bench(shape=(61, 67), frames=70, response=0.01)
    folder = tmp_path_factory.mktemp("api")
    bench.write(folder / "acquisition")
    return bench, pixcal.run(folder / "acquisition", folder / "run", diagnosed=False, runtime=SYNC)


def arrays_of(run: pixcal.Run) -> dict[str, NDArray[Any]]:
    folder = run.path.parent / "acquisition"
    return {file.stem: np.array(fits.getdata(file)) for file in folder.glob("*.fits")}


def in_memory(bench: Any, run: pixcal.Run, **changes: Any) -> dict[str, Any]:
    """Arguments of `calibrate` for the frames of an acquisition."""
    found = arrays_of(run)
    plain: dict[str, Any] = {
        "frames": {name: found[name] for name in bench.sets},
        "baselines_mm": dict(bench.sets),
        "bias": found["bias"],
        "flats": {0.1: found["flat"]},
    }
    return plain | BENCH_OPTIONS | {"runtime": SYNC} | changes


def test_importing_pixcal_is_cheap() -> None:
    code = "import sys, pixcal; assert 'run' in dir(pixcal); print(*sys.modules)"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"numpy", "numba", "zarr", "pixcal.api"} & set(found.stdout.split())


def test_every_public_name_is_there() -> None:
    """Also of `pixcal.api`."""
    for name in PUBLIC:
        assert getattr(pixcal, name) is getattr(api, name)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        pixcal.nothing  # noqa: B018
    assert (Path(pixcal.__file__).parent / "py.typed").is_file()


def test_no_name_is_hidden_by_a_folder_of_the_package() -> None:
    folders = {path.parent.name for path in Path(pixcal.__file__).parent.glob("*/__init__.py")}
    assert not folders & set(PUBLIC)


def test_every_command_is_a_function() -> None:
    stages = {name for name, one in cli.commands.items() if not isinstance(one, click.Group)}
    # A noun is no name for a function.
    names = {"report": "write_report", "centroids": "correct_centroids", "wcs": "distortion_wcs"}
    names |= {"electrons": "to_electrons"}
    assert {names.get(stage, stage) for stage in stages} <= set(PUBLIC)


@pytest.mark.parametrize("name", STAGES)
def test_a_function_has_the_options_of_its_stage(name: str) -> None:
    options = inspect.signature(getattr(pixcal, name)).parameters
    for field in dataclasses.fields(STAGES[name].Config):
        assert field.name in options, f"option {field.name} of {name}"
        given = options[field.name]
        assert given.kind is inspect.Parameter.KEYWORD_ONLY
        assert given.default == field.default, field.name


@pytest.mark.parametrize("name", [n for n in PUBLIC if inspect.isfunction(getattr(pixcal, n))])
def test_a_docstring_tells_every_parameter(name: str) -> None:
    function = getattr(pixcal, name)
    text = inspect.getdoc(function) or ""
    for parameter in inspect.signature(function).parameters:
        assert parameter in text, f"{name}: {parameter} is not told"
    assert "Raises" in text


def test_an_option_that_there_is_not_is_refused() -> None:
    with pytest.raises(TypeError, match="unexpected keyword argument 'modle'"):
        pixcal.fit("run", modle="paraxial")


def test_the_shapes_of_fringes_are_the_choices_of_the_fit() -> None:
    (model,) = (f for f in dataclasses.fields(fit.Config) if f.name == "model")
    assert set(model.metadata["choices"]) == {"auto", *fringe_models()}


def test_maps_are_those_of_the_products(acquired: Any) -> None:
    _, run = acquired
    assert set(run.maps) == {"delta_x", "delta_y"}
    for name in ("delta_x", "delta_y"):
        data, sigma, mask, header = read_map(run.path / "products" / f"{name}.fits")
        found = getattr(run, name)
        for own, other in ((found.delta, data), (found.sigma, sigma), (found.mask, mask)):
            np.testing.assert_array_equal(own, other)
        assert found.header == header
        assert np.isfinite(found.delta[found.good]).all()
        assert np.isnan(found.delta[~found.good]).all()


def test_the_stages_are_told(acquired: Any) -> None:
    bench, run = acquired
    assert run.acquisition.detector.pitch_um == 4.4
    assert len(run.frames["fringes/vertical"]["time_s"]) == bench.frames
    assert run.reduction["gain_e_per_adu"]["used"] == 1.0
    assert {a.shape for a in run.detector.values()} == {bench.shape}
    assert run.report.read_text(encoding="utf-8").startswith("<!")
    for name, fringes in run.sets.items():
        assert fringes.facts == run.fit["sets"][name]
        assert fringes.allan == run.allan["sets"][name]
        for values in (fringes.delta, fringes.sigma, fringes.iota, fringes.alpha, fringes.chi2):
            assert values.shape == bench.shape
        assert fringes.batch_delta.shape == fringes.batch_sigma.shape
        assert fringes.batch_delta.shape[1:] == bench.shape
        assert {len(column) for column in fringes.series.values()} == {bench.frames}
        # The pixels' level and the frames' light are those of the bench.
        light = bench.level * bench.illumination() * np.mean(bench.scan(name)[0])
        good = fringes.mask == 0
        assert np.median(fringes.iota[good] / light[good]) == pytest.approx(1, abs=0.02)


def test_pictures_are_png(acquired: Any, tmp_path: Path) -> None:
    _, run = acquired
    for picture in (run.delta_x.picture(), run.sets["vertical"].allan_picture()):
        assert picture._repr_png_().startswith(b"\x89PNG")
        assert picture.save(tmp_path / "figure.png").read_bytes() == picture.png


def test_a_run_stands_for_its_path(acquired: Any) -> None:
    _, run = acquired
    again = pixcal.fit(run, runtime=SYNC)
    assert again == run == pixcal.open_run(str(run.path))
    assert pixcal.allan(run, regions=[(0, 9, 0, 8)], runtime=SYNC).allan["sets"]["vertical"][
        "regions"
    ].keys() == {"0:9,0:8"}


def test_arrays_give_the_maps_of_the_same_frames_in_files(acquired: Any) -> None:
    bench, run = acquired
    found = pixcal.calibrate(**in_memory(bench, run))
    for name in ("delta_x", "delta_y"):
        for part in ("delta", "sigma", "mask"):
            np.testing.assert_array_equal(
                getattr(found.maps[name], part), getattr(run.maps[name], part)
            )
    for name, fringes in found.sets.items():
        assert fringes.allan == run.sets[name].allan
    assert {path.name for path in found.path.iterdir()} >= {"ingest", "fit", "products"}
    assert not list(found.path.glob(".frames-*"))


@pytest.mark.long
def test_the_type_of_the_samples_does_not_matter(acquired: Any) -> None:
    bench, run = acquired
    found, kinds = arrays_of(run), {"vertical": np.int64, "horizontal": np.float64}
    same = {name: found[name].astype(kind) for name, kind in kinds.items()}
    other = pixcal.calibrate(**in_memory(bench, run, frames=same))
    for name in ("delta_x", "delta_y"):
        np.testing.assert_allclose(
            other.maps[name].delta,
            run.maps[name].delta,
            atol=0.05 * np.nanmax(run.maps[name].sigma),
        )


def test_which_fibre_is_called_a_does_not_matter(acquired: Any) -> None:
    bench, run = acquired
    turned = {name: (-x, -y) for name, (x, y) in bench.sets.items()}
    other = pixcal.calibrate(**in_memory(bench, run, baselines_mm=turned))
    for name in ("delta_x", "delta_y"):
        found, sigma = other.maps[name], run.maps[name].sigma
        np.testing.assert_allclose(found.delta, run.maps[name].delta, atol=0.02 * sigma.max())


@pytest.mark.long
def test_a_temporary_run_goes_with_the_last_reference(acquired: Any) -> None:
    bench, run = acquired
    only = {"frames": {"vertical": arrays_of(run)["vertical"]}}
    arguments = in_memory(bench, run, **only, baselines_mm={"vertical": bench.sets["vertical"]})
    found = pixcal.calibrate(**arguments)
    assert found.delta_fringe.delta.shape == bench.shape
    with pytest.raises(pixcal.InputError, match="no delta_x there, only delta_fringe"):
        _ = found.delta_x
    folder, sets = found.path, found.sets
    del found
    gc.collect()
    assert sets["vertical"].iota.shape == bench.shape
    del sets
    gc.collect()
    assert not folder.exists()


def test_a_run_can_be_kept_and_fitted_again(acquired: Any, tmp_path: Path) -> None:
    bench, run = acquired
    kept = pixcal.calibrate(**in_memory(bench, run, out=tmp_path / "kept"))
    assert kept.path == tmp_path / "kept"
    assert pixcal.fit(kept, model="paraxial", runtime=SYNC).fit["model"] == "paraxial"
    with pytest.raises(pixcal.InputError, match=r"out: .*kept is not empty"):
        pixcal.calibrate(**in_memory(bench, run, out=tmp_path / "kept"))


CUBE = np.full((4, 5, 6), 100, np.uint16)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": {}}, "frames: empty"),
        ({"frames": {"vertical": CUBE[0]}}, r"frames\['vertical'\]: shape \(5, 6\); frames are"),
        ({"frames": {"vertical": CUBE[:0]}}, r"frames\['vertical'\]: shape \(0, 5, 6\)"),
        ({"frames": {"vertical": CUBE > 0}}, r"frames\['vertical'\]: bool samples"),
        ({"frames": {"vertical": CUBE + np.int64(1 << 25)}}, "samples from 33554532 to 33554532"),
        ({"frames": {"diagonal": CUBE}}, "baselines_mm: diagonal, vertical: each set"),
        (
            {"bias": CUBE[:, :2]},
            r"bias: frames of \(2, 6\) pixels \(y, x\), where .* \(5, 6\); all",
        ),
        ({"flats": {-1.0: CUBE}}, r"flats\[-1.0\]: not an exposure time"),
        ({"darks": {1.0: CUBE}, "exptime_s": None}, "exptime_s: missing"),
        ({"pitch_um": -1}, r"pixcal.calibrate: detector.pitch_um: -1 "),
        ({"baselines_mm": {"vertical": (0, 0)}}, "both components are zero"),
        ({"baselines_mm": {"vertical": 6.0}}, r"such as \[a, b\], in mm, found 6.0"),
        ({"frames": {"../x": CUBE}, "baselines_mm": {"../x": (6, 0)}}, "is not made of letters"),
    ],
)
def test_what_is_wrong_is_named(changes: dict[str, Any], message: str, tmp_path: Path) -> None:
    plain = {"frames": {"vertical": CUBE}, "baselines_mm": {"vertical": (6.0, 0.0)}}
    out = tmp_path / "out"
    with pytest.raises(pixcal.InputError, match=message) as caught:
        pixcal.calibrate(**(plain | BENCH_OPTIONS | {"out": out} | changes))
    assert "\n" not in str(caught.value)
    assert not out.exists()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda run: pixcal.fit(run, model="conical"), "pixcal.fit: model: 'conical' is not one"),
        (lambda run: pixcal.fit(run, chi2_limit=0.5), "pixcal.fit: chi2_limit: 0.5 must be"),
        (lambda run: pixcal.reduce(run, hot_sigma=1), "pixcal.reduce: hot_sigma: 1 is below 5"),
        (lambda run: pixcal.allan(run, region=(0, 9)), "pixcal.allan: region: expected 4 values"),
        (lambda run: pixcal.fit(run, own=["mine.py"]), "--own: only used with --with-diagnosis"),
        (lambda run: pixcal.fit(run, with_diagnosis=True), "diagnose: not there yet; run 'pixcal"),
        (lambda run: run.diagnosis, "diagnose: not there yet; run 'pixcal diagnose"),
        (lambda run: run.corrected, "corrected: not there yet; run 'pixcal"),
        (lambda run: pixcal.open_run(run.path / "nowhere"), "nowhere: no such run directory"),
        (lambda run: pixcal.budget("none.yaml", frames=0), "pixcal.budget: frames: 0 is below 1"),
        (lambda run: pixcal.astrometry(run, stars=1), "pixcal.astrometry: stars: 1 is below 2"),
    ],
)
def test_an_option_out_of_range_is_named(
    acquired: Any, call: Callable[[pixcal.Run], Any], message: str
) -> None:
    with pytest.raises(pixcal.InputError, match=message):
        call(acquired[1])


@pytest.mark.long
def test_the_other_commands_give_their_tables(
    acquired: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, run = acquired
    # Drawing takes most of the time.
    for stage in ("crests", "compare", "astrometry"):
        monkeypatch.setattr(f"pixcal.stages.{stage}.stage.png", lambda figure: b"")
    assert pixcal.crests(run, frames=1, runtime=SYNC)["sets"].keys() == run.sets.keys()
    found = pixcal.compare([run], tmp_path / "halves", runtime=SYNC)
    assert (tmp_path / "halves" / "compare.json").is_file()
    assert found["schema"] == "pixcal/compare/1"
    stars = pixcal.astrometry(run, stars=2, positions=2, dither_px=1, electrons=1e7, runtime=SYNC)
    assert stars["schema"]


def test_the_sample_can_be_found() -> None:
    folder = pixcal.sample_acquisition()
    assert (folder / "acquisition.yaml").is_file()
    assert (folder.parent / "demo-truth" / "truth.json").is_file()
