"""Acquisitions: the contract's format, the closed forms, the same bits however they are made."""

import json
import shutil
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits
from astropy.time import Time

from pixcal.effects import parse_effects
from pixcal.engine.run import Runtime
from pixcal.kernels.scene import detector_maps
from pixcal.model.acquisition import load_acquisition
from pixcal.model.bench import load_bench
from pixcal.model.config import to_plain
from pixcal.model.errors import InputError, PlanError
from pixcal.simulation.exposure import Camera
from pixcal.simulation.recording import recordings
from pixcal.stages.simulate import Config, run, stage
from pixcal.stages.simulate import truth as simulated_truth
from pixcal.storage.artefact import artefact_key
from pixcal.storage.manifest import read_manifest

ROOT = Path(__file__).parents[2]
SYNC = Runtime(cluster="sync")

BENCH: dict[str, Any] = {
    "schema": "pixcal/bench/1",
    "seed": 918273645,
    "detector": {
        "name": "test chip",
        "seed": 564738291,
        "shape": [131, 45],
        "chip": [300, 400],
        "pitch_um": 4.4,
        "gain_e_per_adu": 0.8,
        "read_noise_e": 12.0,
        "full_well_e": 50000,
        "bias_adu": 300,
        "bias_pixel_rms_adu": 5.0,
        "bias_column_rms_adu": 3.0,
        "dark_e_s": 24.0,
        "hot_fraction": 0.01,
        "hot_rate_e_s": 5000.0,
        "dead_fraction": 0.002,
        "prnu_rms": 0.01,
        "delta_rms_px": 6.0e-3,
        "stitch_rms_px": 4.0e-3,
        "stitch_px": [37, 29],
    },
    "optics": {
        "wavelength_nm": 632.8,
        "distance_mm": 391.7,
        "nominal_distance_mm": 400.0,
        "beam_radius_mm": 35.0,
        "offset_mm": [7.31, -4.19],
        "power_ratio": 0.8,
        "visibility": 0.9,
    },
    "frames": {
        "start": "2026-03-02T23:59:50",
        "exptime_s": 0.02,
        "period_s": 0.14,
        "per_file": 7,
        "compress": ["dark", "horizontal"],
        "bias": 11,
        "darks": [{"exptime_s": 0.5, "count": 3}, {"exptime_s": 2.0, "count": 8}],
        "flat_rate_e_s": 1.0e6,
        "flats": [{"exptime_s": 0.01, "count": 4}, {"exptime_s": 0.03, "count": 2}],
        "fringes": [
            {"name": "vertical", "baseline_mm": [6.0, 0.0], "count": 23, "peak_e": 40000},
            {"name": "horizontal", "baseline_mm": [0.5, 5.0], "count": 9, "peak_e": 30000},
        ],
    },
    "effects": {"hyperbolic_fringes": {"foot_mm": None}, "intensity_noise": {"rms": 0.02}},
}


BENCH_SETS = ("vertical", "horizontal")


def changed(**places: Any) -> dict[str, Any]:
    """The bench with values at dotted places (``detector__prnu_rms=0``) replaced."""
    bench = json.loads(json.dumps(BENCH))
    for place, value in places.items():
        *path, key = place.split("__")
        section = bench
        for step in path:
            section = section[step]
        section[key] = value
    return bench


def written(folder: Path, bench: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "bench.yaml"
    path.write_text(yaml.safe_dump(bench))
    return path


def simulated(folder: Path, runtime: Runtime = SYNC, **places: Any) -> Path:
    run(written(folder, changed(**places)), folder / "acq", Config(), runtime)
    return folder / "acq"


def contents(folder: Path) -> dict[str, bytes]:
    files = (p for p in folder.rglob("*") if p.is_file())
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in files}


def frames(acq: Path, name: str) -> np.ndarray:
    """All frames of a kind or set, read by astropy."""
    cubes = []
    for file in sorted((acq / name).iterdir()):
        with fits.open(file) as hdus:
            data = hdus[-1].data
            cubes.append(np.array(data.reshape(-1, *data.shape[-2:])))
    return np.concatenate(cubes)


def truth_map(acq: Path, name: str) -> np.ndarray:
    with fits.open(acq.with_name("acq-truth") / f"{name}.fits") as hdus:
        return np.array(hdus[0].data)


@pytest.fixture(scope="module")
def acq(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("whole"))


def test_the_acquisition_is_the_one_that_was_described(acq: Path) -> None:
    found = load_acquisition(acq)
    assert found.detector.gain_e_per_adu == 0.8
    assert found.detector.saturation_adu == 65535
    assert found.optics.distance_mm == 400.0
    sets = {s.name: s for s in found.frames.fringes}
    assert sets["horizontal"].baseline_mm == (0.5, 5.0)
    globs = [*found.frames.bias, *found.frames.dark, *found.frames.flat]
    globs += [g for s in sets.values() for g in s.files]
    listed = {p for g in globs for p in acq.glob(g)}
    there = set(acq.rglob("*.fits*"))
    assert listed == there
    counts = {n: len(frames(acq, n)) for n in ("bias", "dark", "flat", "vertical", "horizontal")}
    assert counts == {"bias": 11, "dark": 11, "flat": 6, "vertical": 23, "horizontal": 9}


def test_frames_are_unsigned_and_stamped(acq: Path) -> None:
    stamps = []
    for name in ("bias", "dark", "flat", "vertical", "horizontal"):
        for file in sorted((acq / name).iterdir()):
            with fits.open(file) as hdus:
                hdus.verify("exception")
                header, data = hdus[-1].header, hdus[-1].data
            assert data.dtype == np.uint16
            assert data.shape[1:] == (131, 45)
            assert data.shape[0] <= 7
            mjd = Time(header["DATE-OBS"], scale="utc").mjd
            assert header["MJD-OBS"] == pytest.approx(mjd, abs=1e-10)
            assert header["CCD-TEMP"] == 35.0
            stamps.append((header["MJD-OBS"], len(data), header["CADENCE"], header["EXPTIME"]))
    clock = stamps[0][0]
    assert clock == pytest.approx(Time("2026-03-02T23:59:50").mjd, abs=1e-10)
    for mjd, planes, period, exptime in stamps:
        assert mjd == pytest.approx(clock, abs=1e-9)
        assert period == max(0.14, exptime)
        clock = mjd + planes * period / 86400


def test_one_frame_a_file_is_two_dimensional(tmp_path: Path, acq: Path) -> None:
    single = simulated(tmp_path, frames__per_file=1, frames__compress=[])
    files = sorted((single / "vertical").iterdir())
    assert len(files) == 23
    with fits.open(files[0]) as hdus:
        assert hdus[0].data.shape == (131, 45)
    for name in ("bias", "dark", "flat", "vertical", "horizontal"):
        assert np.array_equal(frames(single, name), frames(acq, name)), name


@pytest.mark.parametrize(
    "runtime",
    [Runtime(workers=1), Runtime(workers=3), Runtime("processes", workers=2)],
    ids=["one thread", "three threads", "processes"],
)
def test_the_bits_do_not_depend_on_who_does_the_work(
    runtime: Runtime, tmp_path: Path, acq: Path
) -> None:
    again = simulated(tmp_path, runtime)
    assert contents(again) == contents(acq)
    assert contents(again.with_name("acq-truth")) == contents(acq.with_name("acq-truth"))


def test_the_bits_do_not_depend_on_how_the_work_is_cut(
    tmp_path: Path, acq: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def odd_rows(bench: Any) -> list[tuple[int, int]]:
        return [(0, 5), (5, 70), (70, 131)]

    monkeypatch.setattr(stage, "FRAMES_PER_TASK", 5)
    monkeypatch.setattr(stage, "row_blocks", odd_rows)
    monkeypatch.setattr(simulated_truth, "row_blocks", odd_rows)
    assert contents(simulated(tmp_path)) == contents(acq)


def test_another_seed_is_another_noise_on_the_same_chip(tmp_path: Path, acq: Path) -> None:
    other = simulated(tmp_path, seed=1)
    assert np.array_equal(truth_map(other, "delta_x"), truth_map(acq, "delta_x"))
    assert not np.array_equal(frames(other, "bias"), frames(acq, "bias"))
    a, b = (truth(x)["vertical"]["phi"] for x in (other, acq))
    assert not np.allclose(a, b)


def truth(acq: Path) -> dict[str, Any]:
    sets: dict[str, Any] = json.loads((acq.with_name("acq-truth") / "truth.json").read_text())
    return sets["sets"]


def expected_signal(acq: Path, name: str) -> np.ndarray:
    """Mean electrons from light in each frame, out of the truth alone (paper, eq. 2 and 3)."""
    t = truth(acq)[name]
    o = BENCH["optics"]
    p = 4.4e-3
    y, x = np.mgrid[:131, :45].astype(np.longdouble)
    centre = np.array(t["centre_px"]) * p
    half = np.array(t["baseline_mm"], np.longdouble) / 2
    at_x, at_y = (x + truth_map(acq, "delta_x")) * p, (y + truth_map(acq, "delta_y")) * p

    def path(side: int) -> Any:
        return np.sqrt(
            (at_x - centre[0] - side * half[0]) ** 2
            + (at_y - centre[1] - side * half[1]) ** 2
            + (t["distance_mm"] + side * half[2]) ** 2
        )

    def beam(side: int) -> Any:
        fx, fy = x * p - centre[0] - side * half[0], y * p - centre[1] - side * half[1]
        return np.exp(-2 * (fx**2 + fy**2) / o["beam_radius_mm"] ** 2)

    psi = 2 * np.pi / 632.8e-6 * (path(-1) - path(1))
    a, b = beam(-1), o["power_ratio"] * beam(1)
    amplitude = 2 * o["visibility"] * np.sqrt(a * b)
    peak = next(s["peak_e"] for s in BENCH["frames"]["fringes"] if s["name"] == name)
    scale = peak / (a + b + amplitude).max() * truth_map(acq, "response")
    levels = zip(t["B"], t["A"], t["phi"], strict=True)
    signal = [scale * (lb * (a + b) + la * amplitude * np.sin(psi + f)) for lb, la, f in levels]
    return np.array(signal, float)


@pytest.mark.parametrize("name", ["vertical", "horizontal"])
def test_without_noise_every_sample_is_the_closed_form(tmp_path: Path, name: str) -> None:
    quiet = simulated(tmp_path, shot_noise=False, detector__read_noise_e=0.0)
    electrons = expected_signal(quiet, name) + truth_map(quiet, "dark_rate") * 0.02
    adu = np.minimum(electrons, 50000) / 0.8 + truth_map(quiet, "bias")
    assert np.abs(frames(quiet, name) - adu).max() < 0.5 + 0.02


def test_the_noise_is_that_of_photons_and_of_the_read_out(acq: Path) -> None:
    electrons = expected_signal(acq, "vertical") + truth_map(acq, "dark_rate") * 0.02
    residual = (frames(acq, "vertical") - truth_map(acq, "bias")) * 0.8 - electrons
    # Gain squared over 12: the converter's steps.
    variance = electrons + 12.0**2 + 0.8**2 / 12
    below_full_well = electrons + 6 * np.sqrt(electrons + 1) < 50000
    normal = (residual / np.sqrt(variance))[below_full_well]
    assert abs(normal.mean()) < 4 / np.sqrt(normal.size)
    assert normal.var() == pytest.approx(1, abs=4 * np.sqrt(2 / normal.size))


def test_no_two_sequences_share_their_noise(acq: Path) -> None:
    def residual(name: str, first: int) -> np.ndarray:
        cube = frames(acq, name)[first : first + 3].astype(float)
        if name in BENCH_SETS:
            light = expected_signal(acq, name)[:3]
            return (cube * 0.8 - light) / np.sqrt(light + 144)
        return (cube - cube.mean(axis=0)) / 15

    kinds = [("bias", 0), ("dark", 0), ("dark", 3), ("flat", 0), ("vertical", 0), ("horizontal", 0)]
    good = truth_map(acq, "mask") == 0
    noise = {kind: residual(*kind)[:, good] for kind in kinds}
    for one, other in combinations(kinds, 2):
        assert abs(np.corrcoef(noise[one].ravel(), noise[other].ravel())[0, 1]) < 0.05, (one, other)


def test_the_photon_transfer_has_the_gain_and_the_read_noise(tmp_path: Path) -> None:
    times = [0.002, 0.008, 0.014, 0.02, 0.026, 0.032]
    flat = simulated(
        tmp_path,
        frames__flats=[{"exptime_s": t, "count": 16} for t in times],
        frames__fringes=[],
        frames__compress=[],
        frames__per_file=16,
        detector__dead_fraction=0.0,
        detector__hot_fraction=0.0,
    )
    cube = frames(flat, "flat").reshape(len(times), 16, 131, 45).astype(float)
    signal = cube.mean(axis=(1, 2, 3)) - truth_map(flat, "bias").mean()
    variance = cube.var(axis=1, ddof=1).mean(axis=(1, 2))
    assert np.allclose(signal * 0.8, np.array(times) * 1e6, rtol=2e-3)
    slope, offset = np.polyfit(signal, variance, 1, w=1 / variance)
    assert slope == pytest.approx(1 / 0.8, rel=0.01)
    assert np.sqrt(offset) * 0.8 == pytest.approx(12, rel=0.2)
    bias = frames(flat, "bias").astype(float)
    assert bias.var(axis=0, ddof=1).mean() == pytest.approx((12 / 0.8) ** 2 + 1 / 12, rel=0.02)
    assert np.allclose(bias.mean(axis=0), truth_map(flat, "bias"), atol=6 * 15 / np.sqrt(11))


def test_hot_and_dead_pixels_are_where_the_truth_says(acq: Path) -> None:
    mask = truth_map(acq, "mask")
    dark = frames(acq, "dark")[3:].mean(axis=0) - truth_map(acq, "bias")
    assert (dark[mask == 1] > 2500 * 2 / 0.8 * 0.9).all()
    assert (dark[mask != 1] < 1000).all()
    flat = frames(acq, "flat")[4:].mean(axis=0) - truth_map(acq, "bias")
    assert (flat[mask == 2] < 1000).all()
    assert (mask == 1).any()
    assert (mask == 2).any()


def test_samples_stop_at_saturation_and_charge_at_the_full_well(tmp_path: Path) -> None:
    clipped = simulated(
        tmp_path / "adc", detector__saturation_adu=20000, detector__full_well_e=None
    )
    bright = expected_signal(clipped, "vertical") / 0.8 + 300
    samples = frames(clipped, "vertical")
    assert samples.max() == 20000
    assert (samples[bright > 22000] == 20000).all()
    assert load_acquisition(clipped).detector.saturation_adu == 20000
    full = simulated(tmp_path / "well", detector__full_well_e=20000, detector__read_noise_e=0.0)
    level = (frames(full, "vertical") - truth_map(full, "bias")) * 0.8
    assert np.abs(level[bright > 22000 / 0.8 + 300] - 20000).max() < 0.8


def test_the_truth_stays_out_of_the_acquisition(acq: Path) -> None:
    kept = {p.name for p in acq.with_name("acq-truth").iterdir()}
    maps = {"delta_x", "delta_y", "response", "bias", "dark_rate", "mask"}
    assert kept == {f"{m}.fits" for m in maps} | {"truth.json", "bench.yaml", "manifest.json"}
    known = {
        "DATE-OBS",
        "MJD-OBS",
        "TIMESYS",
        "EXPTIME",
        "CADENCE",
        "CCD-TEMP",
        "IMAGETYP",
        "OBJECT",
        "INSTRUME",
        "ORIGIN",
        "SIMPLE",
        "BITPIX",
        "NAXIS",
        "NAXIS1",
        "NAXIS2",
        "NAXIS3",
        "BSCALE",
        "BZERO",
        "XTENSION",
        "PCOUNT",
        "GCOUNT",
        "EXTNAME",
    }
    secrets = [b"918273645", b"564738291", b"391.7", b"7.31", b"4.19", b"rms", b"delta"]
    for name, data in contents(acq).items():
        if ".fits" in name:
            with fits.open(acq / name) as hdus:
                assert set(hdus[-1].header) <= known, name
        else:
            assert not [s for s in secrets if s in data], name


def test_the_truth_goes_where_it_is_sent(tmp_path: Path) -> None:
    bench = written(tmp_path, BENCH)
    run(bench, tmp_path / "acq", Config(truth=tmp_path / "elsewhere/truth"), SYNC)
    assert (tmp_path / "elsewhere/truth/delta_x.fits").exists()
    assert not (tmp_path / "acq-truth").exists()
    for inside in (tmp_path / "acq/truth", tmp_path / "acq", tmp_path):
        with pytest.raises(InputError, match="--truth"):
            run(bench, tmp_path / "acq", Config(truth=inside), SYNC)


def test_what_is_up_to_date_is_left_and_what_is_not_is_made_again(tmp_path: Path) -> None:
    first = simulated(tmp_path)
    whole, stamp = contents(first), (first / "acquisition.yaml").stat().st_mtime_ns
    simulated(tmp_path)
    assert (first / "acquisition.yaml").stat().st_mtime_ns == stamp
    (first / "vertical/vertical-00001.fits").unlink()
    simulated(tmp_path)
    assert contents(first) == whole
    shutil.rmtree(tmp_path / "acq-truth")
    simulated(tmp_path)
    assert (tmp_path / "acq-truth/delta_y.fits").exists()
    simulated(tmp_path, seed=2)
    assert set(contents(first)) == set(whole)
    assert contents(first) != whole
    assert {p.name for p in tmp_path.iterdir()} == {"acq", "acq-truth", "bench.yaml"}


def test_what_others_put_there_is_not_touched(tmp_path: Path) -> None:
    (tmp_path / "acq").mkdir()
    simulated(tmp_path)  # an empty directory is welcome
    (tmp_path / "acq/notes.txt").write_text("mine")
    with pytest.raises(InputError, match=r"notes\.txt"):
        simulated(tmp_path, seed=2)
    (tmp_path / "real").mkdir()
    (tmp_path / "real/frame.fits").write_text("mine")
    bench = written(tmp_path, BENCH)
    for out, config, option in (
        ("real", Config(), "--out"),
        ("bench.yaml", Config(), "--out"),
        ("new", Config(truth=tmp_path / "real"), "--truth"),
    ):
        with pytest.raises(InputError, match=option):
            run(bench, tmp_path / out, config, SYNC)
    assert (tmp_path / "real/frame.fits").read_text() == "mine"
    assert (tmp_path / "acq/notes.txt").read_text() == "mine"


def test_cut_short_it_leaves_nothing_that_looks_whole(
    tmp_path: Path, acq: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(*_: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(stage, "call", killed)
        with pytest.raises(KeyboardInterrupt):
            simulated(tmp_path)
    assert {p.name for p in tmp_path.iterdir()} == {"bench.yaml"}
    # What a kill leaves behind, where nothing can be tidied up, is in nobody's way.
    (tmp_path / ".acq.partial/made/vertical").mkdir(parents=True)
    (tmp_path / ".acq.partial/made/vertical/vertical-00000.fits").write_text("half")
    assert contents(simulated(tmp_path)) == contents(acq)


def test_any_printable_name_fits_the_header(tmp_path: Path) -> None:
    named = simulated(
        tmp_path, detector__name="détecteur n° 1", frames__fringes=[], frames__compress=[]
    )
    assert load_acquisition(named).detector.name == "détecteur n° 1"
    with fits.open(named / "bias/bias-00000.fits") as hdus:
        assert hdus[0].header["INSTRUME"] == "d?tecteur n? 1"


def test_too_little_memory_is_refused_with_both_numbers(tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=r"simulate needs \d+ MiB, but the limit is 64 MiB"):
        simulated(tmp_path, Runtime(memory=64 << 20))
    assert not (tmp_path / "acq").exists()


@pytest.mark.parametrize("set_number", [0, 1])
def test_the_sample_is_what_its_bench_gives(set_number: int) -> None:
    bench = load_bench(ROOT / "configs/demo.yaml")
    sample = ROOT / "data_samples/demo"
    recording = [r for r in recordings(bench) if r.kind == "fringes"][set_number]
    rows = (59, 77)
    maps = detector_maps(bench.detector, rows)
    recorded = frames(sample, recording.folder)
    assert recorded.shape == (recording.count, *bench.detector.shape)
    effects = parse_effects(bench.effects, "bench")
    for frame, samples in Camera(bench, rows, effects).expose(recording, range(58, 63)):
        assert np.array_equal(samples, recorded[frame, rows[0] : rows[1]])
    with fits.open(ROOT / "data_samples/demo-truth/delta_x.fits") as hdus:
        assert np.array_equal(hdus[0].data[rows[0] : rows[1]], maps.delta_x)


@pytest.mark.parametrize(
    ("name", "stage"), [("demo", "simulate"), ("demo-truth", "simulate-truth")]
)
def test_the_sample_is_whole_and_belongs_to_its_bench(name: str, stage: str) -> None:
    bench = to_plain(load_bench(ROOT / "configs/demo.yaml"))
    manifest = read_manifest(ROOT / "data_samples" / name)
    assert manifest is not None
    assert manifest.stage == stage
    mend = "run: pixcal simulate configs/demo.yaml --out data_samples/demo"
    assert manifest.key == artefact_key("simulate", 1, bench, {}), mend
    sizes = {n: len(data) for n, data in contents(ROOT / "data_samples" / name).items()}
    del sizes["manifest.json"]
    assert sizes == manifest.summary["files"]
