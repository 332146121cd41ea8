"""Each figure's analysis on a tiny bench: the law that it shows holds there."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from comparators.measure import read_cube
from pixcal.effects import parse_effects
from pixcal.engine.run import Runtime
from pixcal.kernels.optics import interfringe, paraxial_vector
from pixcal.kernels.scene import geometry
from pixcal.model.bench import Bench, load_bench
from reproduction import figure_05, figure_09, figure_10, figure_11, figure_12, figure_14, figure_16
from reproduction.lab import CONFIGS, Lab, Scene, resized
from reproduction.maps import Whiteness

INTERFRINGES = {
    "figure-05": [9.588],
    "figure-09": [5.0, 7.0, 10.0, 20.0],
    "figure-10": [5.0],
    "figure-11": [10.0, 10.0],
    "figure-12": [9.0, 9.0],
    "figure-13": [8.0, 8.0],
    "figure-14": [9.0, 9.0],
    "figure-15": [9.0, 9.0],
    "figure-16": [9.588],
}


@pytest.fixture
def laboratory(tmp_path: Path) -> Lab:
    return Lab(tmp_path, Runtime(cluster="sync"))


def in_files_of(bench: Bench, per_file: int) -> Bench:
    return replace(bench, frames=replace(bench.frames, per_file=per_file, bias=20))


def only(bench: Bench, *names: str) -> Bench:
    sets = tuple(s for s in bench.frames.fringes if s.name in names)
    return replace(bench, frames=replace(bench.frames, fringes=sets))


@pytest.mark.parametrize("file", sorted(CONFIGS.glob("*.yaml")), ids=lambda f: f.stem)
def test_a_bench_of_the_paper_is_what_it_says(file: Path) -> None:
    bench = load_bench(file)
    parse_effects(bench.effects, str(file))
    found = [
        interfringe(paraxial_vector(geometry(bench, n))) for n in range(len(bench.frames.fringes))
    ]
    assert found == pytest.approx(INTERFRINGES[file.stem], abs=1e-3)
    assert bench.detector.pitch_um == 4.4
    assert all(s.count % bench.frames.per_file == 0 for s in bench.frames.fringes)


def test_a_smaller_bench_lies_in_the_same_place() -> None:
    bench = load_bench(CONFIGS / "figure-15.yaml")
    small = resized(bench, side=100, frames=30)
    assert small.detector.shape == (100, 100)
    assert {s.count for s in small.frames.fringes} == {30}
    for number in range(2):
        a, b = geometry(bench, number), geometry(small, number)
        # From the middle of the window.
        assert a.centre_x - 199.5 * a.pitch == pytest.approx(b.centre_x - 49.5 * b.pitch)
    assert resized(bench, side=9000, frames=10**6) == bench


def test_a_cut_run_holds_the_first_frames(laboratory: Lab) -> None:
    bench = only(resized(laboratory.bench("figure-09"), side=24, frames=60), "px-5", "px-7")
    scene = laboratory.scene("cut", in_files_of(bench, 20))
    whole, cut = scene.reduced(), scene.reduced(40)
    assert scene.reduced(60) == whole
    for name in ("px-5", "px-7"):
        np.testing.assert_array_equal(read_cube(cut, name), read_cube(whole, name)[:40])
    with pytest.raises(ValueError, match="no whole number of files"):
        scene.reduced(30)


def test_figure_5_bends_by_the_next_order(laboratory: Lab) -> None:
    bench = laboratory.bench("figure-05")
    detector = replace(bench.detector, chip=(400, 6000), shape=(400, 25))
    for edge in figure_05.measure(laboratory, replace(bench, detector=detector)):
        assert np.abs(edge.bend).max() > 1
        np.testing.assert_allclose(edge.bend, edge.expected, rtol=0.01)


@pytest.mark.long
def test_figure_9_lies_on_the_bound(laboratory: Lab) -> None:
    bench = resized(laboratory.bench("figure-09"), side=44, frames=200)
    scene = laboratory.scene("scene", bench)
    chance = 1 / np.sqrt(2 * 44**2)
    lines = figure_09.precision(scene, (100, 200))
    assert [line.interfringe for line in lines.values()] == pytest.approx([5, 7, 10, 20], rel=1e-3)
    for line in lines.values():
        for point in line.points:
            assert point.error / point.bound == pytest.approx(1, abs=4.5 * chance)
    methods = figure_09.alternatives(scene, "px-5", (200,))
    # Equal weights cost a third at full contrast (physics note, section 3).
    (constant,) = methods["constant"]
    assert constant.error / constant.bound == pytest.approx(1.31, abs=0.08)
    (free,) = methods["free"]
    assert free.error > constant.error
    unsteady = laboratory.scene("unsteady", figure_09.noisy(bench))
    (moved,) = figure_09.alternatives(unsteady, "px-5", (200,))["constant"]
    assert moved.error > 1.5 * constant.error


def test_figure_10_has_no_systematics(laboratory: Lab) -> None:
    bench = resized(laboratory.bench("figure-10"), side=48, frames=200)
    found = figure_10.measure(laboratory.scene("scene", bench))
    pull = found.delta_error / found.sigma
    assert np.std(pull) == pytest.approx(1, abs=0.07)
    white = Whiteness.of(found.delta_error)
    four = (white.neighbours_x, white.neighbours_y, white.rows, white.columns)
    assert max(map(abs, four)) < 4
    assert found.response > 0.99
    assert found.phi_error.std() == pytest.approx(found.phi_bound, rel=0.25)


@pytest.mark.long
def test_figure_11_falls_with_the_root_of_the_frames(laboratory: Lab) -> None:
    bench = resized(laboratory.bench("figure-11"), side=32, frames=1200)
    scene = laboratory.scene("scene", in_files_of(bench, 100))
    for one in figure_11.measure(scene, batch_frames=100):
        assert one.interfringe == pytest.approx(10, rel=1e-3)
        slope, error = one.allan["slope"], one.allan["slope_err"]
        assert slope == pytest.approx(-0.5, abs=4 * error)
        assert error < 0.05
        assert one.at(1200) == pytest.approx(one.bound, rel=0.1)
        assert one.error == pytest.approx(one.bound, rel=0.1)


def without_noise(bench: Bench, laboratory: Lab) -> Scene:
    bench = in_files_of(bench, 20)
    return laboratory.scene("scene", replace(bench, frames=replace(bench.frames, bias=0)))


@pytest.mark.parametrize("name", figure_12.SETS)
def test_figure_13_has_the_teeth_of_its_kernel(laboratory: Lab, name: str) -> None:
    scene = without_noise(resized(laboratory.bench("figure-13"), frames=60), laboratory)
    delta = figure_12.by_paper(scene, name)
    found = figure_12.measure(scene, name, delta, free=False)
    assert found.height > 1e-3
    np.testing.assert_allclose(found.found, found.expected, atol=1e-4)


def test_figure_13_is_flat_without_crosstalk(laboratory: Lab) -> None:
    bench = resized(laboratory.bench("figure-13"), frames=60)
    scene = without_noise(replace(bench, effects={}), laboratory)
    delta = figure_12.by_paper(scene, "vertical")
    found = figure_12.measure(scene, "vertical", delta, free=False)
    assert found.rest < 1e-5
    assert not found.expected.any()


@pytest.mark.long
def test_figure_15_shows_the_crest_and_loses_it(laboratory: Lab) -> None:
    bench = resized(laboratory.bench("figure-15"), side=160, frames=20)
    found = figure_14.measure(without_noise(bench, laboratory))
    for bent in found.values():
        assert bent.model == "hyperbolic"
        assert bent.crest.reach == pytest.approx(bent.expected.reach, rel=0.1)
        assert bent.seen == pytest.approx(bent.offset, rel=0.1)
        assert bent.left.reach < 0.1 * bent.crest.reach
        assert bent.error < 1e-4


def test_fringes_that_are_left_are_measured() -> None:
    y, x = np.indices((90, 110))
    psi = 0.7 * x
    smooth = 0.05 * (x / 110) ** 2 - 0.02 * x * y / 9000
    wave = 3e-3 * np.cos(psi + 0.4) * (1 + (x - 55) / 110)
    assert figure_14.fringes_left(smooth + wave, (0.7, 0.0)) == pytest.approx(
        float(np.std(wave)), rel=0.02
    )
    assert figure_14.fringes_left(smooth, (0.7, 0.0)) < 1e-4


@pytest.mark.long
def test_figure_16_finds_the_fibres(laboratory: Lab) -> None:
    bench = laboratory.bench("figure-16")
    detector = replace(bench.detector, shape=(500, 700), chip=(500, 700))
    found = figure_16.measure(laboratory.scene("scene", replace(bench, detector=detector)))
    assert found.facts["unique_minimum"]
    for name in ("distance", "baseline_x"):
        value, sigma, true = found.value(name)
        assert abs(value - true) < 5 * sigma
    assert abs(found.ratio_error) < 1e-4
    assert found.picture.startswith(b"\x89PNG")


def test_the_lab_takes_the_papers_own_size_when_asked(tmp_path: Path) -> None:
    quick, full = (Lab(tmp_path, Runtime(), full) for full in (False, True))
    assert full.sized("figure-15", frames=10) == full.bench("figure-15")
    assert {s.count for s in quick.sized("figure-15", frames=10).frames.fringes} == {10}
