"""A bench's bound: the simulator's own light, laws of scaling, joined sets, levers."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pixcal.kernels.scene import electrons_per_unit, fibre_light
from pixcal.model.bench import Bench, load_bench
from pixcal.stages.budget.calibration import (
    WeightErrors,
    bias_frames_needed,
    flat_error,
    flats_needed,
)
from pixcal.stages.budget.expected import (
    JoinedBound,
    SetBound,
    brightest_allowed,
    frames_needed,
    grid,
    joined,
    pixel_contrast,
    planned_split,
    sample_variance,
)
from pixcal.stages.budget.information import phase_information
from pixcal.stages.budget.levers import levers

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def bench() -> Bench:
    """96 x 80 pixels, fibres of unequal power, 9.6 px, everything free."""
    return load_bench(ROOT / "configs/demo.yaml")


def with_sets(bench: Bench, *changes: dict[str, object]) -> Bench:
    first = bench.frames.fringes[0]
    sets = tuple(replace(first, name=f"set{n}", **c) for n, c in enumerate(changes))
    return replace(bench, frames=replace(bench.frames, fringes=sets, compress=()))


def per_frame(bench: Bench) -> float:
    return float(np.median(SetBound.of(bench, 0).per_frame))


@pytest.mark.parametrize("shape", [(80, 96), (1, 300), (331, 7)])
def test_the_light_is_the_simulators(bench, shape):
    detector = replace(bench.detector, shape=shape)
    changed = replace(bench, detector=detector)
    s = SetBound.of(changed, 0)
    x, y = grid(shape)
    assert {x[0], x[-1], y[0], y[-1]} == {0, shape[1] - 1, shape[0] - 1}
    a, b = fibre_light(changed, 0, (0, shape[0]))
    electrons = electrons_per_unit(changed, 0)
    at = np.ix_(y, x)
    np.testing.assert_allclose(s.iota, electrons * (a + b)[at].ravel(), rtol=1e-3)
    wave = 2 * changed.optics.visibility * np.sqrt(a * b)
    np.testing.assert_allclose(s.alpha, electrons * wave[at].ravel(), rtol=1e-3)
    assert (s.iota + s.alpha).max() == pytest.approx(bench.frames.fringes[0].peak_e)


def test_laws_of_scaling(bench):
    steady = replace(bench, effects={}, optics=replace(bench.optics, beam_radius_mm=1e5))
    quiet = replace(steady, detector=replace(steady.detector, read_noise_e=0.0, dark_e_s=0.0))
    quiet = replace(quiet, detector=replace(quiet.detector, gain_e_per_adu=1e-3))
    one = per_frame(with_sets(quiet, {}))
    assert per_frame(with_sets(quiet, {"peak_e": 84_000.0})) == pytest.approx(one / 2, rel=1e-4)
    longer = per_frame(with_sets(quiet, {"baseline_mm": (12.0, 0.0)}))
    assert longer == pytest.approx(one / 4, rel=1e-3)
    # Full contrast, no other noise, even light: variance (interfringe / 2 pi)² / (peak / 2).
    clear = replace(quiet, optics=replace(quiet.optics, visibility=1.0, power_ratio=1.0))
    s = SetBound.of(with_sets(clear, {}), 0)
    expected = (s.interfringe / (2 * np.pi)) ** 2 / 21_000
    assert np.median(s.per_frame) == pytest.approx(expected, rel=1e-3)
    assert s.shares()["photons"] == pytest.approx(expected, rel=1e-3)
    assert frames_needed(expected, 5e-5) == int(np.ceil(expected / 25e-10))


def test_frames_are_shared_out_without_rest(bench):
    for n in range(2):
        s = SetBound.of(bench, n)
        shares = s.shares()
        assert np.prod(list(shares.values())) == pytest.approx(np.median(s.per_frame), rel=1e-6)
        assert all(shares[name] >= 1 - 1e-9 for name in shares if name != "photons")
        assert s.reach([1])[1] >= np.median(s.per_frame)


def test_the_variance_without_light_is_that_of_its_parts(bench):
    d = bench.detector
    expected = 16.0**2 + 0.85**2 / 12 + d.dark_e_s * 0.02
    assert sample_variance(bench) == pytest.approx(expected)


def test_crossed_sets_are_their_own(bench):
    two = with_sets(bench, {}, {"baseline_mm": (0.0, 6.0)})
    both = joined(two)
    assert both.components == ("delta_x", "delta_y")
    for n in range(2):
        own = np.median(both.sets[n].per_frame) / 300
        assert both.median([300, 300])[n] == pytest.approx(own, rel=1e-3)


def test_diagonal_sets_share(bench):
    """Two at right angles give each axis what one gives its own, wherever they point."""
    two = with_sets(bench, {"baseline_mm": (4.0, 4.0)}, {"baseline_mm": (-4.0, 4.0)})
    both = joined(two)
    alone = np.median(both.sets[0].per_frame)
    np.testing.assert_allclose(both.median([1, 1]), alone, rtol=2e-2)
    # At an angle of 2a between them, x costs 1 / (2 cos² a) and y 1 / (2 sin² a).
    narrow = joined(with_sets(bench, {"baseline_mm": (6.0, 3.0)}, {"baseline_mm": (6.0, -3.0)}))
    alone = np.median(narrow.sets[0].per_frame)
    expected = [alone / (2 * 0.8), alone / (2 * 0.2)]
    np.testing.assert_allclose(narrow.median([1, 1]), expected, rtol=2e-2)


def test_parallel_sets_add_up(bench):
    two = joined(with_sets(bench, {}, {"baseline_mm": (4.0, 0.0)}))
    assert two.components == ("delta_fringe",)
    weight = [1 / np.median(s.per_frame) for s in two.sets]
    assert two.median([3, 5])[0] == pytest.approx(1 / np.dot([3, 5], weight), rel=1e-3)
    assert two.best_split().tolist() == [1.0, 0.0]


def test_the_best_split_gives_the_weaker_set_more(bench):
    """Crossed sets: frames in proportion to the variance of one, both axes alike."""
    both = joined(with_sets(bench, {}, {"baseline_mm": (0.0, 3.0)}))
    variance = np.array([np.median(s.per_frame) for s in both.sets])
    split = both.best_split()
    np.testing.assert_allclose(split, variance / variance.sum(), rtol=1e-2)
    at_best = both.median(split)
    assert at_best[0] == pytest.approx(at_best[1], rel=1e-2)
    three = JoinedBound((*both.sets, both.sets[1]))
    assert three.best_split().sum() == pytest.approx(1)
    assert three.median(three.best_split()).max() <= at_best.max() * 1.001


def test_a_four_step_ramp_costs_a_sixth_more_frames(bench):
    ramp = with_sets(bench, {"phase_law": "ramp", "phase_step_rad": np.pi / 2, "count": 100})
    s, free = SetBound.of(ramp, 0), SetBound.of(with_sets(bench, {}), 0)
    assert np.median(s.per_frame) / np.median(free.per_frame) == pytest.approx(s.loss[0])
    assert s.shares()["phases"] == pytest.approx(s.loss[0])
    assert 1.1 < s.loss[0] < s.loss[1]
    assert s.reach([1])[1] == pytest.approx(free.per_frame.max() * s.loss[1])
    names = {lever.name for lever in levers(ramp, joined(ramp))}
    assert "phases over the whole period" in names


def test_levers_are_what_the_changed_bench_gives(bench):
    found = {lever.name: lever for lever in levers(bench, joined(bench))}
    split = planned_split(bench)
    now = float(joined(bench).median(split).max())
    assert found["as planned"].variance == pytest.approx(now)
    quiet = replace(bench, detector=replace(bench.detector, read_noise_e=8.0))
    expected = float(joined(quiet).median(split).max())
    assert found["read noise 8 e-"].variance == pytest.approx(expected)
    assert found["equal weights"].variance > now
    fast = found["a frame every 0.02 s"]
    assert (fast.variance, fast.period_s) == (pytest.approx(now), 0.02)
    ranked = [v.variance * v.period_s for v in levers(bench, joined(bench))]
    assert ranked == sorted(ranked)
    assert brightest_allowed(bench) == 50_000
    assert "brightest fringe at 50 ke-" in found


def test_finer_fringes_lose_contrast_in_the_pixel(bench):
    """A square pixel's contrast at 5 px and at 9.59 px, from its integral."""
    x = (np.arange(2000) + 0.5) / 2000 - 0.5

    def averaged(period: float) -> float:
        return float(np.mean(np.cos(2 * np.pi * x / period)))

    assert pixel_contrast(2 * np.pi / 5, 0.0) == pytest.approx(averaged(5.0), rel=1e-5)
    both = pixel_contrast(2 * np.pi / 5, 2 * np.pi / 7)
    assert both == pytest.approx(averaged(5.0) * averaged(7.0), rel=1e-5)
    finer = next(v for v in levers(bench, joined(bench)) if v.name.startswith("fringe period 5 px"))
    contrast = averaged(5.0) / averaged(9.588)
    s = SetBound.of(bench, 0, contrast)
    assert s.visibility == pytest.approx(contrast * SetBound.of(bench, 0).visibility)
    gain = finer.variance / float(joined(bench).median(planned_split(bench)).max())
    assert gain == pytest.approx(
        (5 / 9.588) ** 2 * np.median(SetBound.of(bench, 0).information / s.information), rel=1e-2
    )


def test_calibration_frames(bench):
    errors = WeightErrors.of(2e4, 2e4, 256.0)
    n = bias_frames_needed(errors, 256.0)

    def cost(frames: int) -> float:
        return errors.offset * (256 / frames + 2 * 256**2 / (frames - 1))

    assert cost(n) <= 1e-3 < cost(n - 1)
    assert flats_needed(errors, 2e4, 256.0) == 1
    # A flat of 16 e- in noise of 16 e-: each is good to 7 % only.
    assert flats_needed(errors, 16.0, 256.0) == int(np.ceil(errors.scale * 272 / 256 / 1e-3)) > 10
    # 60 flats of 5 to 39 ke-, most of the weight on the bright ones.
    electrons = [12 * 1.3e6 * t for t in (0.004, 0.01, 0.016, 0.023, 0.03)]
    assert flat_error(bench) == pytest.approx(sum(electrons) ** -0.5, rel=0.02)
    without = replace(bench, frames=replace(bench.frames, flats=(), flat_rate_e_s=None))
    assert flat_error(without) is None


def test_read_noise_matters_most_at_the_dark_fringe():
    """At full contrast 16 e- cost 15 % of the frames though shot noise is a hundred times more."""
    cost = phase_information(25_000, 25_000, 0) / phase_information(25_000, 25_000, 256)
    assert float(cost) == pytest.approx(1.154, abs=0.001)
