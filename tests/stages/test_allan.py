"""The stage ``allan`` on batch maps written here, of known noise."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import allantools
import numpy as np
import pytest
import xarray
from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.kernels.allan import allan_deviation, averaging_lengths
from pixcal.model.errors import DamagedError, InputError, PlanError
from pixcal.stages import allan
from pixcal.stages.allan import Config, stage
from pixcal.storage.artefact import build
from pixcal.storage.cube import create_array, create_group, write_array
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import read_json, write_json

F64 = NDArray[np.float64]
SYNC = Runtime(cluster="sync")
DEFAULT = Config()
SIGMA = 2e-3
PER_LENGTH = (
    "frames",
    "seconds",
    "adev_px",
    "adev_err_px",
    "adev_lo_px",
    "adev_hi_px",
    "white_expected_px",
)


def noise(n: int = 36, shape: tuple[int, int] = (23, 31), seed: int = 1) -> F64:
    """Batch maps (batch, y, x) of still offsets and white noise, px."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, 5e-3, shape) + SIGMA * rng.normal(size=(n, *shape))


def write_fit(
    run: Path,
    sets: dict[str, F64],
    chunks: tuple[int, int] = (8, 9),
    batch_frames: int = 500,
    note: str = "",
) -> Path:
    """What the fit leaves, as far as it matters here."""
    facts = {name: {"batch_frames": batch_frames, "batch_note": note} for name in sets}
    with build(run, "fit", 1, {"chunks": chunks}, {"sweep": str(len(sets))}) as made:
        create_group(made.folder / "fit.zarr")
        for name, maps in sets.items():
            _write_set(made.folder / "fit.zarr" / name, maps, chunks, batch_frames)
        write_json(made.folder / "fit.json", {"sets": facts})
    return run


def _write_set(folder: Path, maps: F64, chunks: tuple[int, int], batch_frames: int) -> None:
    n = len(maps)
    create_group(folder)
    present = np.isfinite(maps).any(axis=(1, 2))
    write_array(folder / "batch_count", (batch_frames * present).astype("i4"), dims=("batch",))
    write_array(folder / "batch_time", (np.arange(n) + 0.5) * 70.0, dims=("batch",))
    delta = np.zeros(maps.shape[1:], np.float32)
    write_array(folder / "delta", delta, dims=("y", "x"), chunks=chunks)
    sigma = np.where(np.isfinite(maps), SIGMA, np.nan)
    for name, data in (("batch_delta", maps), ("batch_sigma", sigma)) if n else ():
        writer = create_array(
            folder / name, data.shape, "f4", dims=("batch", "y", "x"), chunks=(n, *chunks)
        )
        writer.write((0, 0, 0), data.astype(np.float32))
        writer.finish()


def measured(run: Path, config: Config = DEFAULT, runtime: Runtime = SYNC) -> dict[str, Any]:
    """Run the stage; the part of ``allan.json`` of the first set."""
    allan.run(run, config, runtime)
    sets = read_json(run / "allan" / "allan.json")["sets"]
    first: dict[str, Any] = next(iter(sets.values()))
    return first


def test_white_noise(tmp_path: Path) -> None:
    maps = noise()
    found = measured(write_fit(tmp_path, {"vertical": maps}))
    lengths = averaging_lengths(36)
    assert found["frames"] == [500 * m for m in lengths]
    assert found["seconds"] == [70.0 * m for m in lengths]
    expected = SIGMA / np.sqrt(lengths)
    assert found["white_expected_px"] == pytest.approx(expected, rel=1e-6)
    pulls = (np.array(found["adev_px"]) - expected) / found["adev_err_px"]
    assert np.abs(pulls).max() < 3
    assert 0.01 < found["adev_err_px"][0] / found["adev_px"][0] * np.sqrt(23 * 31) * 0.9 < 0.3
    assert np.all(np.array(found["adev_lo_px"]) < found["adev_px"])
    assert np.all(np.array(found["adev_hi_px"]) > found["adev_px"])
    assert abs(found["slope"] + 0.5) < 3 * found["slope_err"] < 0.1
    assert found["knee_frames"] is None
    assert (found["n_batches"], found["gaps"], found["batch_frames"]) == (36, 0, 500)
    assert (found["pixels"], found["region"], found["warnings"]) == (23 * 31, None, [])


def test_the_product_is_the_artefact(tmp_path: Path) -> None:
    manifest = allan.run(write_fit(tmp_path, {"a": noise(), "b": noise(7)}), Config(), SYNC)
    assert (manifest.stage, manifest.format) == ("allan", 1)
    product = json.loads((tmp_path / "products" / "allan.json").read_text())
    assert product == read_json(tmp_path / "allan" / "allan.json")
    assert product["schema"] == "pixcal/allan/1"
    assert list(product["sets"]) == ["a", "b"]
    for found in product["sets"].values():
        assert {len(found[key]) for key in PER_LENGTH} == {len(found["frames"])}


def test_the_map_is_each_pixel_s_deviation(tmp_path: Path) -> None:
    maps = noise()
    maps[:, 3, 4] = np.nan
    maps[20, 5, 6] = np.nan
    measured(write_fit(tmp_path, {"vertical": maps}))
    data = xarray.open_zarr(tmp_path / "allan" / "allan.zarr" / "vertical", consolidated=False)
    lengths = averaging_lengths(36)
    assert data.adev.dims == ("length", "y", "x")
    assert data.length.values.tolist() == [500 * m for m in lengths]
    stored = maps.astype(np.float32).reshape(36, -1)
    expected = allan_deviation(stored, lengths).astype(np.float32).reshape(data.adev.shape)
    np.testing.assert_array_equal(data.adev.values, expected)
    assert np.isnan(data.adev.values[:, 3, 4]).all()
    lost = np.argwhere(np.isnan(data.adev.values[:, 5, 6]))
    assert lost.tolist() == [[6]], "two means of 12 fit on neither side of batch 20"
    assert np.isnan(data.adev.values).sum() == len(lengths) + 1
    assert data.adev.attrs["units"] == "pixel"


def test_a_pixel_is_what_allantools_gives(tmp_path: Path) -> None:
    maps = noise(61)
    config = Config(regions=((7, 8, 19, 20), (2, 19, 5, 30)))
    found = measured(write_fit(tmp_path, {"vertical": maps}), config)["regions"]
    assert list(found) == ["7:8,19:20", "2:19,5:30"]
    pixel = found["7:8,19:20"]
    lengths = np.array(averaging_lengths(61), float)
    series = maps[:, 7, 19].astype(np.float32).astype(float)
    _, plain, _, _ = allantools.oadev(series, data_type="freq", taus=lengths)
    assert pixel["adev_px"] == pytest.approx(plain, rel=1e-6)
    assert pixel["pixels"] == 1
    assert pixel["adev_hi_px"][-1] > pixel["adev_px"][-1] * 1.2 > pixel["adev_lo_px"][-1]
    assert found["2:19,5:30"]["pixels"] == 17 * 25


def test_the_main_curve_of_a_region(tmp_path: Path) -> None:
    maps = noise()
    maps[:, 10:, :] *= 100
    run = write_fit(tmp_path, {"vertical": maps})
    found = measured(run, Config(region=(0, 10, 3, 31)))
    assert found["region"] == [0, 10, 3, 31]
    assert found["pixels"] == 280
    assert found["adev_px"][0] == pytest.approx(SIGMA, rel=0.05)
    again = measured(run, Config(regions=((0, 10, 3, 31),)))
    assert again["adev_px"][0] > 10 * SIGMA
    same = again["regions"]["0:10,3:31"]
    assert [same[key] for key in PER_LENGTH] == [found[key] for key in PER_LENGTH]


@pytest.mark.quick(1)
@pytest.mark.parametrize("chunks", [(5, 7), (4, 32), (23, 31)])
def test_results_do_not_depend_on_the_tiling(tmp_path: Path, chunks: tuple[int, int]) -> None:
    maps = noise()
    maps[np.random.default_rng(5).random(maps.shape) < 0.001] = np.nan
    config = Config(regions=((3, 20, 9, 28),))
    one = measured(write_fit(tmp_path / "one", {"vertical": maps}, (8, 9)), config)
    other = measured(write_fit(tmp_path / "other", {"vertical": maps}, chunks), config)
    assert one.keys() == other.keys()
    for key in (*PER_LENGTH, "slope", "slope_err"):
        assert one[key] == pytest.approx(other[key], rel=1e-9)
        assert one["regions"]["3:20,9:28"][key] == pytest.approx(
            other["regions"]["3:20,9:28"][key], rel=1e-9
        )
    first, second = (
        ArrayReader(tmp_path / name / "allan" / "allan.zarr" / "vertical" / "adev").read()
        for name in ("one", "other")
    )
    np.testing.assert_array_equal(first, second)


@pytest.mark.long
def test_results_do_not_depend_on_the_runtime(tmp_path: Path, dask_cluster: Runtime) -> None:
    maps = noise(25)
    texts = set()
    for number, runtime in enumerate(
        (SYNC, Runtime("threads", 3), Runtime("processes", 2), dask_cluster)
    ):
        run = write_fit(tmp_path / str(number), {"vertical": maps}, (3, 5))
        measured(run, Config(region=(0, 20, 1, 31)), runtime)
        texts.add((run / "allan" / "allan.json").read_text())
    assert len(texts) == 1


@pytest.mark.long
def test_gaps(tmp_path: Path) -> None:
    maps = noise(40)
    maps[11:15] = np.nan
    maps[30] = np.nan
    found = measured(write_fit(tmp_path, {"vertical": maps}))
    assert (found["n_batches"], found["gaps"]) == (40, 5)
    # 15 batches are the longest stretch: two means of 8 do not fit.
    assert found["frames"] == [500, 1000, 1500, 2000, 3000]
    expected = SIGMA / np.sqrt([1, 2, 3, 4, 6])
    assert np.all(
        np.abs(np.array(found["adev_px"]) - expected) < 3.5 * np.array(found["adev_err_px"])
    )
    shut = noise(40)
    shut[11:15], shut[30] = 1.0, -1.0
    whole = measured(write_fit(tmp_path / "shut", {"vertical": shut}))
    assert whole["adev_px"][0] > 20 * found["adev_px"][0], "a gap is no data, not some value"


def test_the_gaps_of_a_single_pixel_are_its_own(tmp_path: Path) -> None:
    maps = noise(40)
    maps[5:9, 2, 2] = np.nan
    config = Config(regions=((2, 3, 2, 3),))
    found = measured(write_fit(tmp_path, {"vertical": maps}), config)
    assert (found["gaps"], found["regions"]["2:3,2:3"]["gaps"]) == (0, 4)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_too_few_batches(tmp_path: Path, n: int) -> None:
    found = measured(write_fit(tmp_path, {"vertical": noise(n)}))
    assert all(found[key] == [] for key in PER_LENGTH)
    assert (found["slope"], found["slope_err"], found["knee_frames"]) == (None, None, None)
    assert found["warnings"] == [f"{n} of {n} batches have data: too few for an Allan deviation"]
    assert found["n_batches"] == n


def test_too_few_batches_beside_gaps(tmp_path: Path) -> None:
    maps = noise(30)
    maps[2:] = np.nan
    found = measured(write_fit(tmp_path, {"vertical": maps}))
    assert found["frames"] == []
    assert found["warnings"][0].startswith("2 of 30 batches have data")
    maps = noise(30)
    maps[::2] = np.nan
    found = measured(write_fit(tmp_path / "other", {"vertical": maps}))
    assert (found["frames"], found["gaps"]) == ([], 15)


def test_a_region_that_is_masked_gives_no_curve(tmp_path: Path) -> None:
    maps = noise(12)
    maps[:, 4:6, 4:9] = np.nan
    config = Config(regions=((4, 6, 4, 9),))
    found = measured(write_fit(tmp_path, {"vertical": maps}), config)
    assert found["pixels"] == 23 * 31 - 10
    assert found["regions"]["4:6,4:9"]["adev_px"] == []
    assert "0 of 12" in found["regions"]["4:6,4:9"]["warnings"][0]


def test_the_fit_s_note_is_stated_and_short_batches_are_no_alarm(tmp_path: Path) -> None:
    found = measured(write_fit(tmp_path, {"a": noise(12)}, batch_frames=8, note="uneven pace"))
    assert found["batch_frames"] == 8
    assert found["warnings"] == ["uneven pace"]


def test_a_drift_has_its_knee(tmp_path: Path) -> None:
    rng = np.random.default_rng(8)
    walk = 0.15 * SIGMA * rng.normal(size=(60, 23, 31)).cumsum(axis=0)
    found = measured(write_fit(tmp_path, {"vertical": noise(60) + walk}))
    knee = 500 * np.sqrt(3) / 0.15
    assert knee / 1.5 < found["knee_frames"] < knee * 1.5
    weak = noise(60, (101, 103)) + 0.02 * SIGMA * np.random.default_rng(8).normal(
        size=(60, 101, 103)
    ).cumsum(axis=0)
    found = measured(write_fit(tmp_path / "weak", {"vertical": weak}))
    assert found["knee_frames"] is None
    (warning,) = found["warnings"]
    assert "weak evidence of drift" in warning


@pytest.mark.parametrize(
    "region", [(0, 24, 0, 5), (0, 5, 0, 32), (5, 5, 0, 3), (6, 5, 0, 3), (-1, 5, 0, 3)]
)
def test_a_region_outside_the_window(tmp_path: Path, region: tuple[int, int, int, int]) -> None:
    run = write_fit(tmp_path, {"vertical": noise(6)})
    name = "{}:{},{}:{}".format(*region)
    for config in (Config(region=region), Config(regions=((0, 1, 0, 1), region))):
        with pytest.raises(InputError, match="0:23,0:31") as caught:
            allan.run(run, config, SYNC)
        assert f"--region {name}" in str(caught.value)
        assert "\n" not in str(caught.value)
    assert not (run / "allan").exists()


def test_the_fit_must_have_been_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="pixcal fit"):
        allan.run(tmp_path, Config(), SYNC)


def test_nothing_is_done_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = write_fit(tmp_path, {"vertical": noise(12)})
    first = allan.run(run, Config(), SYNC)
    (run / "products" / "allan.json").unlink()
    monkeypatch.setattr(stage, "allan_deviation", None)
    assert allan.run(run, Config(), SYNC) == first
    assert (run / "products" / "allan.json").exists(), "the product is put back"
    with pytest.raises(TypeError):
        allan.run(run, Config(region=(0, 9, 0, 9)), SYNC)
    assert allan.run(run, Config(), SYNC) == first, "a failed build leaves the old one"


def test_a_build_that_was_cut_short_is_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps = noise(12)
    run = write_fit(tmp_path / "cut", {"vertical": maps}, (3, 3))
    calls: list[int] = []

    def counted(limit: int) -> Callable[..., F64]:
        def body(*args: Any) -> F64:
            if len(calls) == limit:
                raise KeyboardInterrupt
            calls.append(1)
            return allan_deviation(*args)

        return body

    monkeypatch.setattr(stage, "allan_deviation", counted(40))
    with pytest.raises(KeyboardInterrupt):
        allan.run(run, Config(), SYNC)
    assert not (run / "allan").exists()
    monkeypatch.setattr(stage, "allan_deviation", counted(10**6))
    found = measured(run)
    tiles = 8 * 11
    assert len(calls) < tiles + 16, "only the square that was cut is done again"
    monkeypatch.undo()
    assert found == measured(write_fit(tmp_path / "whole", {"vertical": maps}, (3, 3)))


def test_a_damaged_fit_is_named(tmp_path: Path) -> None:
    run = write_fit(tmp_path, {"vertical": noise(12)})
    chunk = run / "fit" / "fit.zarr" / "vertical" / "batch_delta" / "c" / "0" / "1" / "2"
    chunk.unlink()
    with pytest.raises(DamagedError, match="batch_delta/c/0/1/2"):
        allan.run(run, Config(), SYNC)


def test_work_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    run = write_fit(tmp_path, {"vertical": noise(12)})
    with pytest.raises(PlanError, match=r"\d+ MiB, but the limit is 300 MiB"):
        allan.run(run, Config(), Runtime("sync", memory=300 << 20))
