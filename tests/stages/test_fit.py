"""From a reduced run to the offset maps."""

import json
import shutil

import numpy as np
import pytest
from astropy.io import fits

from pixcal.engine.run import Runtime
from pixcal.estimators.fringe_fit import fit_flags
from pixcal.model.errors import DamagedError, InputError
from pixcal.model.flags import PixelFlag
from pixcal.stages import fit
from pixcal.storage.cube import write_array
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.products import read_map

SETS = {"vertical": "delta_x", "horizontal": "delta_y"}


@pytest.fixture(scope="module")
def fitted(make_bench, write_reduced, tmp_path_factory):
    """A bench with everything free on a window of four uneven tiles, fitted once."""
    bench = make_bench(
        shape=(137, 150), frames=170, laser_noise=0.02, visibility_noise=0.03, response=0.02
    )
    run = write_reduced(bench, tmp_path_factory.mktemp("fit") / "run")
    fit.run(run, fit.Config(), Runtime())
    return bench, run, fit_json(run)


@pytest.fixture
def copied(fitted, tmp_path):
    """The run of `fitted` once more."""
    return shutil.copytree(fitted[1], tmp_path / "run")


@pytest.fixture
def unfitted(copied):
    """The same before the fit."""
    for stage in ("sweep", "fit", "products"):
        shutil.rmtree(copied / stage)
    return copied


def fit_json(run):
    return json.loads((run / "products" / "fit.json").read_text())


def error_of(bench, run, name, product="delta_fringe", **options):
    """Error of a set's map, and the errors and flags that it comes with."""
    data, sigma, flags, _ = read_map(run / "products" / f"{product}.fits")
    truth = bench.delta_y if name == "horizontal" else bench.delta_x
    return bench.without_modes(data - truth, name, **options), sigma, flags


def remask(run, name, mask, reseal):
    group = run / "reduce" / "reduced.zarr" / name
    shutil.rmtree(group / "mask")
    write_array(group / "mask", mask, dims=("y", "x"), chunks=(128, 128))
    reseal(run / "reduce")


@pytest.mark.parametrize("name", SETS)
def test_maps_are_at_the_bound_and_their_errors_honest(fitted, name):
    bench, run, result = fitted
    error, sigma, mask = error_of(bench, run, name, SETS[name])
    bound = bench.bound(name)
    # 20 550 pixels: the rms is known to half a percent.
    assert np.nanstd(error) / bound < 1.03
    assert 0.97 < np.nanstd(error / sigma) < 1.03
    assert result["sets"][name]["crb_median_px"] == pytest.approx(bound, rel=0.02)
    assert result["sets"][name]["sigma_median_px"] == pytest.approx(bound, rel=0.03)
    assert not mask.any()


def test_the_error_holds_no_fringes(fitted):
    """Power at the fringe frequency and twice it is what noise alone gives."""
    bench, run, _ = fitted
    error, *_ = error_of(bench, run, "vertical", "delta_x")
    k = bench.wave_number("vertical")
    x = np.arange(bench.shape[1])
    for harmonic in (1, 2):
        amplitude = np.abs((error * np.exp(-1j * harmonic * k * x)).mean())
        # 1e-3 chance of a noise amplitude above this.
        assert amplitude < 2.7 * error.std() / np.sqrt(error.size)


def test_fit_json_says_what_the_interface_promises(fitted):
    bench, _, result = fitted
    for name in SETS:
        facts = result["sets"][name]
        assert facts["model"] == "paraxial"
        assert facts["frames"] == bench.frames
        # The exact paths are longer than the distance by (B / 2 D)² / 2, some 1e-4.
        length = np.hypot(*bench.sets[name])
        exact = 5.0 * np.sqrt(1 + (length / 2 / bench.distance) ** 2)
        assert facts["interfringe_px"] == pytest.approx(exact, rel=1e-5)
        assert facts["chi2_reduced"] == pytest.approx(1.0, abs=0.01)
        assert facts["passes"] == 1.0
        assert facts["removed_modes"][:3] == ["1", "x", "y"]
        assert len(facts["removed_modes"]) == 7
        across = "ky" if name == "vertical" else "kx"
        geometry = facts["geometry"]
        assert abs(geometry[f"{across}_rad_per_px"]) < 4 * geometry[f"{across}_sigma"]


def test_products_follow_the_interface(fitted):
    _, run, result = fitted
    with fits.open(run / "products" / "delta_x.fits", checksum=True) as hdus:
        hdus.verify("exception")
        assert hdus[0].data.dtype == np.dtype(">f4")
        assert hdus["SIGMA"].data.shape == hdus["MASK"].data.shape == hdus[0].data.shape
        assert hdus["MASK"].data.dtype == np.uint8
        header = hdus[0].header
        assert header["INDIGEST"] == result["input"]
        assert header["PIXSIZE1"] == 4.4
        assert (header["MODEL"], header["MODELOPT"]) == ("paraxial", "auto")
        assert header["M1_4"] == "cos(psi)*iota/alpha"
        assert header["CREATOR"].startswith("pixcal")
    assert not (run / "products" / "delta_fringe.fits").exists()


def test_batches_average_to_the_whole(fitted):
    _, run, result = fitted
    group = run / "fit" / "fit.zarr" / "vertical"
    delta = ArrayReader(group / "delta").read()
    batches = ArrayReader(group / "batch_delta").read()
    sigma = ArrayReader(group / "batch_sigma").read()
    assert len(batches) == bench_batches(result)
    mean = (batches / sigma**2).sum(axis=0) / (1 / sigma**2).sum(axis=0)
    whole = ArrayReader(group / "sigma").read()
    # Each batch fits its own level and contrast: that costs the mean a part of its precision.
    assert np.std((mean - delta) / whole) < 0.5
    spread = batches.std(axis=0, ddof=1).mean()
    assert spread == pytest.approx(np.sqrt((sigma**2).mean()), rel=0.05)


def bench_batches(result):
    facts = result["sets"]["vertical"]
    return facts["frames"] // facts["batch_frames"]


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "runtime", [Runtime("sync"), Runtime("threads", workers=3), Runtime("processes", workers=2)]
)
def test_the_same_bits_however_it_runs(fitted, unfitted, runtime):
    fit.run(unfitted, fit.Config(), runtime)
    for name in SETS.values():
        paths = (folder / "products" / f"{name}.fits" for folder in (fitted[1], unfitted))
        with fits.open(next(paths)) as a, fits.open(next(paths)) as b:
            for n in range(3):
                np.testing.assert_array_equal(a[n].data, b[n].data)


def test_up_to_date_work_is_skipped_and_another_model_sweeps_no_more(copied):
    first = fit.run(copied, fit.Config(), Runtime())
    before = (copied / "fit" / "manifest.json").stat().st_mtime_ns
    assert fit.run(copied, fit.Config(), Runtime()) == first
    assert (copied / "fit" / "manifest.json").stat().st_mtime_ns == before
    (copied / "products" / "delta_x.fits").unlink()
    fit.run(copied, fit.Config(), Runtime())
    assert (copied / "products" / "delta_x.fits").exists()
    swept = (copied / "sweep" / "manifest.json").stat().st_mtime_ns
    other = fit.run(copied, fit.Config(model="hyperbolic"), Runtime())
    assert other.summary["sets"]["vertical"]["model"] == "hyperbolic"
    assert (copied / "sweep" / "manifest.json").stat().st_mtime_ns == swept


def test_products_that_were_removed_are_published_again(fitted, copied):
    first = fit.run(copied, fit.Config(), Runtime())
    shutil.rmtree(copied / "products")
    assert fit.run(copied, fit.Config(), Runtime()) == first
    for name in ("delta_x.fits", "delta_y.fits"):
        before, after = (run / "products" / name for run in (fitted[1], copied))
        assert after.read_bytes() == before.read_bytes()


def test_a_killed_fit_resumes_to_the_same_bits(fitted, unfitted, monkeypatch):
    from pixcal.stages.fit import sweep

    calls = []

    def breaking(*arguments):
        calls.append(arguments[-1])
        if len(calls) == 2:
            raise KeyboardInterrupt
        return real(*arguments)

    real = sweep._sweep_strip
    monkeypatch.setattr(sweep, "_sweep_strip", breaking)
    with pytest.raises(KeyboardInterrupt):
        fit.run(unfitted, fit.Config(), Runtime("sync"))
    assert not (unfitted / "sweep").exists()
    fit.run(unfitted, fit.Config(), Runtime("sync"))
    # A strip of tiles was noted as done before the kill; it is not done again.
    assert calls[0] not in calls[2:3]
    assert len(calls) == 2 + 1 + 2
    a, *_ = read_map(fitted[1] / "products" / "delta_y.fits")
    b, *_ = read_map(unfitted / "products" / "delta_y.fits")
    np.testing.assert_array_equal(a, b)


def test_a_damaged_chunk_is_named(unfitted):
    chunk = unfitted / "reduce" / "reduced.zarr" / "horizontal" / "signal" / "c" / "1" / "0" / "1"
    raw = bytearray(chunk.read_bytes())
    raw[len(raw) // 2] ^= 4
    chunk.write_bytes(raw)
    with pytest.raises(DamagedError, match="c/1/0/1"):
        fit.run(unfitted, fit.Config(), Runtime())


def test_masked_pixels_are_nan_with_their_flag(make_bench, write_reduced, reseal, tmp_path):
    bench = make_bench(shape=(40, 45), frames=100, sets={"only": (4.0, 4.0)}, interfringe=6.0)
    run = write_reduced(bench, tmp_path / "run")
    mask = np.zeros(bench.shape, np.uint8)
    mask[3, 4], mask[10, 11] = PixelFlag.HOT, PixelFlag.DEAD
    remask(run, "only", mask, reseal)
    fit.run(run, fit.Config(), Runtime())
    data, sigma, flags, header = read_map(run / "products" / "delta_fringe.fits")
    np.testing.assert_array_equal(flags, mask)
    np.testing.assert_array_equal(np.isnan(data), mask > 0)
    np.testing.assert_array_equal(np.isnan(sigma), mask > 0)
    assert header["NSETS"] == 1
    truth = (bench.delta_x + bench.delta_y) / np.sqrt(2)
    error = bench.without_modes(data - truth, "only")
    assert np.nanstd(error) / bench.bound("only", 31) < 1.07


def test_hyperbolic_fringes_are_seen_and_fitted(make_bench, write_reduced, reseal, tmp_path):
    """Fibres 18 mm aside and 10 mm farther than nominal, baseline 5 % longer."""
    bench = make_bench(
        shape=(120, 140),
        frames=150,
        distance=410.0,
        offset=(18.0, -18.0),
        sets={"vertical": (6.3, 0.0), "horizontal": (0.0, 6.3)},
        interfringe=None,
    )
    run = write_reduced(bench, tmp_path / "run")
    config = run / "ingest" / "acquisition.json"
    acquisition = json.loads(config.read_text())
    for number, nominal in enumerate(([6.0, 0.0], [0.0, 6.0])):
        acquisition["frames"]["fringes"][number]["baseline_mm"] = nominal
    config.write_text(json.dumps(acquisition))
    reseal(run / "ingest")
    fit.run(run, fit.Config(), Runtime())
    result = fit_json(run)
    for name, product in SETS.items():
        facts = result["sets"][name]
        assert facts["model"] == "hyperbolic"
        for axis, wanted in (("x", 18.0), ("y", -18.0)):
            middle = (bench.shape[1 if axis == "x" else 0] - 1) / 2 * bench.pitch
            value = facts["geometry"][f"centre_{axis}_mm"] - middle
            assert abs(value - wanted) < 4 * facts["geometry"][f"centre_{axis}_sigma_mm"]
        error, sigma, _ = error_of(bench, run, name, product, quadratic=True)
        assert np.nanstd(error) / bench.bound(name) < 1.03
        assert 0.97 < np.nanstd(error / sigma) < 1.03
    fit.run(run, fit.Config(model="paraxial"), Runtime())
    crest, *_ = error_of(bench, run, "vertical", "delta_x")
    assert np.nanstd(crest) / bench.bound("vertical") > 1.5


def test_three_sets_are_consistent(make_bench, write_reduced, tmp_path):
    bench = make_bench(
        shape=(50, 55),
        frames=120,
        sets={"a": (6.0, 0.0), "b": (0.0, 6.0), "c": (4.0, 4.0)},
        interfringe=None,
    )
    run = write_reduced(bench, tmp_path / "run")
    fit.run(run, fit.Config(), Runtime())
    result = fit_json(run)
    # The sets' own removed modes differ: what one set lost, another keeps; some chi-square is left.
    assert 0.8 < result["sets_chi2_reduced"] < 1.3
    _data, sigma, _, _ = read_map(run / "products" / "delta_x.fits")
    assert np.nanmedian(sigma) < result["sets"]["a"]["sigma_median_px"]


def test_no_fringes_is_an_input_error_that_names_the_set(make_bench, write_reduced, tmp_path):
    run = write_reduced(make_bench(frames=60, visibility=1e-9), tmp_path / "run")
    with pytest.raises(InputError, match="'vertical'"):
        fit.run(run, fit.Config(), Runtime())


def test_a_baseline_wrong_by_a_factor_is_pointed_out(make_bench, write_reduced, reseal, tmp_path):
    run = write_reduced(make_bench(frames=60), tmp_path / "run")
    file = run / "ingest" / "acquisition.json"
    listed = json.loads(file.read_text())
    listed["frames"]["fringes"][0]["baseline_mm"][0] /= 3
    file.write_text(json.dumps(listed))
    reseal(run / "ingest")
    fit.run(run, fit.Config(), Runtime())
    found = fit_json(run)["sets"]
    assert "period is 5 px, but baseline_mm" in found["vertical"]["period_note"]
    assert "give 15 px" in found["vertical"]["period_note"]
    assert found["horizontal"]["period_note"] == ""


def test_reduce_must_come_first(tmp_path):
    (tmp_path / "run").mkdir()
    with pytest.raises(InputError, match="pixcal reduce"):
        fit.run(tmp_path / "run", fit.Config(), Runtime())


def test_stitches_are_not_taken_for_hyperbolic_fringes(make_bench, write_reduced, tmp_path):
    """Steps of 4e-3 px between blocks have curvature of their own; the fibres are in the middle."""
    bench = make_bench(shape=(80, 96), frames=120, seed=3, interfringe=9.0)
    rng = np.random.default_rng(11)
    for offsets in (bench.delta_x, bench.delta_y):
        steps = np.kron(rng.normal(0, 4e-3, (2, 2)), np.ones((62, 52)))
        offsets += steps[20:100, 8:]
    run = write_reduced(bench, tmp_path / "run")
    result = fit.run(run, fit.Config(), Runtime()).summary
    for name in SETS:
        assert result["sets"][name]["model"] == "paraxial", result["sets"][name]["evidence"]


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("shape", "masked"),
    [
        ((137, 150), np.s_[:128, :128]),  # a whole tile
        ((137, 150), np.s_[2:128, :128]),  # all of a tile but two rows
        ((1, 150), np.s_[:, 3:5]),  # a window of one row
        ((150, 9), np.s_[3:5, :]),
    ],
)
def test_tiles_of_few_good_pixels(make_bench, write_reduced, reseal, tmp_path, shape, masked):
    name, baseline = ("vertical", (6.0, 0.0)) if shape[1] > 9 else ("horizontal", (0.0, 6.0))
    bench = make_bench(shape=shape, frames=80, sets={name: baseline})
    run = write_reduced(bench, tmp_path / "run")
    mask = np.zeros(shape, np.uint8)
    mask[masked] = PixelFlag.DEAD
    remask(run, name, mask, reseal)
    fit.run(run, fit.Config(), Runtime())
    error, sigma, flags = error_of(bench, run, name)
    np.testing.assert_array_equal(flags > 0, mask > 0)
    np.testing.assert_array_equal(np.isnan(error), mask > 0)
    assert 0.85 < np.nanstd(error / sigma) < 1.15
    result = fit_json(run)["sets"][name]
    assert result["pixels_masked"] == np.count_nonzero(mask)
    assert result["sigma_median_px"] == pytest.approx(np.nanmedian(sigma), rel=0.02)


@pytest.mark.parametrize("lost", ["two frames", "crests"])
def test_saturated_samples_cost_no_more_than_themselves(make_bench, write_reduced, tmp_path, lost):
    """Be it all samples of some frames, or a third of the samples of all."""
    bench = make_bench(shape=(40, 45), frames=120, sets={"only": (6.0, 0.0)})
    read_out = bench.read_out

    def saturated(electrons):
        codes = read_out(electrons)
        codes[[5, 70] if lost == "two frames" else codes > 36_000] = 65535
        return codes

    bench.read_out = saturated
    run = write_reduced(bench, tmp_path / "run")
    fit.run(run, fit.Config(), Runtime())
    error, sigma, flags = error_of(bench, run, "only")
    assert not flags.any()
    assert 0.93 < np.nanstd(error / sigma) < 1.07


def test_a_slow_scan_is_looked_at_all_along(make_bench, write_reduced, tmp_path, monkeypatch):
    """Little more than a turn in the whole run, and memory for one chunk of it."""
    from pixcal.stages.fit import scouting

    bench = make_bench(shape=(30, 37), frames=960, sets={"only": (6.0, 0.0)})
    scan = bench.scan
    bench.scan = lambda name: (*scan(name)[:2], np.linspace(0, 8.2, 960), scan(name)[3])
    run = write_reduced(bench, tmp_path / "run")
    monkeypatch.setattr(scouting, "PRIME_BYTES", 1)
    fit.run(run, fit.Config(), Runtime())
    error, sigma, _ = error_of(bench, run, "only")
    assert 0.93 < np.nanstd(error / sigma) < 1.07
    result = fit_json(run)
    assert result["sets"]["only"]["chi2_reduced"] == pytest.approx(1.0, abs=0.02)


def test_a_set_without_a_pixel_that_can_be_fitted_is_named(unfitted, monkeypatch):
    monkeypatch.setattr(fit_flags, "MAX_SIGMA_RAD", 0.0)
    with pytest.raises(InputError, match="'vertical': no pixel"):
        fit.run(unfitted, fit.Config(), Runtime())


def test_the_consistency_of_sets_counts_pixels_that_one_set_lacks(
    make_bench, write_reduced, reseal, tmp_path
):
    bench = make_bench(
        shape=(50, 55),
        frames=80,
        sets={"a": (6.0, 0.0), "b": (0.0, 6.0), "c": (4.0, 4.0)},
        interfringe=None,
    )
    run = write_reduced(bench, tmp_path / "run")
    mask = np.zeros(bench.shape, np.uint8)
    mask[5:] = PixelFlag.DEAD
    remask(run, "c", mask, reseal)
    fit.run(run, fit.Config(), Runtime())
    result = fit_json(run)
    # Nine pixels of ten have two sets, which cannot disagree.
    assert 0.5 < result["sets_chi2_reduced"] < 1.5
