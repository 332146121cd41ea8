"""Reduction: maps, flags, electrons with their variance; whatever is missing is said."""

import importlib.util
import json
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import yaml
from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.model.acquisition import SCHEMA
from pixcal.model.errors import DamagedError, InputError, PlanError
from pixcal.model.flags import PixelFlag
from pixcal.stages import ingest, reduce
from pixcal.storage import artefact
from pixcal.storage.cube import create_array, create_group
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.manifest import digest, write_json

SYNC = Runtime(cluster="sync")
SHAPE = (131, 141)
"""Four columns of chunks, three of them cut by the edge."""

GAIN, READ, BIAS, FULL = 0.9, 12.0, 480.0, 60_000
FRINGE_S = 0.1


class Camera:
    """A detector whose pixels are known."""

    def __init__(self, seed: int = 0, shape: tuple[int, int] = SHAPE) -> None:
        self.rng = np.random.default_rng(seed)
        self.shape = shape
        self.bias = self.rng.normal(BIAS, 4, shape)
        self.dark = self.rng.normal(24, 2, shape)
        self.response = self.rng.normal(1, 0.01, shape)
        self.read = np.full(shape, READ)

    def take(
        self, frames: int, exptime: float, light: Any = 0.0, drift: float = 0.0
    ) -> NDArray[np.uint16]:
        """Frames under a light in e-/s at unit response."""
        expected = np.broadcast_to((self.response * light + self.dark) * exptime, self.shape)
        power = 1 + drift * self.rng.uniform(-1, 1, frames)
        charge = self.rng.poisson(expected * power[:, None, None]).astype(float)
        charge += self.rng.normal(size=charge.shape) * self.read
        return np.clip(np.round(charge / GAIN + self.bias), 0, FULL).astype(np.uint16)

    def fringes(self, frames: int, peak: float = 40_000) -> NDArray[np.uint16]:
        """Fringes that turn by a random phase from frame to frame."""
        x = np.arange(self.shape[1])
        phase = self.rng.uniform(0, 2 * np.pi, frames)
        parts = [
            self.take(1, FRINGE_S, peak / FRINGE_S * (0.5 + 0.45 * np.sin(2 * np.pi * x / 9.6 + p)))
            for p in phase
        ]
        return np.concatenate(parts)


def make_ingest(
    run: Path,
    arrays: Mapping[str, NDArray[Any]],
    exptimes: Mapping[str, Sequence[float | None]],
    **detector: Any,
) -> None:
    """``RUN/ingest`` as the page on the architecture has it."""
    facts = {"pitch_um": 4.4, "gain_e_per_adu": GAIN, "read_noise_e": READ, "saturation_adu": FULL}
    sets = [name.partition("/")[2] for name in arrays if "/" in name]
    frames: dict[str, Any] = {name: [f"{name}/*.fits"] for name in arrays if "/" not in name}
    frames["fringes"] = [{"name": s, "files": ["*"], "baseline_mm": [6.0, 0.0]} for s in sets]
    described = {
        "schema": SCHEMA,
        "detector": facts | detector,
        "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
        "frames": frames,
    }
    inputs = {name: digest(data.tobytes().hex()) for name, data in arrays.items()}
    with artefact.build(run, "ingest", 1, described, inputs) as made:
        create_group(made.folder / "raw.zarr")
        for name, data in arrays.items():
            writer = create_array(made.folder / "raw.zarr" / name, data.shape, data.dtype)
            writer.write((0, 0, 0), data)
            writer.finish()
        write_json(made.folder / "acquisition.json", described)
        tables = {
            name: {
                "file": [f"{name}/{n}.fits" for n in range(len(data))],
                "plane": [0] * len(data),
                "mjd": [None] * len(data),
                "exptime_s": exptimes[name],
                "temperature_c": [None] * len(data),
                "time_s": [0.14 * n for n in range(len(data))],
                "time_source": ["frame_period_s"] * len(data),
            }
            for name, data in arrays.items()
        }
        write_json(made.folder / "frames.json", tables)


def read(run: Path, name: str) -> NDArray[Any]:
    return ArrayReader(run / "reduce" / name).read()


def report(run: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((run / "reduce" / "reduce.json").read_text())
    return found


def spoil(camera: Camera) -> dict[str, tuple[int, int]]:
    """Bad pixels, in different columns of chunks."""
    bad = {"hot": (5, 7), "dead": (128, 9), "noisy": (60, 135), "telegraph": (130, 140)}
    camera.dark[bad["hot"]] = 3000
    camera.response[bad["dead"]] = 0
    camera.read[bad["noisy"]] = 5 * READ
    return bad


LADDER = (0.02, 0.05, 0.1)


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Camera, dict[str, Any]]:
    """A whole acquisition, reduced; particles and bad pixels included."""
    run = tmp_path_factory.mktemp("bench")
    camera = Camera()
    bad = spoil(camera)
    arrays = {
        "bias": camera.take(75, 0),
        "dark": camera.take(16, 2.0),
        "flat": np.concatenate([camera.take(9, t, 4.5e5, drift=0.03) for t in LADDER]),
        "fringes/vertical": camera.fringes(70),
        "fringes/short": camera.fringes(3, peak=20_000),
    }
    telegraph = np.where(camera.rng.random(75) < 0.5, 0, 70).astype(np.uint16)
    arrays["bias"][:, *bad["telegraph"]] += telegraph
    arrays["bias"][7, 30, 40] = 40_000
    arrays["dark"][3, 31, 41] = 40_000
    arrays["flat"][10, 32, 42] = 55_000
    arrays["fringes/vertical"][66, 90, 100] = FULL
    arrays["fringes/vertical"][[3, 9, 41], 91, 100] = FULL
    bend = np.repeat([1.0, 0.95, 0.8], 9)
    arrays["flat"][:, 80, 20] = (arrays["flat"][:, 80, 20] * bend).astype(np.uint16)
    exptimes: dict[str, list[float | None]] = {
        "bias": [0.0] * 75,
        "dark": [2.0] * 16,
        "flat": [t for t in LADDER for _ in range(9)],
        "fringes/vertical": [FRINGE_S] * 70,
        "fringes/short": [FRINGE_S] * 3,
    }
    make_ingest(run, arrays, exptimes)
    reduce.run(run, reduce.Config(), SYNC)
    return run, camera, {"arrays": arrays, "bad": bad}


# Maps


def good(run: Path) -> NDArray[np.bool_]:
    return np.asarray(read(run, "calibration.zarr/mask") == 0)


def test_the_maps_are_those_of_the_detector(bench: tuple[Path, Camera, Any]) -> None:
    run, camera, _ = bench
    ok = good(run)
    adu = np.hypot(READ / GAIN, 12**-0.5)
    for name, expected, error in (
        ("bias", camera.bias, adu / np.sqrt(75)),
        ("dark_rate", camera.dark, GAIN * adu / 2 * np.sqrt(1 / 75 + 1.35 / 16)),
        ("flat", camera.response, 1 / np.sqrt(4.5e5 * 9 * sum(LADDER))),
    ):
        off = read(run, f"calibration.zarr/{name}") - expected
        assert off[ok].std() == pytest.approx(error, rel=0.1), name
        assert abs(off[ok].mean()) < 5 * error / np.sqrt(ok.sum()) + 3e-4, name
    noise = read(run, "calibration.zarr/read_noise")[ok]
    assert np.sqrt(np.mean(noise**2)) == pytest.approx(GAIN * adu, rel=0.005)
    # The detector's variance counts as 30 degrees of freedom beside the 74 of each pixel.
    assert noise.std() == pytest.approx(READ / np.sqrt(2 * 74) * 74 / (74 + 30), rel=0.1)


def test_the_median_of_the_flat_is_one(bench: tuple[Path, Camera, Any]) -> None:
    assert np.median(read(bench[0], "calibration.zarr/flat")) == pytest.approx(1, abs=1e-6)


def test_particles_leave_no_trace_in_the_maps(bench: tuple[Path, Camera, Any]) -> None:
    run, camera, _ = bench
    assert read(run, "calibration.zarr/bias")[30, 40] == pytest.approx(camera.bias[30, 40], abs=8)
    rate = read(run, "calibration.zarr/dark_rate")[31, 41]
    assert rate == pytest.approx(camera.dark[31, 41], abs=10)
    flat = read(run, "calibration.zarr/flat")[32, 42]
    assert flat == pytest.approx(camera.response[32, 42], abs=0.004)


def test_bad_pixels_are_flagged_by_name_and_no_others(bench: tuple[Path, Camera, Any]) -> None:
    run, _, made = bench
    mask = read(run, "calibration.zarr/mask")
    bad = made["bad"]
    assert mask[bad["hot"]] == PixelFlag.HOT
    assert mask[bad["dead"]] == PixelFlag.DEAD
    assert mask[bad["noisy"]] & PixelFlag.NOISY
    assert mask[bad["telegraph"]] == PixelFlag.NOISY
    assert mask[80, 20] == PixelFlag.NONLINEAR
    assert (mask != 0).sum() == 5
    flags = report(run)["flags"]
    assert flags["good"] == mask.size - 5
    assert [flags[n] for n in ("hot", "dead", "noisy", "nonlinear", "no_data")] == [1, 1, 2, 1, 0]


def test_gain_and_read_noise_are_measured_and_set_against_the_declared(
    bench: tuple[Path, Camera, Any],
) -> None:
    found = report(bench[0])
    gain, noise = found["gain_e_per_adu"], found["read_noise_e"]
    assert gain["error"] < 0.01 * GAIN
    assert gain["measured"] == pytest.approx(GAIN, abs=3 * gain["error"])
    assert gain["used"] == gain["declared"] == GAIN
    assert noise["measured"] == pytest.approx(READ, rel=0.005)
    assert noise["with_rounding"] == pytest.approx(np.hypot(READ, GAIN / 12**0.5), rel=0.005)
    assert noise["declared"] == READ
    (lamp,) = found["warnings"]
    assert "the light of the flats scatters by up to 2.3 % rms" in lamp


def test_the_ladder_is_straight(bench: tuple[Path, Camera, Any]) -> None:
    found = report(bench[0])["linearity"]
    assert found["max_deviation_percent"] < 1.5  # the lamp's own drift, 3 % a frame
    assert [level["frames"] for level in found["levels"]] == [9, 9, 9]
    assert found["levels"][2]["level_e"] == pytest.approx(4.5e4, rel=0.03)


# Electrons


def test_samples_are_electrons_with_the_variance_that_is_said(
    bench: tuple[Path, Camera, Any],
) -> None:
    run, camera, made = bench
    data = xarray.open_zarr(run / "reduce/reduced.zarr/vertical", consolidated=False)
    ok = (data["mask"] == 0).values
    raw = made["arrays"]["fringes/vertical"].astype(float)
    response = np.maximum(camera.response, 0.05)
    electrons = (GAIN * (raw - camera.bias) - camera.dark * FRINGE_S) / response
    # The errors of bias and flat: 1.6 e- and 0.12 %.
    off = (data["signal"].values - electrons)[:, ok]
    assert np.sqrt(np.nanmean(off**2)) < 2 + 0.0014 * 25_000
    # The fringes are vertical: all rows of a column have the same light.
    light = np.median(electrons, axis=1, keepdims=True)
    variance = data["shot_factor"].values * light + data["read_variance"].values
    chi2 = ((data["signal"].values - light) ** 2 / variance)[:, ok]
    assert np.nanmean(chi2) == pytest.approx(1, abs=0.05)


def test_the_dataset_is_cf_for_xarray_and_dask(bench: tuple[Path, Camera, Any]) -> None:
    run, _, _ = bench
    folder = run / "reduce/reduced.zarr/vertical"
    lazy = xarray.open_zarr(folder, consolidated=False)
    assert lazy["signal"].dims == ("time", "y", "x")
    assert lazy["signal"].chunks == ((64, 6), (128, 3), (128, 13))
    assert lazy["signal"].attrs["units"] == "electron"
    assert set(lazy.coords) == {"time", "y", "x"}
    np.testing.assert_allclose(lazy["time"], 0.14 * np.arange(70))
    assert lazy["mask"].attrs["flag_meanings"].split()[3] == "saturated"
    signal = lazy["signal"]
    assert np.isnan(signal[66, 90, 100].compute())
    mean = signal.mean("time").compute()
    codes = read(run, "reduced.zarr/vertical/signal")
    attrs = ArrayReader(folder / "signal").attrs
    plain = np.where(codes == attrs["_FillValue"], np.nan, codes.astype(float))
    plain = plain * attrs["scale_factor"] + attrs["add_offset"]
    np.testing.assert_allclose(mean, np.nanmean(plain, axis=0), rtol=1e-6, atol=1e-3)
    tree = xarray.open_datatree(run / "reduce/reduced.zarr", engine="zarr", consolidated=False)
    assert set(tree.children) == {"vertical", "short"}


def test_saturated_samples_have_no_weight_and_are_counted(bench: tuple[Path, Camera, Any]) -> None:
    run, _, _ = bench
    found = report(run)["sets"]
    assert found["vertical"]["saturated_samples"] == 4
    assert found["vertical"]["flags"]["saturated"] == 1
    assert found["short"]["saturated_samples"] == 0
    codes = read(run, "reduced.zarr/vertical/signal")
    assert np.argwhere(codes[:, good(run)] == 65535).shape[0] == 4
    # One sample may be a particle; three of seventy are light.
    assert read(run, "reduced.zarr/vertical/mask")[90, 100] == 0
    assert read(run, "reduced.zarr/vertical/mask")[91, 100] == PixelFlag.SATURATED
    both = read(run, "calibration.zarr/mask") & ~read(run, "reduced.zarr/short/mask")
    assert not both.any(), "a set's mask holds the flags of the calibration"


def test_the_stored_precision_costs_less_than_a_thousandth(bench: tuple[Path, Camera, Any]) -> None:
    run, _, made = bench
    found = report(run)["quantisation"]["vertical"]
    assert found["share_of_variance_dark"] < 1e-3
    assert found["share_at_mean"] < 1e-5
    # Measured: what rounding did to the samples, against photon and read noise.
    maps = {n: read(run, f"calibration.zarr/{n}").astype(float) for n in ("bias", "flat")}
    rate = read(run, "calibration.zarr/dark_rate").astype(float)
    raw = made["arrays"]["fringes/vertical"].astype(float)
    exact = (GAIN * (raw - maps["bias"]) - rate * np.float32(FRINGE_S)) / maps["flat"]
    codes = read(run, "reduced.zarr/vertical/signal").astype(float)
    ok = codes != 65535
    added = (codes * found["step_e"] + found["offset_e"] - exact)[ok].var()
    assert added == pytest.approx(found["step_e"] ** 2 / 12, rel=0.05)
    assert added < 1e-3 * READ**2
    assert added < 1e-5 * (READ**2 + exact[ok].mean())


def test_the_read_variance_holds_dark_shot_noise_and_rounding(
    bench: tuple[Path, Camera, Any],
) -> None:
    run, _, _ = bench
    maps = {n: read(run, f"calibration.zarr/{n}") for n in ("dark_rate", "flat", "read_noise")}
    step = report(run)["quantisation"]["vertical"]["step_e"]
    dark = np.maximum(maps["dark_rate"], 0) * FRINGE_S
    expected = (maps["read_noise"] ** 2 + dark) / maps["flat"] ** 2 + step**2 / 12
    np.testing.assert_allclose(read(run, "reduced.zarr/vertical/read_variance"), expected, 1e-5)
    np.testing.assert_allclose(
        read(run, "reduced.zarr/vertical/shot_factor"), 1 / maps["flat"], 1e-6
    )


# The stage


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file()
    }


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "runtime", [Runtime(workers=2), Runtime(cluster="processes", workers=2)], ids=str
)
def test_the_bytes_do_not_depend_on_how_it_ran(
    bench: tuple[Path, Camera, Any], tmp_path: Path, runtime: Runtime
) -> None:
    run, _, _ = bench
    shutil.copytree(run / "ingest", tmp_path / "ingest")
    reduce.run(tmp_path, reduce.Config(), runtime)
    assert contents(tmp_path / "reduce") == contents(run / "reduce")


def test_it_is_not_done_twice_and_only_reads_the_ingest(
    bench: tuple[Path, Camera, Any], tmp_path: Path
) -> None:
    run, _, _ = bench
    before = contents(run / "reduce")
    again = reduce.run(run, reduce.Config(), SYNC)
    assert again.key == json.loads(before["manifest.json"])["key"]
    assert contents(run / "reduce") == before
    assert again.summary["flags"]["hot"] == 1
    assert not list((run / ".partial").iterdir())


class Killed(BaseException):
    pass


@pytest.mark.quick(1)
@pytest.mark.parametrize("survived", [1, 3, 5])
def test_a_run_that_was_cut_short_goes_on(
    bench: tuple[Path, Camera, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, survived: int
) -> None:
    run, _, _ = bench
    shutil.copytree(run / "ingest", tmp_path / "ingest")
    notes: list[str] = []
    note = artefact.Build.note

    def note_and_die(self: artefact.Build, step: str) -> None:
        note(self, step)
        notes.append(step)
        if len(notes) == survived:
            raise Killed

    monkeypatch.setattr(artefact.Build, "note", note_and_die)
    with pytest.raises(Killed):
        reduce.run(tmp_path, reduce.Config(), SYNC)
    assert not (tmp_path / "reduce").exists()
    first = set(notes)
    steps: list[str] = []

    def note_and_list(self: artefact.Build, step: str) -> None:
        note(self, step)
        steps.append(step)

    monkeypatch.setattr(artefact.Build, "note", note_and_list)
    reduce.run(tmp_path, reduce.Config(), SYNC)
    assert len(steps) == 2 + 2 * 2 - survived
    assert not first & set(steps)
    assert contents(tmp_path / "reduce") == contents(run / "reduce")


def test_too_little_memory_is_refused_with_both_numbers(
    bench: tuple[Path, Camera, Any], tmp_path: Path
) -> None:
    shutil.copytree(bench[0] / "ingest", tmp_path / "ingest")
    with pytest.raises(PlanError, match=r"reduce needs \d+ MiB, but the limit is 300 MiB"):
        reduce.run(tmp_path, reduce.Config(), replace(SYNC, memory=300 << 20))


def test_without_an_ingest_it_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="pixcal ingest"):
        reduce.run(tmp_path, reduce.Config(), SYNC)


def test_a_damaged_frame_is_refused(bench: tuple[Path, Camera, Any], tmp_path: Path) -> None:
    shutil.copytree(bench[0] / "ingest", tmp_path / "ingest")
    chunk = tmp_path / "ingest/raw.zarr/bias/c/1/0/0"
    body = bytearray(chunk.read_bytes())
    body[len(body) // 2] ^= 1
    chunk.write_bytes(body)
    with pytest.raises(DamagedError, match="bias/c/1/0/0"):
        reduce.run(tmp_path, reduce.Config(), SYNC)


# What may be missing or odd


SMALL = (19, 23)


def small(
    tmp_path: Path,
    kinds: Mapping[str, tuple[NDArray[Any], Sequence[float | None]]],
    config: reduce.Config | None = None,
    **detector: Any,
) -> dict[str, Any]:
    make_ingest(
        tmp_path,
        {k: v[0] for k, v in kinds.items()},
        {k: v[1] for k, v in kinds.items()},
        **detector,
    )
    reduce.run(tmp_path, config or reduce.Config(), SYNC)
    return report(tmp_path)


def test_flats_that_are_all_saturated_are_refused_as_such(tmp_path: Path) -> None:
    camera = Camera(1, SMALL)
    flats = np.full((4, *SMALL), 4095, np.uint16)
    kinds = {"bias": (camera.take(9, 0), [0.0] * 9), "flat": (flats, [1.0] * 4)}
    with pytest.raises(InputError, match="all flats are saturated"):
        small(tmp_path, kinds, saturation_adu=4095)


def test_an_overscan_is_named(tmp_path: Path) -> None:
    camera = Camera(1, SMALL)
    camera.response[:, :5], camera.response[3] = 0, 0
    kinds = {"bias": (camera.take(9, 0), [0.0] * 9), "flat": (camera.take(4, 1, 3e4), [1.0] * 4)}
    said = [w for w in small(tmp_path, kinds)["warnings"] if "see no light" in w]
    assert len(said) == 1
    assert said[0].startswith("columns 0 to 4 see no light")


def test_a_border_of_quiet_reference_pixels_does_not_count_in_the_read_noise(
    tmp_path: Path,
) -> None:
    camera = Camera(1, SMALL)
    border = np.ones(SMALL, np.bool_)
    border[4:-4, 4:-4] = False
    camera.response[border], camera.dark[border], camera.read[border] = 0, 0, 0.5 * READ
    kinds = {"bias": (camera.take(40, 0), [0.0] * 40), "flat": (camera.take(4, 1, 3e4), [1.0] * 4)}
    noise = small(tmp_path, kinds)["read_noise_e"]
    assert noise["measured"] / GAIN == pytest.approx(READ / GAIN, abs=3 * noise["error"] / GAIN)


def test_detector_frames_alone_are_enough(tmp_path: Path) -> None:
    camera = Camera(1, SMALL)
    found = small(
        tmp_path,
        {"bias": (camera.take(9, 0), [0.0] * 9), "flat": (camera.take(2, 1, 3e4), [1.0] * 2)},
    )
    assert found["sets"] == {}
    assert found["linearity"] is None
    assert not (tmp_path / "reduce/reduced.zarr").exists()
    assert found["gain_e_per_adu"]["measured"] == pytest.approx(
        GAIN, abs=4 * found["gain_e_per_adu"]["error"]
    )


def test_a_pixel_that_is_saturated_without_light_is_hot(tmp_path: Path) -> None:
    camera = Camera(13, SMALL)
    camera.dark[3, 4] = 1e6
    small(
        tmp_path, {"bias": (camera.take(9, 0), [0.0] * 9), "dark": (camera.take(9, 1), [1.0] * 9)}
    )
    assert read(tmp_path, "calibration.zarr/mask")[3, 4] & PixelFlag.HOT


def test_a_pixel_that_is_full_without_light_has_the_rate_of_the_shortest_such_dark(
    tmp_path: Path,
) -> None:
    camera = Camera(15, SMALL)
    camera.dark[3, 4] = 1e6
    darks = [camera.take(9, seconds) for seconds in (1, 30)]
    small(
        tmp_path,
        {
            "bias": (camera.take(9, 0), [0.0] * 9),
            "dark": (np.concatenate(darks), [1.0] * 9 + [30.0] * 9),
        },
    )
    bias, rate = (
        read(tmp_path, f"calibration.zarr/{name}")[3, 4] for name in ("bias", "dark_rate")
    )
    assert rate == pytest.approx(GAIN * (FULL - bias), rel=0.001)
    assert bias == pytest.approx(camera.bias[3, 4], abs=4 * READ / GAIN / 3)


def test_pixels_that_differ_are_not_noisy_under_dark_signal(tmp_path: Path) -> None:
    camera = Camera(14)
    camera.read = READ * camera.rng.lognormal(0, 0.2, SHAPE)
    camera.dark = np.full(SHAPE, READ**2 / 4)
    kinds = {
        "bias": (camera.take(20, 0), [0.0] * 20),
        "dark": (np.concatenate([camera.take(10, 1), camera.take(10, 8)]), [1.0] * 10 + [8.0] * 10),
    }
    found = small(tmp_path, kinds)
    assert found["flags"]["noisy"] < 3e-4 * camera.dark.size


def test_fringes_alone_are_reduced_with_warnings(tmp_path: Path) -> None:
    camera = Camera(2, SMALL)
    found = small(tmp_path, {"fringes/a": (camera.fringes(5), [None] * 5)})
    assert found["gain_e_per_adu"]["measured"] is None
    assert found["read_noise_e"]["measured"] is None
    assert any("no bias and no dark" in w for w in found["warnings"])
    assert any("flat is 1" in w for w in found["warnings"])
    for name, value in (
        ("bias", 0),
        ("dark_rate", 0),
        ("flat", 1),
        ("read_noise", READ),
        ("mask", 0),
    ):
        np.testing.assert_allclose(read(tmp_path, f"calibration.zarr/{name}"), value)


def test_few_bias_frames_give_one_read_noise_for_all_pixels(tmp_path: Path) -> None:
    camera = Camera(3, (64, 64))
    found = small(tmp_path, {"bias": (camera.take(4, 0), [0.0] * 4)})
    noise = read(tmp_path, "calibration.zarr/read_noise")
    assert np.ptp(noise) == 0
    assert noise[0, 0] == pytest.approx(found["read_noise_e"]["with_rounding"])
    assert noise[0, 0] == pytest.approx(READ, rel=0.05)


def test_twelve_bias_frames_give_no_pixel_a_read_noise_by_chance(tmp_path: Path) -> None:
    camera = Camera(3, (64, 64))
    small(tmp_path, {"bias": (camera.take(12, 0), [0.0] * 12)})
    noise = read(tmp_path, "calibration.zarr/read_noise")
    # Alone, variances of 11 degrees of freedom would scatter by 15 %, from a third to twice.
    assert noise.std() < 0.06 * READ
    assert noise.mean() == pytest.approx(READ, rel=0.02)


def test_darks_of_two_times_stand_in_for_bias(tmp_path: Path) -> None:
    camera = Camera(4, SMALL)
    darks = np.concatenate([camera.take(20, t) for t in (1.0, 10.0)])
    small(tmp_path, {"dark": (darks, [1.0] * 20 + [10.0] * 20)})
    rate = read(tmp_path, "calibration.zarr/dark_rate")
    assert rate.mean() == pytest.approx(camera.dark.mean(), rel=0.02)
    assert read(tmp_path, "calibration.zarr/bias").mean() == pytest.approx(BIAS, abs=1)


def test_darks_of_one_time_are_bias_and_dark_together(tmp_path: Path) -> None:
    camera = Camera(5, SMALL)
    kinds = {
        "dark": (camera.take(20, 10.0), [10.0] * 20),
        "fringes/a": (camera.fringes(3), [10.0] * 3),
    }
    found = small(tmp_path, kinds)
    assert any("is subtracted as bias and dark signal" in w for w in found["warnings"])
    both = (camera.bias + camera.dark * 10 / GAIN).mean()
    assert read(tmp_path, "calibration.zarr/bias").mean() == pytest.approx(both, rel=1e-3)
    assert not read(tmp_path, "calibration.zarr/dark_rate").any()


def test_a_gain_declared_wrongly_is_said_and_can_be_replaced(tmp_path: Path) -> None:
    camera = Camera(6, (96, 96))
    kinds = {
        "bias": (camera.take(12, 0), [0.0] * 12),
        "flat": (camera.take(12, 1, 3e4), [1.0] * 12),
        "fringes/a": (camera.fringes(2), [FRINGE_S] * 2),
    }
    found = small(tmp_path / "declared", kinds, gain_e_per_adu=1.2)
    assert any("photon transfer gives a gain of 0." in w for w in found["warnings"])
    assert found["gain_e_per_adu"]["used"] == 1.2
    # Electrons are counted with the gain that was measured.
    noise = found["read_noise_e"]
    assert noise["measured"] == pytest.approx(READ, abs=4 * noise["error"])
    assert noise["error"] < 0.02 * READ
    assert not any("read noise is" in w for w in found["warnings"])
    found = small(tmp_path / "measured", kinds, reduce.Config(gain="measured"), gain_e_per_adu=1.2)
    assert found["gain_e_per_adu"]["used"] == pytest.approx(GAIN, rel=0.02)
    assert found["sets"]["a"]["mean_e"] == pytest.approx(20_000, rel=0.1)


def test_a_gain_that_cannot_be_measured_is_refused(tmp_path: Path) -> None:
    camera = Camera(7, SMALL)
    kinds = {"bias": (camera.take(3, 0), [0.0] * 3)}
    with pytest.raises(InputError, match="gain: 'measured' needs two flat frames"):
        small(tmp_path, kinds, reduce.Config(gain="measured"))


def test_frames_of_different_sizes_are_refused(tmp_path: Path) -> None:
    kinds = {
        "bias": (Camera(8, SMALL).take(3, 0), [0.0] * 3),
        "flat": (Camera(8, (19, 24)).take(3, 1, 1e4), [1.0] * 3),
    }
    with pytest.raises(InputError, match="flat have 24 × 19 pixels, those of bias 23 × 19"):
        small(tmp_path, kinds, saturation_adu=4095)


def test_real_numbers_with_holes_are_reduced(tmp_path: Path) -> None:
    camera = Camera(9, SMALL)
    fringes = camera.fringes(6).astype(np.float32) - 480.25
    fringes[2, 3, 4] = np.nan
    fringes[:, 5, 6] = np.inf
    bias = camera.take(10, 0).astype(np.float32) - 480.25
    bias[:, 7, 8] = np.nan
    kinds = {"bias": (bias, [0.0] * 10), "fringes/a": (fringes, [FRINGE_S] * 6)}
    found = small(tmp_path, kinds, saturation_adu=None)
    mask = read(tmp_path, "reduced.zarr/a/mask")
    assert mask[3, 4] == PixelFlag.NO_DATA
    assert mask[7, 8] & PixelFlag.NO_DATA
    assert mask[5, 6] != 0
    codes = read(tmp_path, "reduced.zarr/a/signal")
    assert codes[2, 3, 4] == 65535
    assert (codes[:, 5, 6] == 65535).all()
    assert (codes[:, (mask == 0)] != 65535).all()
    assert found["quantisation"]["a"]["range_from"] == "frames"


def test_whole_numbers_in_files_of_real_ones_are_codes(tmp_path: Path) -> None:
    camera = Camera(12, SMALL)
    camera.read[:] = 0.6 * GAIN
    bias = camera.take(40, 0)
    found = [
        small(tmp_path / kind, {"bias": (bias.astype(kind), [0.0] * 40)}, saturation_adu=None)
        for kind in ("uint16", "float32")
    ]
    assert found[0]["read_noise_e"] == found[1]["read_noise_e"]
    assert found[0]["read_noise_e"]["before_rounding"] == pytest.approx(0.6 * GAIN, rel=0.03)


def test_a_range_that_needs_coarse_steps_is_measured_then_said(tmp_path: Path) -> None:
    camera = Camera(10, SMALL)
    camera.read[:] = 1.0
    kinds = {
        "bias": (camera.take(20, 0), [0.0] * 20),
        "fringes/a": (camera.fringes(3, peak=800), [FRINGE_S] * 3),
        "fringes/b": (camera.fringes(3), [FRINGE_S] * 3),
    }
    found = small(tmp_path, kinds, read_noise_e=1.0)
    faint, bright = (found["quantisation"][name] for name in "ab")
    assert faint["range_from"] == bright["range_from"] == "frames"
    assert faint["share_of_variance_dark"] < 1e-3
    assert bright["share_of_variance_dark"] > 1e-3
    assert [w for w in found["warnings"] if w.startswith("b: steps of")]
    assert not [w for w in found["warnings"] if w.startswith("a: steps of")]
    assert found["sets"]["b"]["lost_samples"] == 0


@pytest.mark.parametrize(("declared", "noticed"), [(None, True), (4095, False), (65535, True)])
def test_a_converter_that_ends_early_is_noticed(
    tmp_path: Path, declared: int | None, noticed: bool
) -> None:
    camera = Camera(11, SMALL)
    fringes = np.minimum(camera.fringes(4), 4095)
    kinds = {"bias": (camera.take(3, 0), [0.0] * 3), "fringes/a": (fringes, [FRINGE_S] * 4)}
    found = small(tmp_path, kinds, saturation_adu=declared)
    assert any("declare detector.saturation_adu" in w for w in found["warnings"]) == noticed


def test_saturated_flats_are_left_out(tmp_path: Path) -> None:
    camera = Camera(12, (64, 64))
    times = (0.1, 0.3, 0.6, 2.0)
    flats = np.concatenate([camera.take(6, t, 8e4) for t in times])
    kinds = {
        "bias": (camera.take(10, 0), [0.0] * 10),
        "flat": (flats, [t for t in times for _ in range(6)]),
    }
    found = small(tmp_path, kinds)
    levels = found["linearity"]["levels"]
    assert [level["deviation_percent"] is None for level in levels] == [False] * 3 + [True]
    assert found["linearity"]["max_deviation_percent"] < 0.2
    assert found["flags"]["good"] == 64 * 64
    gain = found["gain_e_per_adu"]
    assert gain["measured"] == pytest.approx(GAIN, abs=4 * gain["error"])


MEMORY = """
import sys
from pathlib import Path
from pixcal.engine import plan
from pixcal.engine.run import Runtime
from pixcal.stages.reduce import stage as reduce
plans, make_plan = [], plan.make_plan
plan.make_plan = lambda *a: plans.append(make_plan(*a)) or plans[-1]
reduce.run(Path(sys.argv[1]), reduce.Config(), Runtime(workers=2))
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(int(status["VmHWM"].split()[0]) * 1024, plans[0].total)
"""


@pytest.mark.long
def test_memory_stays_within_the_plan(tmp_path: Path) -> None:
    camera = Camera(14, (256, 256))
    times = [round(0.01 * n, 2) for n in range(1, 13)]
    kinds = {
        "bias": (camera.take(130, 0), [0.0] * 130),
        "flat": (
            np.concatenate([camera.take(4, t, 4e5) for t in times]),
            list(np.repeat(times, 4)),
        ),
        "fringes/a": (camera.fringes(200), [FRINGE_S] * 200),
    }
    make_ingest(tmp_path, {k: v[0] for k, v in kinds.items()}, {k: v[1] for k, v in kinds.items()})
    command = [sys.executable, "-c", MEMORY, str(tmp_path)]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    peak, planned = map(int, done.stdout.split())
    assert 0.3 * planned < peak < planned


# Real frames


ESIS_GAINS = (2.529, 2.508, 2.530, 2.512)
"""e-/DN of the four amplifiers of the ESIS 1 camera, from the LED pair below."""

ESIS_NOISES = (4.029, 3.868, 4.174, 4.243)
"""DN, from the pair without light."""


def esis_files() -> dict[str, tuple[Path, Path]]:
    """Raw frames of msfc-ccd (BSD-3-Clause): a diffuse LED, and the same without light."""
    found = importlib.util.find_spec("msfc_ccd")
    if found is None or found.origin is None:
        pytest.skip("msfc-ccd is not installed")
    folder = Path(found.origin).parent / "_data/led"
    return {
        kind: (folder / f"ESIS1_0{first}.fit.gz", folder / f"ESIS1_0{first + 1}.fit.gz")
        for kind, first in (("flat", 4803), ("dark", 4860))
    }


@pytest.mark.long
def test_real_frames_give_the_gain_and_noise_of_their_camera(tmp_path: Path) -> None:
    for kind, files in esis_files().items():
        (tmp_path / "acq" / kind).mkdir(parents=True)
        for file in files:
            shutil.copy(file, tmp_path / "acq" / kind)
    described = {
        "schema": SCHEMA,
        "detector": {"name": "ESIS 1", "pitch_um": 15, "gain_e_per_adu": 2.5, "read_noise_e": 10.0},
        "optics": {"wavelength_nm": 632.8, "distance_mm": 400.0},
        "frames": {"dark": ["dark/*"], "flat": ["flat/*"]},
    }
    (tmp_path / "acq/acquisition.yaml").write_text(yaml.safe_dump(described))
    ingest.run(tmp_path / "acq", tmp_path / "run", ingest.Config(), Runtime())
    reduce.run(tmp_path / "run", reduce.Config(), Runtime())
    found = report(tmp_path / "run")
    gain, noise = found["gain_e_per_adu"], found["read_noise_e"]
    # With what pixels on the diagonal and beyond may share unnoticed.
    assert gain["error"] < 0.006 * gain["measured"]
    # Its package looks at single pixels. At 64,000 e- their charge moves the boundaries of others
    # by 0.4 % of the variance a neighbour and less on the diagonal, which counts here.
    assert gain["neighbours"][:1] == [[0, 1]]
    assert [1, 0] in gain["neighbours"]
    assert 0.97 < gain["measured"] / np.mean(ESIS_GAINS) < 0.985
    assert noise["measured"] / gain["measured"] == pytest.approx(
        np.sqrt(np.mean(np.square(ESIS_NOISES))), 0.01
    )
    assert any("no frame has EXPTIME" in w for w in found["warnings"])
    # 50 blank and 2 overscan columns for each half, and some rows, see no light.
    assert 104 * 1040 < found["flags"]["dead"] < 1.2 * 104 * 1040


@pytest.mark.long
def test_the_numbers_of_the_real_camera_are_those_of_its_own_package() -> None:
    msfc_ccd = pytest.importorskip("msfc_ccd")
    named_arrays = pytest.importorskip("named_arrays")

    def taps(kind: str) -> Any:
        stack = named_arrays.ScalarArray(np.array(esis_files()[kind]), axes="time")
        return msfc_ccd.fits.open(stack).taps

    gains = msfc_ccd.gain.photon_transfer(taps("flat"), "time").outputs.ndarray.value
    noises = msfc_ccd.noise.readout(taps("dark"), "time").outputs.ndarray.value
    np.testing.assert_allclose(gains.ravel(), ESIS_GAINS, atol=1e-3)
    np.testing.assert_allclose(noises.ravel(), ESIS_NOISES, atol=1e-3)


def test_darks_of_one_exposure_time_alone_give_no_read_noise_by_itself(tmp_path: Path) -> None:
    camera = Camera(16, SMALL)
    found = small(tmp_path, {"dark": (camera.take(9, 10), [10.0] * 9)})
    noise = np.hypot(READ, np.sqrt(10 * camera.dark.mean()))
    assert found["read_noise_e"]["measured"] == pytest.approx(noise, rel=0.05)
    assert any("read noise contains the noise of the dark signal" in w for w in found["warnings"])
