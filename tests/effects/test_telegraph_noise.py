"""Telegraph noise: two levels, as long in each as given, in the same pixels; found again."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.telegraph_noise import MeasuredPixels, TelegraphNoise, _pixels
from pixcal.estimators.detector.telegraph.moments import moments_of, signs
from pixcal.estimators.detector.telegraph.series import pixel_series_of
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.synthesis import BLOCK_ROWS
from pixcal.model.bench import Bench, SimulatedDetector
from pixcal.simulation.recording import Recording, recordings

LONG = {
    "detector.shape": [70, 61],
    "detector.read_noise_e": 0.0,
    "detector.bias_pixel_rms_adu": 0.0,
    "detector.bias_adu": 9000,
    "detector.gain_e_per_adu": 0.5,
    "frames.bias": 400,
}


def bias_of(bench: Bench) -> Recording:
    return next(r for r in recordings(bench) if r.kind == "bias")


@pytest.mark.parametrize("switching", [0.0, 0.5, 3.0])
def test_pixels_have_two_levels_and_stay_in_them(
    make_effect_bench: Callable[..., Bench], switching: float
) -> None:
    bench = make_effect_bench(LONG)
    effect = TelegraphNoise(0.1, 400.0, switching)
    frames = frames_of(bench, bias_of(bench), [effect]).astype(float)
    lively = np.ptp(frames, axis=0) > 1
    n = lively.size
    assert lively.mean() == pytest.approx(0.1, abs=4 * np.sqrt(0.09 / n))
    series = frames[:, lively]
    for pixel in series.T:
        assert len(np.unique(pixel)) == 2
    amplitude = 0.5 * np.ptp(series, axis=0)
    assert amplitude.mean() == pytest.approx(400, abs=4 * 400 / np.sqrt(len(amplitude)))
    assert np.median(amplitude) == pytest.approx(400 * np.log(2), rel=0.3)
    state = np.where(series > series.mean(axis=0), 1.0, -1.0)
    keep = np.exp(-2 * 0.14 / switching) if switching else 0.0
    error = np.sqrt((1 - keep**2) / state.size)
    assert (state[1:] * state[:-1]).mean() == pytest.approx(keep, abs=4 * error)
    middle = (series.max(axis=0) + series.min(axis=0)) / 2
    np.testing.assert_allclose(middle, 9000, atol=1)


def test_pixels_are_in_the_upper_level_for_its_share_of_the_time(
    make_effect_bench: Callable[..., Bench],
) -> None:
    """The mean level stays where it is."""
    bench = make_effect_bench(LONG)
    effect = TelegraphNoise(0.1, 400.0, 0.0, upper=0.1)
    frames = frames_of(bench, bias_of(bench), [effect]).astype(float)
    series = frames[:, np.ptp(frames, axis=0) > 20]
    up = series > (series.max(axis=0) + series.min(axis=0)) / 2
    # Pixels that are never up are not among them.
    assert up.mean() == pytest.approx(0.1, abs=5 * 0.3 / np.sqrt(up.size) + 0.9 ** len(up))
    low, high = series.min(axis=0), series.max(axis=0)
    np.testing.assert_allclose(0.9 * low + 0.1 * high, 9000, atol=1)


def test_measured_pixels_have_their_levels_and_others_follow_the_law(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench(LONG)
    law = TelegraphNoise(0.1, 400.0, 0.0)
    own = MeasuredPixels(
        (5, 66), (3, 40), 0.5, (9, 64, 65), (3, 20, 39), (2.0, 1.5, 0.75), (0.5, 0.1, 0.9)
    )
    every, some = (
        frames_of(bench, bias_of(bench), [effect]).astype(float)
        for effect in (law, replace(law, measured=(own,)))
    )
    by_law, now = (0.5 * np.ptp(frames, axis=0) for frames in (every, some))
    part = np.zeros(now.shape, bool)
    part[5:66, 3:40] = True
    np.testing.assert_array_equal(now[~part], by_law[~part])
    at = np.array([own.row, own.column])
    np.testing.assert_allclose(now[*at], [800, 600, 300], atol=1)
    faint = part & (by_law > 0) & (by_law < 195)
    faint[*at] = False
    part[*at] = False
    np.testing.assert_array_equal(now[faint], by_law[faint])
    assert now[part].max() < 201
    series = some[:, *at]
    up = series > (series.max(axis=0) + series.min(axis=0)) / 2
    np.testing.assert_allclose(up.mean(axis=0), own.upper, atol=4 * 0.5 / np.sqrt(len(up)))


def test_measured_pixels_are_those_of_the_chip(make_effect_bench: Callable[..., Bench]) -> None:
    window = {"detector.chip": [150, 300], "detector.origin_px": [60, 100]}
    bench = make_effect_bench({**LONG, **window, "detector.shape": [47, 53]})
    own = MeasuredPixels(
        (50, 90), (80, 140), 0.0, (59, 65, 80), (120, 105, 139), (1.0,) * 3, (0.5,) * 3
    )
    effect = TelegraphNoise(0.1, 400.0, 0.0, measured=(own,))
    jumps = np.ptp(frames_of(bench, bias_of(bench), [effect]).astype(float), axis=0) > 1
    expected = np.zeros((47, 53), bool)
    expected[[5, 20], [5, 39]] = True
    np.testing.assert_array_equal(jumps[:30, :40], expected[:30, :40])
    np.testing.assert_array_equal(effect.noisy_pixels(bench.detector), expected)
    elsewhere = MeasuredPixels((50, 90), (20, 80), 0.0, (), (), (), ())
    law, beside = (_pixels(bench.detector, 0, 0.1, 1.0, 0.5, m) for m in ((), (elsewhere,)))
    np.testing.assert_array_equal(beside, law)


def test_it_belongs_to_the_pixels_of_the_chip(make_effect_bench: Callable[..., Bench]) -> None:
    chip = {"detector.chip": [150, 300], "frames.bias": 30}
    effect = TelegraphNoise(0.1, 400.0, 0.0)
    lively = []
    for origin, shape in (([10, 20], [120, 250]), ([60, 100], [47, 53])):
        bench = make_effect_bench(
            {**LONG, **chip, "detector.origin_px": origin, "detector.shape": shape}
        )
        frames = frames_of(bench, bias_of(bench), [effect]).astype(float)
        lively.append(np.ptp(frames, axis=0) > 1)
    assert np.array_equal(lively[0][50:97, 80:133], lively[1])


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    "truth",
    [
        TelegraphNoise(),
        TelegraphNoise(0.005, 60.0, 0.0),
        TelegraphNoise(0.02, 100.0, 3.0),
        TelegraphNoise(0.03, 120.0, 0.5, 15.0),
    ],
)
def test_share_amplitude_and_time_are_found(
    acquired: Callable[..., Evidence],
    make_effect_bench: Callable[..., Bench],
    truth: TelegraphNoise,
) -> None:
    names = ("share", "amplitude_e", "switching_s", "amplitude_shape")
    parameters = {n: getattr(truth, n) for n in names}
    evidence = acquired(None, {"telegraph_noise": parameters})
    found = TelegraphNoise.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, TelegraphNoise)
    assert TelegraphNoise.detect(evidence) == found.significance
    for name, value in parameters.items():
        assert abs(getattr(found.effect, name) - value) <= 4 * found.errors.get(name, 0.0), name
    assert_measured_pixels_jump(found.effect, truth, make_effect_bench().detector)
    assert found.errors["share"] < 0.4 * truth.share
    assert found.errors["amplitude_e"] < 0.4 * truth.amplitude_e
    assert found.significance > 5


def assert_measured_pixels_jump(
    found: TelegraphNoise, truth: TelegraphNoise, detector: SimulatedDetector
) -> None:
    """Most of those that were measured one by one do, and by as much."""
    (own,) = found.measured
    rows, columns, amplitudes, *_ = _pixels(
        detector, 0, truth.share, truth.amplitude_shape, truth.upper, ()
    )
    true = np.zeros((BLOCK_ROWS, detector.shape[1]))
    true[rows, columns] = amplitudes * truth.amplitude_e
    row, column, seen = np.array([own.row, own.column, own.amplitude])[
        :, np.array(own.row) < BLOCK_ROWS
    ]
    there = true[row.astype(int), column.astype(int)]
    assert np.count_nonzero(there) > 0.7 * len(row) > 5
    off = (seen * found.amplitude_e / np.maximum(there, 1) - 1)[there > 0]
    assert np.median(np.abs(off)) < 0.2


@pytest.mark.long
def test_strong_jumps_show_in_fringes_alone(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    # With so few bias frames the noisy pixels were not left out of the fit.
    few = {"frames.bias": 4, "frames.darks": []}
    evidence = acquired(few, {"telegraph_noise": {"amplitude_e": 300.0}})
    found = TelegraphNoise.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, TelegraphNoise)
    assert abs(found.effect.amplitude_e - 300) < 4 * found.errors["amplitude_e"] < 300
    assert abs(found.effect.share - 0.02) < 4 * found.errors["share"] < 0.04
    assert found.significance > 10
    truth = TelegraphNoise(amplitude_e=300.0)
    assert_measured_pixels_jump(found.effect, truth, make_effect_bench().detector)
    nothing = TelegraphNoise.estimate(replace(acquired(), stacks=()))
    assert nothing is not None
    assert nothing.significance < 4
    assert TelegraphNoise.estimate(replace(evidence, stacks=(), fringes={})) is None


@pytest.mark.quick(1)
@pytest.mark.parametrize("amplitude", [32.0, 60.0])
def test_few_bias_frames_and_fringes_add_what_the_others_miss(
    acquired: Callable[..., Evidence], amplitude: float
) -> None:
    few = {"frames.bias": 10, "frames.darks": []}
    evidence = acquired(few, {"telegraph_noise": {"share": 0.03, "amplitude_e": amplitude}})
    alone = [replace(evidence, stacks=()), replace(evidence, fringes={})]
    least = max(5.0, *(TelegraphNoise.detect(e) or 0.0 for e in alone))
    found = TelegraphNoise.estimate(evidence)
    assert found is not None
    assert found.significance >= least


def with_noise(evidence: Evidence, gain: np.ndarray) -> Evidence:
    """Pixels as noisy as before, times a map."""
    stacks = []
    for stack in evidence.stacks:
        mean = stack.adu.mean(axis=0)
        stacks.append(replace(stack, adu=np.round(mean + gain * (stack.adu - mean))))
    return replace(evidence, stacks=tuple(stacks))


@pytest.mark.long
def test_pixels_that_are_only_noisier_are_not_taken_for_it(
    acquired: Callable[..., Evidence],
) -> None:
    evidence = acquired()
    rng = np.random.default_rng(9)
    shape = evidence.good.shape
    some = np.where(rng.random(shape) < 0.05, 1 + 2 * rng.exponential(size=shape), 1.0)
    for gain in (some, rng.lognormal(0, 0.2, shape), 1 + rng.exponential(0.4, shape)):
        noisier = with_noise(evidence, gain)
        found = TelegraphNoise.estimate(noisier)
        assert found is not None
        assert found.significance < 4
        moments = [m for s in pixel_series_of(noisier) if (m := moments_of(s)) is not None]
        assert signs(moments).noisy > 100


@pytest.mark.quick(1)
@pytest.mark.parametrize("other", [{"cosmic_hits": {"rate_cm2_s": 30_000.0}}, {"row_noise": {}}])
def test_what_looks_like_it_is_not_taken_for_it(
    acquired: Callable[..., Evidence], other: dict[str, dict[str, float]]
) -> None:
    found = TelegraphNoise.estimate(acquired(None, other))
    assert found is not None
    assert found.significance < 4


@pytest.mark.quick(1)
@pytest.mark.parametrize("steps", [0.5, 0.73])
def test_it_is_found_in_noise_of_less_than_a_step_of_the_converter(
    acquired: Callable[..., Evidence], steps: float
) -> None:
    """Rows have noise of their own, too; without jumps nothing is found."""
    coarse = {"detector.gain_e_per_adu": 16.0 / steps, "frames.darks": []}
    effects = {"row_noise": {}}
    nothing = TelegraphNoise.estimate(acquired(coarse, effects))
    assert nothing is not None
    assert nothing.significance < 4
    truth = {"share": 0.03, "amplitude_e": 50.0}
    found = TelegraphNoise.estimate(acquired(coarse, {**effects, "telegraph_noise": truth}))
    assert found is not None
    assert found.significance > 5
    for name, value in truth.items():
        error = found.errors[name]
        assert abs(getattr(found.effect, name) - value) < 4 * error < 1.2 * value, name


def test_noise_far_below_a_step_of_the_converter_says_nothing(
    acquired: Callable[..., Evidence],
) -> None:
    evidence = acquired()
    assert TelegraphNoise.estimate(with_noise(evidence, np.full(evidence.good.shape, 0.02))) is None
