"""Laws of the second bench: light, photons, charge and random numbers."""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from astropy.io import fits

from pixcal.effects import effects
from pixcal.model.acquisition import load_acquisition
from second_bench.__main__ import main
from second_bench.camera import record
from second_bench.cases import CaseError, make_case
from second_bench.effects import LAWS, Law
from second_bench.model import WARM_UP, Bench, Frame, stream
from second_bench.optics import expose, gaussian, light_of
from second_bench.ordinary import VARIATIONS, Layout
from second_bench.writing import write_acquisition

SMALL = Layout(shape=(33, 40), frames=24, bias=6, dark=3, flat=30)
CASES = [f"{one.effect}/{one.name}" for one in LAWS]
# Pyxel compiles its traps in ten seconds, each time.
SLOW = {"lag/traps": pytest.mark.long}
PYXEL = {"lag/traps", "charge_transfer/traps"}


def made(case: str, seed: int = 5, **more: Any) -> Bench:
    if case in PYXEL:
        pytest.importorskip("pyxel")
    return make_case(case, seed, SMALL, plain=True, **more)[0]


def frames(bench: Bench) -> dict[str, Any]:
    return {run.name: cube.astype(float) for run, cube in record(bench)}


def test_two_gaussian_beams_make_the_mean_and_the_visibility_of_the_closed_form() -> None:
    """I = Ia + Ib, V = 2 gamma sqrt(Ia Ib) / (Ia + Ib), Ij = Pj exp(-2 (r - cj)^2 / wj^2)."""
    bench, _ = make_case("ordinary/aim", 3, SMALL)
    one = bench.sets[0]
    bench.pitch_um *= 60  # a window of 10 mm, over which the beams vary
    first, second = one.beams
    first.waist_um, second.waist_um, second.amplitude = 2.7, 1.9, 0.93
    for beam, x in ((first, 4.0), (second, -5.0)):
        beam.aim_mm, beam.tip_mm = np.array([x, 1.0]), np.zeros(3)
    light = light_of(bench, one, gaussian)
    x, y = bench.grid()
    x = (x + bench.delta_x) * bench.pitch_um * 1e-3
    y = (y + bench.delta_y) * bench.pitch_um * 1e-3
    expected = []
    for beam in one.beams:
        radius = bench.wavelength_nm * 1e-6 * bench.distance_mm / (np.pi * beam.waist_um * 1e-3)
        r2 = (x - beam.aim_mm[0]) ** 2 + (y - beam.aim_mm[1]) ** 2
        expected.append(beam.amplitude**2 * np.exp(-2 * r2 / radius**2))
    mean = expected[0] + expected[1]
    visibility = 2 * one.coherence * np.sqrt(expected[0] * expected[1]) / mean
    own = light.first + light.second
    # The closed form is paraxial: the sine of the angle differs by its cube.
    np.testing.assert_allclose(own / own.max(), mean / mean.max(), rtol=2e-3)
    np.testing.assert_allclose(np.abs(light.cross) / own, visibility, rtol=1e-3)
    assert np.ptp(visibility) > 0.005


def test_fringes_have_the_period_of_the_baseline_and_move_with_the_pixels() -> None:
    bench = made("straylight/uniform", strength=0.0)
    one = bench.sets[0]
    bench.delta_x[:] = bench.delta_y[:] = 0
    (b,) = [m.tip_mm - o.tip_mm for m, o in [one.beams]]
    period = bench.wavelength_nm * 1e-6 * bench.distance_mm / (b[0] * bench.pitch_um * 1e-3)
    psi = np.unwrap(np.angle(light_of(bench, one).cross), axis=1)
    np.testing.assert_allclose(np.abs(np.diff(psi, axis=1)), 2 * np.pi / abs(period), rtol=2e-3)
    bench.delta_x[4, 7] = 0.25
    moved = np.unwrap(np.angle(light_of(bench, one).cross), axis=1) - psi
    assert moved[4, 7] / np.diff(psi, axis=1).mean() == pytest.approx(0.25, rel=1e-3)
    assert np.abs(np.delete(moved, 7, axis=1)).max() < 1e-9


def test_a_ghost_stands_still_with_its_own_fibre_and_moves_with_the_other() -> None:
    """Brightness and fringes are those of the summed fields, nothing else."""
    bench = made("ghost_fringes/first_fibre", strength=1.0)
    plain = made("ghost_fringes/first_fibre", strength=1.0)
    size = plain.sets[0].beams[2].amplitude / plain.sets[0].beams[0].amplitude
    del plain.sets[0].beams[2]
    with_it, without = (light_of(b, b.sets[0]) for b in (bench, plain))
    standing = with_it.first / with_it.first.mean() - without.first / without.first.mean()
    assert standing.std() * np.sqrt(2) == pytest.approx(2 * size, rel=0.3)
    following = (
        with_it.cross / np.abs(with_it.cross).mean() - without.cross / np.abs(without.cross).mean()
    )
    assert np.abs(following).std() < np.abs(following).mean() + size
    assert np.abs(following).max() > 0.5 * size


def test_samples_scatter_as_photons_and_read_noise_do() -> None:
    bench = made("straylight/uniform", strength=0.0)
    flats = frames(bench)["flat"] * bench.gain_e_per_adu
    variance = flats.var(axis=0, ddof=1).mean()
    level = bench.flat_e * bench.flat_response.mean() + bench.dark_e.mean()
    expected = level + bench.read_noise_e.mean() ** 2 + bench.gain_e_per_adu**2 / 12
    error = np.sqrt(2 / ((len(flats) - 1) * flats[0].size))
    assert variance / expected == pytest.approx(1, abs=4 * error)


def test_the_mean_of_the_frames_is_that_of_the_light() -> None:
    bench = made("straylight/uniform", strength=0.0)
    cube = frames(bench)["vertical"] - bench.bias_adu
    run = bench.fringe_runs()[0]
    light = light_of(bench, bench.sets[0])
    mean = [expose(light, run, n, bench.grid()).mean() for n in range(3, run.frames)]
    np.testing.assert_allclose(cube.mean(axis=(1, 2)), mean, rtol=2e-3)


@pytest.mark.parametrize("case", ["ipc/symmetric", "ipc/asymmetric", "ipc/four_rows"])
def test_crosstalk_moves_charge_and_makes_none(case: str) -> None:
    bench = made(case, strength=1.0)
    frame = Frame(bench.runs[0], 0, stream(1))
    for row in (11, 12, 13, 14):
        spot = np.zeros(bench.shape)
        spot[row, 20] = 1e4
        (step,) = bench.signal
        after = step(spot, frame)
        assert after.sum() == pytest.approx(1e4, rel=1e-6)
        assert after[row, 20] < 1e4


def test_the_kernel_of_the_truth_is_what_becomes_of_a_spot() -> None:
    bench, truth = make_case("ipc/asymmetric", 5, SMALL, plain=True)
    spot = np.zeros(bench.shape)
    spot[11, 20] = 1.0
    after = bench.signal[0](spot, Frame(bench.runs[0], 0, stream(1)))
    kernel = truth["effects"][0]["parameters"]["kernel"]
    np.testing.assert_allclose(after[10:13, 19:22], kernel, atol=1e-12)


@pytest.mark.parametrize("case", ["brighter_fatter/power_law", "brighter_fatter/table"])
def test_moving_borders_make_no_charge_and_widen_a_bright_spot(case: str) -> None:
    bench = made(case, strength=1.0)
    frame = Frame(bench.runs[0], 0, stream(1))
    (step,) = bench.charge
    spot = np.full(bench.shape, 1e3)
    spot[16, 20] = 4e4
    after = step(spot, frame)
    assert after.sum() == pytest.approx(spot.sum(), rel=1e-6)
    assert after[16, 20] < 4e4
    assert min(after[15, 20], after[17, 20], after[16, 19], after[16, 21]) > 1e3


@pytest.mark.quick(2)
@pytest.mark.parametrize("case", ["lag/linear", "lag/exponentials", "lag/traps"])
def test_what_a_frame_leaves_behind_comes_later(case: str) -> None:
    bench = made(case, strength=1.0)
    (step,) = bench.charge
    bright = np.full(bench.shape, 0.9 * bench.peak_e)
    out = []
    for n in range(100):
        e = bright if n == 0 else np.zeros(bench.shape)
        out.append(step(e, Frame(bench.runs[0], n, stream(1))).mean())
    assert out[0] < bright[0, 0]
    assert out[1] > 1
    assert sum(out) == pytest.approx(bright[0, 0], rel=1e-5)


def test_a_seed_gives_the_same_samples_again_and_another_one_others() -> None:
    case = "ipc+telegraph_noise/population+cosmic_hits"
    first, again, other = (frames(made(case, seed)) for seed in (5, 5, 6))
    for name, cube in first.items():
        np.testing.assert_array_equal(cube, again[name])
        assert (cube != other[name]).any()


@pytest.mark.quick(12)
@pytest.mark.parametrize(
    "one",
    [
        pytest.param(one, id=case, marks=SLOW.get(case, ()))
        for case, one in zip(CASES, LAWS, strict=True)
    ],
)
def test_every_law_shows_and_weakly_less_than_strongly(one: Law) -> None:
    case = f"{one.effect}/{one.name}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        weak, strong = (made(case, strength=s) for s in (0.0, 1.0))
        cubes = [frames(b) for b in (weak, strong)]
    changed = [np.abs(cubes[1][name] - cube).max() for name, cube in cubes[0].items()]
    assert max(changed) > 5 / strong.gain_e_per_adu


def test_names_are_those_of_pixcal_where_it_knows_the_effect() -> None:
    names = set(effects())
    assert {one.effect for one in LAWS if one.known} <= names
    assert not {one.effect for one in LAWS if not one.known} & names
    assert len(set(CASES)) == len(CASES)


def test_ordinary_benches_come_in_all_their_variety() -> None:
    notes = [make_case("ordinary", seed, SMALL)[0].notes for seed in range(40)]
    aims = [np.ptp(note["vertical"]["aims_mm"], axis=0) for note in notes]
    apart = [float(np.hypot(*a)) for a in aims]
    assert min(apart) == 0
    assert max(apart) > 8
    assert {n["horizontal"]["phases"] for n in notes} == {"random", "ramp", "four_bucket", "walk"}
    assert {len(n.get("amplifiers", ())) for n in notes} == {0, 2, 4}
    assert {"dust_specks" in n for n in notes} == {True, False}
    gains = [n["gain_e_per_adu"] for n in notes]
    assert min(gains) < 0.7
    assert max(gains) > 3


def test_stitches_shift_blocks_and_a_lamp_falls_off() -> None:
    plain, _ = make_case("ordinary/dust", 4, SMALL)
    stitched, _ = make_case("ordinary/stitches", 4, SMALL)
    shift = stitched.delta_x - plain.delta_x
    levels = np.unique(shift.round(9))
    assert 1 < len(levels) < 20
    assert 1e-4 < np.abs(levels).max() < 0.02
    lit, _ = make_case("ordinary/lamp", 4, SMALL)
    ratio = lit.flat_response / lit.response
    assert 0.005 < np.ptp(ratio) < 0.3
    assert np.abs(np.diff(ratio, 2, axis=1)).max() < 1e-3
    noisy, _ = make_case("ordinary/noisy_pixels", 4, SMALL)
    assert 0 < np.mean(noisy.read_noise_e > 1.9 * np.median(noisy.read_noise_e)) < 0.03


@pytest.mark.parametrize("name", VARIATIONS)
def test_one_variation_alone_is_no_effect(name: str) -> None:
    bench, truth = make_case(f"ordinary/{name}", 4, SMALL)
    assert truth["effects"] == []
    assert not [*bench.charge, *bench.signal, *bench.offset]
    assert bool(bench.samples) == (name == "bad_frames")


def test_less_common_variations_change_what_they_say() -> None:
    plain = make_case("ordinary/centred", 4, SMALL)[0]

    def with_one(name: str) -> Bench:
        return make_case(f"ordinary/{name}", 4, SMALL)[0]

    noise = with_one("noise_tail").read_noise_e / plain.read_noise_e
    assert noise.max() > 1.8 * np.median(noise)
    assert 10 <= with_one("coarse_gain").gain_e_per_adu <= 16
    hot = with_one("hot_clusters").dark_e > plain.dark_e + 299
    beside = hot[:, 1:] & hot[:, :-1]
    assert hot.sum() > 3
    assert beside.any()
    for one in with_one("dim_fringes").sets:
        assert 0.25 <= one.coherence <= 0.45
    for one in with_one("far_aims").sets:
        assert np.hypot(*(one.beams[0].aim_mm - one.beams[1].aim_mm)) == pytest.approx(10)
    sets = zip(with_one("levels").sets, plain.sets, strict=True)
    assert all(one.peak_e < other.peak_e for one, other in sets)
    phases = [b.fringe_runs()[0].phase for b in (with_one("phase_errors"), plain)]
    assert 0.01 < np.std(phases[0] - phases[1]) < 0.2


def test_a_cut_frame_is_zero_from_some_row_on() -> None:
    bench = make_case("ordinary/bad_frames", 4, SMALL)[0]
    cubes = frames(bench)
    for name, index, row in bench.notes["bad_frames"]:
        frame = cubes[name][index - WARM_UP]
        assert not frame[row:].any()
        assert frame[:row].all()


def test_headers_without_stamps_tell_the_exposure_of_darks_alone(tmp_path: Path) -> None:
    bench, _ = make_case("ordinary/no_stamps", 4, SMALL)
    write_acquisition(bench, record(bench), tmp_path / "acq")
    stamped = {
        folder.name: [k in fits.getheader(next(folder.iterdir())) for k in ("DATE-OBS", "EXPTIME")]
        for folder in (tmp_path / "acq").iterdir()
        if folder.is_dir()
    }
    assert stamped.pop("dark") == [False, True]
    assert {"bias", "flat", "vertical", "horizontal"} == set(stamped)
    assert not np.any([*stamped.values()])


def test_one_set_may_be_all_there_is() -> None:
    bench, _ = make_case("ordinary", 4, replace(SMALL, sets=1))
    assert [one.name for one in bench.sets] == ["vertical"]
    assert [run.name for run in bench.fringe_runs()] == ["vertical"]


def test_the_command_writes_an_acquisition_and_its_truth_apart(tmp_path: Path) -> None:
    acq, told = tmp_path / "acq", tmp_path / "truth" / "t.json"
    size = ["--size", "33", "40", "--frames", "12", "--bias", "4", "--flats", "4"]
    options = ["--seed", "3", "--strength", "0.5", *size]
    assert main(["ipc+lag/linear", *options, "--out", str(acq), "--truth", str(told)]) == 0
    described = load_acquisition(acq)
    assert [s.name for s in described.frames.fringes] == ["vertical", "horizontal"]
    with fits.open(acq / "vertical" / "vertical_00000.fits") as file:
        assert file[0].data.shape == (12, 33, 40)
    truth = json.loads(told.read_text())
    assert [e["effect"] for e in truth["effects"]] == ["ipc", "lag"]
    assert np.shape(truth["delta_x"]) == (33, 40)
    size_of = {one.name: np.sqrt(one.weak * one.strong) for one in LAWS if one.effect == "lag"}
    assert truth["effects"][1]["size"] == pytest.approx(size_of["linear"])


def test_a_case_that_there_is_not_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in ("ordinary/nothing", "leg", "lag/never"):
        with pytest.raises(CaseError):
            make_case(wrong, 1, SMALL)
    with pytest.raises(SystemExit) as stopped:
        main(["leg", "--out", "/nonexistent/a", "--truth", "/nonexistent/t"])
    assert stopped.value.code == 2
    assert "no such effect" in capsys.readouterr().err
