"""A simulated camera's data sheet comes out of its frames, without optics or fringes."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from astropy.io import fits
from click.testing import CliRunner

import pixcal
from pixcal.estimators.detector.pair_noise import dark_pair_sums, shared_by_lines
from pixcal.kernels.photon_transfer import BLOCK
from pixcal.stages.reduce.detector_warnings import _declared_gain_warnings
from pixcal.stages.reduce.read_noise import of_few_lines
from pixcal_cli.main import cli

SHAPE = (140, 150)
GAIN, READ, FULL, DARK = 2.5, 6.0, 9000.0, 3.0
DSNU, COLUMN, PRNU = 4.0, 1.5, 1.2
"""e- and e- of whole columns; per cent."""


def write_camera(
    folder: Path, levels: tuple[float, ...], seed: int = 8, overscan: int = 0, full: Any = FULL
) -> Path:
    """A 12-bit camera: bias, two series of darks at -10 C, a ladder of flats."""
    rng = np.random.default_rng(seed)
    offset = 200.3 * GAIN + DSNU * rng.standard_normal(SHAPE)
    offset += COLUMN * rng.standard_normal((1, SHAPE[1]))
    response = 1 + PRNU / 100 * rng.standard_normal(SHAPE)
    response[:, :overscan] = 0

    def expose(name: str, count: int, electrons: float, seconds: float) -> None:
        charge = rng.poisson(electrons * response + DARK * seconds, (count, *SHAPE))
        read = np.minimum(charge, full) + offset + READ * rng.standard_normal((count, *SHAPE))
        samples = np.clip(np.rint(read / GAIN), 0, 4095).astype(np.uint16)
        header = fits.Header({"EXPTIME": seconds, "CCD-TEMP": -10.0})
        fits.writeto(folder / f"{name}.fits", samples, header)

    folder.mkdir()
    expose("bias", 40, 0, 0.0)
    for n, seconds in enumerate((10.0, 40.0)):
        expose(f"dark{n}", 10, 0, seconds)
    for n, level in enumerate(levels):
        expose(f"flat{n}", 8, level, level / 1e5)
    listed = {
        "schema": "pixcal/acquisition/1",
        "detector": {"name": "CAM", "pitch_um": 5.5, "gain_e_per_adu": 2.5, "read_noise_e": 6.0},
        "frames": {"bias": ["bias.fits"], "dark": ["dark*.fits"], "flat": ["flat*.fits"]},
    }
    (folder / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    return folder


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> pixcal.Run:
    folder = tmp_path_factory.mktemp("camera")
    acquisition = write_camera(folder / "acq", (500, 1500, 3000, 4500, 6000))
    return pixcal.run(acquisition, folder / "run", diagnosed=False)


def test_every_figure_is_right_within_its_error(run: pixcal.Run) -> None:
    found: dict[str, Any] = run.reduction["figures_of_merit"]
    truth = {
        "conversion_gain": GAIN,
        "read_noise": READ,
        "read_noise_with_rounding": np.hypot(READ, GAIN / np.sqrt(12)),
        "dsnu": np.hypot(DSNU, COLUMN),
        "dsnu_column": COLUMN,
        "dsnu_pixel": DSNU,
        "prnu": PRNU,
        "dark_current": DARK,
    }
    for name, true in truth.items():
        value, error = found[name]["value"], found[name]["error"]
        # Eight draws: the chance that any leaves four errors is 5e-4.
        assert abs(value - true) < 4 * error, name
        assert error < 0.1 * true, name
    assert found["dsnu_row"]["value"] < 4 * found["dsnu_row"]["error"]
    assert found["dark_current"]["note"] == "at -10.0 °C"
    assert "lower limit" in found["full_well"]["note"]
    assert found["full_well"]["value"] == pytest.approx(6000, rel=0.02)
    assert found["full_well"]["error"] is None


def test_a_ladder_that_saturates_gives_the_full_well(tmp_path: Path) -> None:
    ladder = (500, 2500, 4500, 6500, 8000, 8600, 9500, 11000)
    acquisition = write_camera(tmp_path / "acq", ladder)
    reduced = pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "run"))
    gain = reduced.reduction["figures_of_merit"]["conversion_gain"]
    assert abs(gain["value"] - GAIN) < 4 * gain["error"] < 0.04 * GAIN
    assert reduced.reduction["linearity"]["max_deviation_percent"] < 0.5
    found = reduced.reduction["figures_of_merit"]["saturation"]
    assert found["note"] == ""
    assert abs(found["value"] - FULL / GAIN) < 1.1 * found["error"] < 0.05 * FULL / GAIN


def test_wells_that_differ_are_known_to_half_a_step_of_the_ladder(tmp_path: Path) -> None:
    wells = np.where(np.arange(SHAPE[1]) < 75, 8300, 9700)
    acquisition = write_camera(tmp_path / "acq", (500, 2500, 5000, 8000, 11000), full=wells)
    reduced = pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "run"))
    found = reduced.reduction["figures_of_merit"]["saturation"]
    assert abs(found["value"] - wells.mean() / GAIN) < 2 * found["error"]


def test_noise_of_half_a_code_comes_from_pairs_of_many_darks(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    offset = 4 + 0.15 * rng.standard_normal(SHAPE)
    (tmp_path / "acq").mkdir()
    noise, gain, seconds = 0.5, 40.0, np.linspace(0.001, 0.02, 16)
    for kind, light in (("dark", 0.0), ("flat", 4e5)):
        for n, time in enumerate(seconds):
            charge = rng.poisson(light * time, (2, *SHAPE)) / gain
            read = offset + noise * rng.standard_normal((2, *SHAPE))
            samples = np.rint(charge + read).clip(0, 255).astype(np.uint8)
            header = fits.Header({"EXPTIME": time})
            fits.writeto(tmp_path / "acq" / f"{kind}{n}.fits", samples, header)
    listed = {
        "schema": "pixcal/acquisition/1",
        "detector": {"pitch_um": 5.5, "read_noise_e": 20.0},
        "frames": {kind: [f"{kind}*.fits"] for kind in ("dark", "flat")},
    }
    (tmp_path / "acq" / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    reduced = pixcal.reduce(pixcal.ingest(tmp_path / "acq", tmp_path / "run")).reduction
    figures = reduced["figures_of_merit"]
    value, error = (figures["read_noise"][key] for key in ("value", "error"))
    gain = figures["conversion_gain"]["value"]
    assert abs(value / gain - noise) < 3 * error / gain < 0.05 * noise


def test_few_levels_one_of_full_pixels_give_the_gain_beside_an_overscan(tmp_path: Path) -> None:
    acquisition = write_camera(tmp_path / "acq", (500, 6000, 11000), overscan=14)
    reduced = pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "run"))
    gain = reduced.reduction["figures_of_merit"]["conversion_gain"]
    # Two levels leave one degree of freedom, whose scatter is in the error; of so few samples the
    # noise that neighbours may share is known to 0.8 %.
    assert abs(gain["value"] - GAIN) < 3 * gain["error"] < 0.06 * GAIN
    assert reduced.reduction["gain_e_per_adu"]["chi2_reduced"] < 10
    mask = np.asarray(reduced.detector["mask"])
    assert (mask[:, :14] != 0).all()
    assert (mask[:, 14:] != 0).mean() < 1e-4


def camera_run(
    folder: Path, frames: dict[str, Any], seed: int = 4, gain: Any = GAIN
) -> dict[str, Any]:
    """Figures of frames (t, y, x) of 100 ADU bias, given light (e-), number and what each adds."""
    rng = np.random.default_rng(seed)
    response = 1 + PRNU / 100 * rng.standard_normal(SHAPE)
    (folder / "acq").mkdir(parents=True)
    for kind, (light, count, step, row) in frames.items():
        signal = rng.poisson(light * response, (count, *SHAPE)) + READ * rng.standard_normal(
            (count, *SHAPE)
        )
        signal += row * rng.standard_normal((count, SHAPE[0], 1))
        samples = step * np.rint((1600 + signal / gain) / step)
        header = fits.Header({"EXPTIME": float(light > 0)})
        fits.writeto(folder / "acq" / f"{kind}.fits", samples.astype(np.uint16), header)
    listed = {
        "schema": "pixcal/acquisition/1",
        "detector": {"name": "CAM", "pitch_um": 5.5, "gain_e_per_adu": GAIN, "read_noise_e": READ},
        "frames": {kind.rstrip("0"): [f"{kind}.fits"] for kind in frames},
    }
    (folder / "acq" / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    run = pixcal.run(folder / "acq", folder / "run", diagnosed=False)
    found: dict[str, Any] = run.reduction["figures_of_merit"]
    return found


def test_one_bias_frame_is_taken_off_the_flats(tmp_path: Path) -> None:
    prnu = camera_run(tmp_path, {"bias": (0, 1, 1, 0), "flat": (30000, 8, 1, 0)})["prnu"]
    assert abs(prnu["value"] - PRNU) < 4 * prnu["error"]


def test_without_bias_no_saturation_is_claimed(tmp_path: Path) -> None:
    found = camera_run(tmp_path, {"flat": (30000, 4, 1, 0)})
    assert not {"saturation", "full_well", "snr_max", "dynamic_range"} & set(found)


def test_the_step_of_the_codes_is_found(tmp_path: Path) -> None:
    found = camera_run(tmp_path, {"bias": (0, 60, 4, 0), "flat": (30000, 8, 4, 0)})
    rounding = 4 * GAIN / np.sqrt(12)
    for name, true in (
        ("read_noise", READ),
        ("read_noise_with_rounding", np.hypot(READ, rounding)),
    ):
        assert abs(found[name]["value"] - true) < 4 * found[name]["error"], name
    assert "steps of 4 ADU" in found["read_noise_with_rounding"]["note"]


def test_what_frames_without_exposure_times_do_not_tell_is_said(tmp_path: Path) -> None:
    rng, shape = np.random.default_rng(6), (64, 64)
    lights = {"bias": [0.0] * 8, "dark": [3.0] * 6 + [90.0] * 6, "flat": [400, 900, 2000, 5000]}
    for kind, levels in lights.items():
        mean = np.repeat(levels, 2 if kind == "flat" else 1)[:, None, None]
        signal = rng.poisson(np.broadcast_to(mean, (len(mean), *shape))) + READ * (
            rng.standard_normal((len(mean), *shape))
        )
        samples = 16 * np.rint(100 + signal / GAIN)
        fits.writeto(tmp_path / f"{kind}.fits", samples.astype(np.uint16))
    listed = {
        "schema": "pixcal/acquisition/1",
        "detector": {"name": "CAM", "pitch_um": 5.5, "gain_e_per_adu": GAIN, "read_noise_e": READ},
        "frames": {kind: [f"{kind}.fits"] for kind in lights},
    }
    (tmp_path / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    found = pixcal.reduce(pixcal.ingest(tmp_path, tmp_path / "run")).reduction
    gain = found["gain_e_per_adu"]
    assert abs(gain["measured"] - GAIN / 16) < 4 * gain["error"]
    for sentence in ("of several levels", "linearity is not measured", "divided by 16"):
        assert any(sentence in warning for warning in found["warnings"]), sentence
    assert "dark_current" not in found["figures_of_merit"]


def test_noise_of_rows_is_told_from_that_of_pixels(tmp_path: Path) -> None:
    noise = camera_run(tmp_path, {"bias": (0, 40, 1, 2.0), "flat": (30000, 8, 1, 2.0)})["row_noise"]
    assert abs(noise["value"] - 2.0) < 4 * noise["error"] < 0.4


def test_error_of_read_noise_counts_that_lines_are_few() -> None:
    """Noise of rows as strong as that of pixels scatters by its error from camera to camera."""
    rng, shape = np.random.default_rng(9), (64, 96)
    scaled = []
    for _ in range(60):
        dark = 4 * rng.standard_normal((20, *shape)) + 4 * rng.standard_normal((20, shape[0], 1))
        sums = dark_pair_sums(dark.astype(np.float32), 4.0, 0.0)
        dof, _, square = sums[:, :3].sum(axis=0)
        lines = shared_by_lines(sums)["row"][0]
        noise = np.sqrt(square / dof + lines / BLOCK)  # blocks of rows take that off
        value, error = of_few_lines((noise, noise / np.sqrt(2 * dof)), sums, shape)
        scaled.append((value - np.sqrt(32.0)) / error)
    assert np.std(scaled) == pytest.approx(1, abs=0.35)


def test_outputs_of_different_gain_are_told_and_leave_the_response(tmp_path: Path) -> None:
    frames = {"bias": (0, 20, 1, 0), "flat": (30000, 40, 1, 0)}
    plain = camera_run(tmp_path / "plain", frames)
    ratio = 1.04 ** (np.arange(SHAPE[1]) >= 70)
    found = camera_run(tmp_path / "outputs", frames, gain=GAIN * ratio)
    reduced = pixcal.open_run(tmp_path / "outputs" / "run").reduction
    outputs = reduced["gain_e_per_adu"]["outputs"]
    assert [one["where"] for one in outputs] == ["columns up to 69", "columns from 70"]
    for one, true in zip(outputs, (GAIN, 1.04 * GAIN), strict=True):
        # The error of the gain of both together comes on top.
        error = np.hypot(one["error"], found["conversion_gain"]["error"])
        assert abs(one["gain"] - true) < 4 * error < 0.08 * true
    assert outputs[1]["gain"] / outputs[0]["gain"] == pytest.approx(1.04, abs=0.01)
    said = [w for w in reduced["warnings"] if "the gain differs between outputs" in w]
    assert len(said) == 1
    assert "columns from 70" in said[0]
    assert "columns from 70" in found["conversion_gain"]["note"]
    for name in ("prnu", "prnu_column", "read_noise"):
        error = np.hypot(found[name]["error"], plain[name]["error"])
        assert abs(found[name]["value"] - plain[name]["value"]) < 3 * error
    assert "outputs" not in pixcal.open_run(tmp_path / "plain" / "run").reduction["gain_e_per_adu"]


def test_the_same_whatever_the_workers(run: pixcal.Run, tmp_path: Path) -> None:
    again = pixcal.ingest(run.path.parent / "acq", tmp_path / "run")
    pixcal.reduce(again, runtime=pixcal.Runtime("sync"))
    for name in ("reduce.json", "figures_of_merit.json"):
        assert (again.path / "reduce" / name).read_bytes() == (
            run.path / "reduce" / name
        ).read_bytes()


def test_terminal_and_report_show_them_and_speak_of_no_fibres(run: pixcal.Run) -> None:
    said = CliRunner().invoke(cli, ["reduce", str(run.path), "--quiet"]).output
    page = run.report.read_text(encoding="utf-8")
    for figure in run.reduction["figures_of_merit"].values():
        assert figure["title"] in page
        part = figure["title"].endswith(("of rows", "of columns", "of pixels"))
        assert (figure["title"] in said) != part
    for title in ("Photon-transfer curve", "DSNU and PRNU: spectra", "Linearity"):
        assert title in page
    for word in ("fibre", "fringe set", "Not measured: there is no"):
        assert word not in said
        assert word not in page.split("Provenance</h2>")[0].split("<body>")[1], word


def test_without_flats_and_darks_the_rest_is_there(tmp_path: Path) -> None:
    acquisition = write_camera(tmp_path / "acq", (500,))
    listed = yaml.safe_load((acquisition / "acquisition.yaml").read_text())
    listed["frames"] = {"bias": ["bias.fits"]}
    (acquisition / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    made = pixcal.run(acquisition, tmp_path / "run", diagnosed=False)
    found = made.reduction["figures_of_merit"]
    assert set(found) == {
        "conversion_gain",
        "read_noise_with_rounding",
        "read_noise",
        "dsnu",
        "dsnu_row",
        "dsnu_column",
        "dsnu_pixel",
    }
    assert found["conversion_gain"]["note"] == "declared, not measured"
    curves = json.loads((made.path / "reduce" / "figures_of_merit.json").read_text())
    assert curves["dsnu"]["rows"]["frequency"][-1] == 0.5


def test_a_pattern_of_period_two_is_named_with_its_amplitude(tmp_path: Path) -> None:
    acquisition = write_camera(tmp_path / "acq", (500,))
    with fits.open(acquisition / "bias.fits", mode="update") as file:
        file[0].data[..., ::2] += 4
    listed = yaml.safe_load((acquisition / "acquisition.yaml").read_text())
    listed["frames"] = {"bias": ["bias.fits"]}
    (acquisition / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    found = pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "run")).reduction["warnings"]
    (said,) = (text for text in found if "alternate" in text)
    assert "alternate columns" in said
    assert abs(float(said.split("amplitude ")[1].split()[0]) - 5) < 0.6


def without_gain(acquisition: Path, *kinds: str) -> Path:
    listed = yaml.safe_load((acquisition / "acquisition.yaml").read_text())
    del listed["detector"]["gain_e_per_adu"]
    listed["frames"] = {kind: listed["frames"][kind] for kind in kinds}
    (acquisition / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    return acquisition


def test_a_gain_that_is_not_declared_is_that_of_the_flats(tmp_path: Path) -> None:
    acquisition = write_camera(tmp_path / "acq", (500, 1500, 3000, 4500, 6000))
    declared = pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "declared")).reduction
    without_gain(acquisition, "bias", "dark", "flat")
    found = pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "run")).reduction
    gain = found["gain_e_per_adu"]
    assert gain["declared"] is None
    assert gain["used"] == gain["measured"]
    assert abs(gain["used"] / declared["gain_e_per_adu"]["measured"] - 1) < 1e-3
    assert any("no gain declared" in text for text in found["warnings"])


@pytest.mark.parametrize(
    ("kinds", "why"),
    [(("bias", "dark"), "without flat frames"), (("flat",), "without bias or dark frames")],
)
def test_a_gain_that_nothing_tells_is_asked_for(
    kinds: tuple[str, ...], why: str, tmp_path: Path
) -> None:
    acquisition = without_gain(write_camera(tmp_path / "acq", (500, 1500)), *kinds)
    with pytest.raises(pixcal.InputError, match=r"detector.gain_e_per_adu: missing") as raised:
        pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "run"))
    assert why in str(raised.value)
    assert "give it in e-/ADU" in str(raised.value)


def reduced_ladders(acquisition: Path, read: float) -> dict[str, Any]:
    """Contents of ``reduce.json`` of darks and flats without a declared gain."""
    listed = {
        "schema": "pixcal/acquisition/1",
        "detector": {"name": "CAM", "pitch_um": 5.5, "read_noise_e": read},
        "frames": {kind: [f"{kind}*.fits"] for kind in ("dark", "flat")},
    }
    (acquisition / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    run = pixcal.ingest(acquisition, acquisition.with_name("run"))
    found: dict[str, Any] = pixcal.reduce(run).reduction
    return found


@pytest.mark.parametrize("seed", [3, 4])
def test_a_camera_that_clips_black_before_it_adds_an_offset(seed: int, tmp_path: Path) -> None:
    """Darks in pairs, of a signal that grows; the noise of rounding spreads the clipped samples."""
    rng, gain, read, dark = np.random.default_rng(seed), 6.0, 6.6, 10.0
    pattern = 0.7 * rng.standard_normal(SHAPE)
    response = 1 + PRNU / 100 * rng.standard_normal(SHAPE)
    acquisition = tmp_path / "acq"
    acquisition.mkdir()
    for kind, light in (("dark", 0.0), ("flat", 900.0)):
        for n, seconds in enumerate(np.linspace(0.1, 0.8, 9)):
            count = 12 if n == 5 else 2
            charge = rng.poisson((light * response + dark) * seconds, (count, *SHAPE))
            analogue = charge + pattern + rng.normal(1.6 * read, read, charge.shape)
            spread = rng.uniform(-0.5, 0.5, charge.shape)
            samples = np.rint(np.maximum(analogue, 0) / gain + 11.81 + spread).astype(np.uint16)
            header = fits.Header({"EXPTIME": float(seconds)})
            fits.writeto(acquisition / f"{kind}{n}.fits", samples, header)
    reduction = reduced_ladders(acquisition, read)
    assert any("cut off at code 12" in warning for warning in reduction["warnings"])
    found = reduction["figures_of_merit"]
    noise = np.hypot(read, gain / np.sqrt(12))
    true = {"conversion_gain": gain, "read_noise": noise, "dark_current": dark}
    for name, value in true.items():
        assert abs(found[name]["value"] - value) < 3 * found[name]["error"], name
    assert found["conversion_gain"]["error"] < 0.03 * gain
    assert found["dark_current"]["error"] < 0.3 * dark


def test_shot_noise_of_the_dark_signal_is_not_taken_for_that_of_light(tmp_path: Path) -> None:
    """Flats whose dark signal is a tenth of their light: it adds to noise and level alike."""
    rng, read, dark, light = np.random.default_rng(5), 3.0, 100.0, 1000.0
    acquisition = tmp_path / "acq"
    acquisition.mkdir()
    for kind, electrons in (("dark", 0.0), ("flat", light)):
        for n, seconds in enumerate(np.linspace(0.4, 4.0, 9)):
            charge = rng.poisson((electrons + dark) * seconds, (4, *SHAPE))
            samples = np.rint(200 + (charge + rng.normal(0, read, charge.shape)) / GAIN)
            header = fits.Header({"EXPTIME": float(seconds)})
            fits.writeto(acquisition / f"{kind}{n}.fits", samples.astype(np.uint16), header)
    reduction = reduced_ladders(acquisition, read)
    gain = reduction["figures_of_merit"]["conversion_gain"]
    assert abs(gain["value"] - GAIN) < 3 * gain["error"] < 0.06 * GAIN
    noise = reduction["figures_of_merit"]["read_noise"]
    assert abs(noise["value"] - read) < 3 * noise["error"]


@pytest.mark.parametrize(("declared", "said"), [(0.1, True), (0.12, False), (0.0502, False)])
def test_half_the_declared_gain_may_be_that_of_an_electron_multiplier(
    declared: float, said: bool
) -> None:
    fit: Any = SimpleNamespace(of_electrons=(0.05, 0.0002), excess=(1.0, 0.0))
    summary: Any = SimpleNamespace(declared=SimpleNamespace(gain_e_per_adu=declared), step=1.0)
    sentences = _declared_gain_warnings(fit, summary, declared)
    assert any("F² = 2" in one for one in sentences) == said


@pytest.mark.parametrize("multiplied", [True, False])
def test_dark_signal_in_outliers_is_told(multiplied: bool, tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    (tmp_path / "acq").mkdir()
    rate, shape = 0.02, (96, 96)
    for name, count, seconds in (("bias", 16, 0.0), ("dark0", 12, 2.0), ("dark1", 12, 10.0)):
        charge = rng.poisson(rate * seconds, (count, *shape)).astype(float)
        if multiplied:
            charge = rng.gamma(np.maximum(charge, 1e-9))
        # Of 0.01 e-/ADU: the read noise is 0.1 or 5 e-.
        samples = (
            500 + 100 * charge + (10 if multiplied else 500) * rng.standard_normal(charge.shape)
        )
        header = fits.Header({"EXPTIME": seconds})
        samples = (samples + 4000).clip(0, 65535).round().astype(np.uint16)
        fits.writeto(tmp_path / "acq" / f"{name}.fits", samples, header)
    listed = {
        "schema": "pixcal/acquisition/1",
        "detector": {"pitch_um": 5.5, "read_noise_e": 0.1, "gain_e_per_adu": 0.01},
        "frames": {"bias": ["bias.fits"], "dark": ["dark*.fits"]},
    }
    (tmp_path / "acq" / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    reduced = pixcal.reduce(pixcal.ingest(tmp_path / "acq", tmp_path / "run")).reduction
    note = reduced["figures_of_merit"]["dark_current"]["note"]
    assert ("excludes outliers, which hold" in note) == multiplied
    if multiplied:
        value = reduced["figures_of_merit"]["dark_current"]["value"]
        # Pixels with many outliers are flagged as noisy: they are in neither.
        assert 0.7 * rate < value + float(note.partition("hold ")[2].split()[0]) < 1.05 * rate


@pytest.mark.parametrize("declared", [8.0 / 200, 8.0, None])
def test_multiplied_electrons_are_counted_as_collected(
    declared: float | None, tmp_path: Path
) -> None:
    """Each becomes 200 on average; the output has 8 e-/ADU and 100 e- of read noise."""
    rng, (multiplication, gain, read, dark) = np.random.default_rng(4), (200, 8.0, 100.0, 0.05)
    acquisition = tmp_path / "acq"
    acquisition.mkdir()
    steps = [("bias", 0.0, 0.0, 20), ("dark0", 0.0, 20.0, 10), ("dark1", 0.0, 100.0, 10)]
    steps += [(f"flat{n}", 5.0 * 2**n, 0.1 * 2**n, 4) for n in range(6)]
    for name, light, seconds, count in steps:
        electrons = rng.poisson(light + dark * seconds, (count, *SHAPE)).astype(float)
        electrons = rng.gamma(np.maximum(electrons, 1e-9), multiplication)
        samples = 500.5 + (electrons + read * rng.standard_normal(electrons.shape)) / gain
        header = fits.Header({"EXPTIME": seconds})
        samples = np.rint(samples.clip(0, 65535)).astype(np.uint16)
        fits.writeto(acquisition / f"{name}.fits", samples, header)
    detector = {"pitch_um": 13.0, "read_noise_e": read / multiplication}
    if declared is not None:
        detector["gain_e_per_adu"] = declared
    kinds = {kind: [f"{kind}*.fits"] for kind in ("bias", "dark", "flat")}
    listed = {"schema": "pixcal/acquisition/1", "detector": detector, "frames": kinds}
    (acquisition / "acquisition.yaml").write_text(yaml.safe_dump(listed))
    reduction = pixcal.reduce(pixcal.ingest(acquisition, tmp_path / "run")).reduction
    true = {
        "conversion_gain": gain / multiplication,
        "read_noise": read / multiplication,
        "dark_current": dark,
    }
    for name, value in true.items():
        figure = reduction["figures_of_merit"][name]
        assert abs(figure["value"] - value) < 3 * figure["error"] < 0.3 * value, name
    words = " ".join(reduction["warnings"])
    assert "electrons are multiplied before the output" in words
    assert ("not the" in words.partition("gain of")[2]) == (declared == gain)
    assert ("that of the output" in words) == (declared == gain)
