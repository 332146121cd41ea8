"""The stage ``crests``: from a reduced run to fibre positions, held against the fit."""

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pixcal.engine.run import Runtime
from pixcal.kernels.optics import PARAMETERS
from pixcal.model.errors import DamagedError, InputError
from pixcal.stages import crests, fit
from pixcal.stages.crests import Config, stage
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import read_json, write_json

pytestmark = pytest.mark.long

SYNC = Runtime("sync")
SETS = {"vertical": (6.0, 0.0), "diagonal": (-3.0, 4.5)}


@pytest.fixture(scope="module", autouse=True)
def _coarse_maps() -> Iterator[None]:
    """Maps of the cost of few places: their finer form is only for the eye."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(stage, "MAP_SIDE", 5)
        yield


@pytest.fixture(scope="module")
def bench(make_bench: Any) -> Any:
    return make_bench(
        shape=(137, 150),
        frames=70,
        sets=SETS,
        interfringe=9.0,
        delta=2e-3,
        offset=(4.0, -3.0),
        laser_noise=0.02,
    )


@pytest.fixture(scope="module")
def fitted(bench: Any, write_reduced: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run on four uneven tiles, fitted with hyperbolic fringes; crests found as well."""
    run: Path = write_reduced(bench, tmp_path_factory.mktemp("crests") / "run")
    fit.run(run, fit.Config(model="hyperbolic"), Runtime())
    crests.run(run, Config(), SYNC)
    return run


@pytest.fixture(autouse=True)
def _undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pictures, but those of `fitted`, take longer than what is tested here."""
    monkeypatch.setattr(stage, "png", lambda figure: b"")


def found(run: Path) -> dict[str, Any]:
    sets: dict[str, Any] = read_json(run / "products" / "crests.json")["sets"]
    return sets


def bare(run: Path, other: Path) -> Path:
    """The run without what came after the reduction."""
    for name in ("ingest", "reduce"):
        shutil.copytree(run / name, other / name)
    return other


@pytest.mark.parametrize("name", SETS)
def test_the_fibres_are_where_they_are(bench: Any, fitted: Path, name: str) -> None:
    result = found(fitted)[name]
    geometry = result["geometry"]
    ny, nx = bench.shape
    bx, by = bench.sets[name]
    truth = [
        (nx - 1) / 2 * bench.pitch + bench.offset[0],
        (ny - 1) / 2 * bench.pitch + bench.offset[1],
        bench.distance,
        bx,
        by,
        0.0,
    ]
    for parameter, value in zip(PARAMETERS, truth, strict=True):
        error = geometry[f"{parameter}_mm"] - value
        assert abs(error) < 4 * geometry[f"{parameter}_sigma_mm"], parameter
        assert geometry[f"{parameter}_sigma_mm"] <= geometry[f"{parameter}_prior_sigma_mm"]
    assert result["interfringe_px"] == pytest.approx(9.0, rel=1e-3)
    assert len(result["frames"]) == 8
    assert result["frames"][-1] == 69
    assert result["unique_minimum"] is True
    assert result["points_used"] == result["points"] >= 24


@pytest.mark.parametrize("name", SETS)
def test_crests_and_fit_agree(fitted: Path, name: str) -> None:
    agreement = found(fitted)[name]["agreement"]
    for parameter, facts in agreement["parameters"].items():
        assert abs(facts["difference_sigma"]) < 3.5, parameter
        ratio = facts["difference_mm"] / facts["sigma_mm"]
        assert facts["difference_sigma"] == pytest.approx(ratio)
    # A window this small says nothing of the distance.
    assert agreement["parameters"]["distance"]["from_prior"] is True
    assert agreement["phase_rms_px"] < 3 * agreement["phase_sigma_px"] < 1e-3


def test_a_wrong_fit_shows(fitted: Path, tmp_path: Path, reseal: Any) -> None:
    run = tmp_path / "run"
    shutil.copytree(fitted, run)
    facts = read_json(run / "fit" / "fit.json")
    facts["sets"]["vertical"]["geometry"]["baseline_y_mm"] += 0.05
    write_json(run / "fit" / "fit.json", facts)
    reseal(run / "fit")
    crests.run(run, Config(frames=7), SYNC)
    agreement = found(run)["vertical"]["agreement"]
    assert abs(agreement["parameters"]["baseline_y"]["difference_sigma"]) > 10
    assert agreement["phase_rms_px"] > 10 * agreement["phase_sigma_px"]


def test_what_is_on_the_disk(fitted: Path) -> None:
    for name in SETS:
        result, folder = found(fitted)[name], fitted / "crests" / "crests.zarr" / name
        points = {n: ArrayReader(folder / n).read() for n in ("x", "y", "k", "sigma", "used")}
        assert {len(v) for v in points.values()} == {result["points"]}
        assert len(np.unique(points["k"])) == result["paths"]
        distance, ratio = (ArrayReader(folder / n).read() for n in ("distance", "ratio"))
        cost = ArrayReader(folder / "cost_ratio").read()
        assert cost.shape == (len(distance), len(ratio))
        assert ArrayReader(folder / "cost_baseline").read().shape[0] == len(distance)
        picture = fitted / "products" / f"crests-{name}.png"
        with Image.open(picture) as opened:
            assert min(opened.size) > 800
        assert picture.read_bytes() == (fitted / "crests" / f"crests-{name}.png").read_bytes()
    assert read_json(fitted / "crests" / "crests.json")["schema"] == "pixcal/crests/1"


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "runtime", [Runtime("threads", workers=3), Runtime("processes", workers=2)]
)
def test_the_same_bits_however_it_runs(fitted: Path, tmp_path: Path, runtime: Runtime) -> None:
    one, other = (bare(fitted, tmp_path / n) for n in ("one", "other"))
    for run, how in ((one, SYNC), (other, runtime)):
        crests.run(run, Config(frames=2), how)
    assert found(one) == found(other)


@pytest.mark.long
def test_it_runs_without_a_fit_and_again_with_one(fitted: Path, tmp_path: Path) -> None:
    run = bare(fitted, tmp_path / "run")
    first = crests.run(run, Config(frames=2), SYNC)
    assert crests.run(run, Config(frames=2), SYNC) == first
    assert found(run)["vertical"]["agreement"] is None
    assert "RUN/fit" in found(run)["vertical"]["agreement_note"]
    fit.run(run, fit.Config(model="paraxial"), Runtime())
    assert crests.run(run, Config(frames=2), SYNC).key != first.key
    assert found(run)["vertical"]["agreement"] is None
    assert "paraxial" in found(run)["vertical"]["agreement_note"]


def test_fewer_paths_and_longer_segments(fitted: Path, tmp_path: Path) -> None:
    run = bare(fitted, tmp_path / "run")
    crests.run(run, Config(frames=1, paths=2, segment=45), SYNC)
    result = found(run)["vertical"]
    assert result["paths"] == 4
    assert result["segment_px"] == pytest.approx(45, rel=0.1)
    assert result["points"] == 4 * 3


def test_what_cannot_be_done_is_said(
    bench: Any, fitted: Path, make_bench: Any, write_reduced: Any, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match="pixcal reduce"):
        crests.run(tmp_path_with(tmp_path, "empty"), Config(), SYNC)
    few = make_bench(shape=(61, 67), frames=5, sets={"wide": (1.0, 0.0)}, interfringe=20.0)
    with pytest.raises(InputError, match="'wide': too few fringes"):
        crests.run(write_reduced(few, tmp_path / "few"), Config(), SYNC)
    none = make_bench(
        shape=(61, 67), frames=5, sets={"none": (6.0, 0.0)}, interfringe=6.0, visibility=1e-5
    )
    with pytest.raises(InputError, match="'none': no fringes"):
        crests.run(write_reduced(none, tmp_path / "none"), Config(), SYNC)
    run = bare(fitted, tmp_path / "dark")
    acquisition = read_json(run / "ingest" / "acquisition.json")
    acquisition["frames"] = {"bias": ["x"]}
    write_json(run / "ingest" / "acquisition.json", acquisition)
    with pytest.raises(InputError, match=r"lists no frames.fringes, which crests needs"):
        crests.run(run, Config(), SYNC)


def tmp_path_with(tmp_path: Path, name: str) -> Path:
    folder = tmp_path / name
    folder.mkdir()
    return folder


def test_a_damaged_chunk_is_named(fitted: Path, tmp_path: Path) -> None:
    run = bare(fitted, tmp_path / "run")
    chunk = run / "reduce" / "reduced.zarr" / "vertical" / "signal" / "c" / "0" / "1" / "0"
    chunk.write_bytes(chunk.read_bytes()[:-7])
    with pytest.raises(DamagedError, match="signal/c/0/1/0"):
        crests.run(run, Config(frames=2), SYNC)
    assert not (run / "crests").exists()
