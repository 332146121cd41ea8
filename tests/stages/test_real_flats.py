"""Ladders of flats as cameras record them: saturated, curved, of one exposure time or several."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy_detectors import Detector, reduced

from pixcal.effects.gain_error import GainError
from pixcal.effects.lag import Lag
from pixcal.effects.nonlinearity import Nonlinearity
from pixcal.estimators.detector.flat_ladder import ladder as ladder_of
from pixcal.estimators.detector.flat_ladder import level_before
from pixcal.estimators.detector.transfer_curve import transfer_curve
from pixcal.estimators.test_statistics import DETECTOR, measure
from pixcal.estimators.test_statistics.fringe_set_data import STEPS
from pixcal.model.arrays import F64
from pixcal.stages import reduce
from pixcal.stages.diagnose.frames import split
from pixcal.stages.diagnose.measure_nominal import _pixel_noise
from pixcal.stages.diagnose.parts import RawFrames, evidence_of
from pixcal.stages.diagnose.windows import whole_of
from pixcal.stages.reduce.flat_survey import FlatSurvey

LEVELS = tuple(np.linspace(0.05, 1.0, 12))
CAMERA = {"gain": 2.3, "noise": 8.0, "bias": 200.4, "scatter": 2.0, "top": 4095, "rate": 8000.0}


def ladder(steps: Sequence[tuple[float, float]], frames: int = 2) -> list[tuple[float, int, float]]:
    """Flats of exposure times (s) and lamps."""
    return [(float(t), frames, float(lamp)) for t, lamp in steps]


BOTH = [(0.5, lamp) for lamp in LEVELS[5:]] + [(0.1, 4 * lamp) for lamp in LEVELS[5:]]


@pytest.mark.parametrize(
    "steps",
    [[(t, 1) for t in LEVELS], [(0.5, 2 * lamp) for lamp in LEVELS], BOTH],
    ids=["exposure times", "lamps", "both"],
)
def test_any_ladder_tells_the_gain(steps: list[tuple[float, float]], tmp_path: Path) -> None:
    _, report = reduced(Detector(**CAMERA, flats=ladder(steps)), 1, tmp_path)
    gain = report["gain_e_per_adu"]
    assert gain["measured"] == pytest.approx(2.3, abs=4 * gain["error"])
    # Without dim levels the curve from the dark to the flats may bend.
    assert gain["error"] < (0.03 if steps is BOTH else 0.025)
    assert gain["chi2_reduced"] < 2
    assert report["read_noise_e"]["measured"] == pytest.approx(8.0, rel=0.01)
    assert report["flags"]["good"] >= 96 * 96 - 2
    assert report["warnings"] == []


@pytest.mark.parametrize("frames", [1, 2])
def test_single_flats_are_said_to_tell_no_gain(frames: int, tmp_path: Path) -> None:
    _, report = reduced(
        Detector(**CAMERA, flats=ladder([(t, 1) for t in LEVELS], frames)), 1, tmp_path
    )
    assert (report["gain_e_per_adu"]["measured"] is None) == (frames == 1)
    said = [warning for warning in report["warnings"] if "at least two flats" in warning]
    assert bool(said) == (frames == 1)


def test_levels_of_one_exposure_time_are_told_apart(tmp_path: Path) -> None:
    flats = ladder([(0.5, lamp) for lamp in (0.2, 0.6, 1.0)], 4)
    evidence, report = reduced(Detector(**CAMERA, flats=flats), 2, tmp_path)
    assert [len(stack.adu) for stack in evidence.of_kind("flat")] == [4, 4, 4]
    assert ladder_of(evidence) is None
    assert report["linearity"] is None


@pytest.mark.quick(1)
@pytest.mark.parametrize(
    ("lamp", "quadratic", "told"),
    [(0.0, 0.0, True), (0.0, -0.05, True), (0.05, 0.0, False)],
    ids=["steady", "bent response", "lamp that fades"],
)
def test_levels_that_bend_without_their_noise_are_the_lamp(
    lamp: float, quadratic: float, told: bool, tmp_path: Path
) -> None:
    flats = ladder([(t, 1 - lamp * t) for t in LEVELS], 4)
    camera = Detector(
        **(CAMERA | {"shape": (160, 160)}),
        flats=flats,
        response=lambda e: e * (1 + quadratic * e / 8000),
    )
    evidence, _ = reduced(camera, 11, tmp_path)
    found = Nonlinearity.estimate(evidence)
    assert found is not None
    assert (ladder_of(evidence) is not None) == told
    assert (found.significance > 5) == (quadratic != 0)


def test_noise_says_nothing_where_the_level_is_not_known(tmp_path: Path) -> None:
    """Neither bias nor dark frames: the signal includes the bias."""
    evidence, _ = reduced(Detector(**CAMERA, flats=ladder([(t, 1) for t in LEVELS])), 1, tmp_path)
    cut_off = replace(evidence, bias=np.zeros_like(evidence.bias))
    without = replace(cut_off, stacks=evidence.of_kind("flat"))
    assert cut_off.has_level
    for one, known in ((evidence, True), (without, False)):
        assert (("photon_transfer", DETECTOR) in measure(one)) == known
        assert (transfer_curve(one) is not None) == known


def test_a_level_of_another_lamp_is_not_of_the_ladder(tmp_path: Path) -> None:
    flats = ladder([(t, 1) for t in LEVELS]) + ladder([(0.55, 1.03)], 20)
    evidence, _ = reduced(Detector(**CAMERA, flats=flats), 16, tmp_path)
    levels, found = ladder_of(evidence), Nonlinearity.estimate(evidence)
    assert levels is not None
    assert found is not None
    assert levels.off.tolist() == [0.55]
    assert levels.wander < 0.002
    assert found.significance < 3


def test_a_knee_at_the_highest_level_is_of_the_ladder(tmp_path: Path) -> None:
    camera = Detector(
        **CAMERA,
        flats=ladder([(t, 1) for t in LEVELS]),
        response=lambda e: e - 0.5 * (np.maximum(e - 0.93 * 8000, 0)),
    )
    evidence, _ = reduced(camera, 17, tmp_path)
    levels = ladder_of(evidence)
    assert levels is not None
    assert not len(levels.off)


def test_a_lamp_that_scatters_from_level_to_level_is_no_response(tmp_path: Path) -> None:
    lamps = 1 + 0.004 * np.random.default_rng(5).standard_normal(len(LEVELS))
    flats = ladder(list(zip(LEVELS, lamps, strict=True)))
    evidence, _ = reduced(Detector(**CAMERA, flats=flats), 12, tmp_path)
    levels, found = ladder_of(evidence), Nonlinearity.estimate(evidence)
    assert levels is not None
    assert found is not None
    assert 0.002 < levels.wander < 0.008
    assert found.significance < 3


def test_exposures_that_all_last_longer_are_no_response(tmp_path: Path) -> None:
    flats = ladder([(t, 1 + 0.004 / t) for t in LEVELS], 4)
    evidence, _ = reduced(Detector(**CAMERA, flats=flats), 13, tmp_path)
    found = Nonlinearity.estimate(evidence)
    assert found is not None
    assert found.significance < 3


@pytest.mark.parametrize(("share", "carried"), [(0.0, False), (0.01, False), (0.01, True)])
def test_pairs_of_flats_tell_of_charge_that_stays_behind(
    share: float, carried: bool, tmp_path: Path
) -> None:
    flats = ladder(list(zip(LEVELS, 1 + 0.001 * np.arange(12), strict=True)))
    evidence, _ = reduced(Detector(**CAMERA, flats=flats), 15, tmp_path)
    rng, stacks = np.random.default_rng(3), []
    for stack in evidence.stacks:
        adu = stack.adu - evidence.bias
        if stack.kind == "flat":
            adu *= 1 + 0.001 * rng.standard_normal((2, 1, 1))
            before = level_before(evidence, stack) / (2.3 * adu.mean()) if carried else 0.0
            adu[0] *= 1 - share * (1 - before)
        stacks.append(replace(stack, adu=(adu + evidence.bias).astype(np.float32)))
    found = Lag.estimate(replace(evidence, stacks=tuple(stacks)))
    assert found is not None
    assert isinstance(found.effect, Lag)
    assert found.effect.share == pytest.approx(share, abs=4 * found.errors["share"])
    assert found.errors["share"] < (0.002 if carried else 0.001)
    assert (found.significance > 5) == (share > 0)
    first = measure(replace(evidence, stacks=tuple(stacks)))["first_flats", DETECTOR]
    # In units of the error that the scatter of the twelve levels gives.
    assert first.value[int(carried)] < -4 if share else (abs(first.value) < 3).all()


def test_noise_that_is_cut_off_at_code_zero_is_told_of(tmp_path: Path) -> None:
    flats = ladder([(t, 1) for t in LEVELS])
    _, report = reduced(Detector(**(CAMERA | {"bias": 2.0}), flats=flats), 14, tmp_path)
    cut = [warning for warning in report["warnings"] if "cut off at code 0" in warning]
    assert len(cut) == 2
    assert "raise the black level" in cut[0]


def test_pixels_whose_noise_is_cut_off_are_simulated_with_that_noise(tmp_path: Path) -> None:
    """Pixels of the same noise differ in level, and so in the part of it that is cut off."""
    camera = CAMERA | {"bias": 3.0, "scatter": 5.0, "dark": 0.0}
    evidence, _ = reduced(Detector(**camera, flats=ladder([(1.0, 1)])), 16, tmp_path)
    noise = _pixel_noise([evidence], [{}], evidence.good)
    rng = np.random.default_rng(17)
    own = 1.0 if noise is None else noise.drawn(rng)
    bias = next(s.adu for s in evidence.stacks if s.kind == "bias")
    sigma = own * evidence.amplifier_noise / evidence.gain
    drawn = np.maximum(np.rint(rng.normal(evidence.bias, sigma, bias.shape)), 0)
    seen, simulated = (f.var(axis=0, ddof=1)[evidence.good].mean() for f in (bias, drawn))
    assert simulated == pytest.approx(seen, rel=0.04)


def test_one_bias_frame_says_nothing_of_the_noise_of_pixels(tmp_path: Path) -> None:
    evidence, _ = reduced(Detector(**CAMERA, flats=ladder([(1.0, 1)])), 16, tmp_path)
    one = [replace(s, adu=s.adu[:1]) for s in evidence.stacks if s.kind == "bias"]
    alone = replace(evidence, stacks=tuple(one))
    assert _pixel_noise([alone], [{}], evidence.good) is None


def test_a_gain_does_not_hang_on_noise_that_is_cut_off_at_code_zero(tmp_path: Path) -> None:
    """Of noise below a code hardly anything is left; the flats tell what it is, and the gain."""
    flats = ladder([(t, 1) for t in LEVELS], 10)
    camera = Detector(
        gain=45.0,
        noise=20.0,
        bias=0.0,
        top=255,
        dark=0.0,
        rate=9000.0,
        prnu=0.008,
        shape=(192, 192),
        flats=flats,
    )
    _, report = reduced(camera, 15, tmp_path)
    gain, noise = report["gain_e_per_adu"], report["read_noise_e"]
    assert gain["measured"] == pytest.approx(45.0, abs=max(0.45, 3 * gain["error"]))
    assert gain["error"] < 0.45
    assert noise["measured"] == pytest.approx(20.0, abs=min(3 * noise["error"], 1.0))


def test_saturation_is_found_and_what_is_below_it_used(tmp_path: Path) -> None:
    camera = Detector(**CAMERA, flats=ladder([(2.4 * t, 1) for t in LEVELS]))
    evidence, report = reduced(camera, 3, tmp_path)
    assert report["saturation_adu"]["found"] == report["saturation_adu"]["used"] == 4095
    left_out = report["saturation_adu"]["levels_left_out"]
    assert 4 < left_out < 8
    assert any("saturate at 4095 ADU" in warning for warning in report["warnings"])
    assert report["gain_e_per_adu"]["measured"] == pytest.approx(2.3, rel=0.02)
    assert report["linearity"]["max_deviation_percent"] < 0.2
    assert len(evidence.ladder) == len(LEVELS) - left_out
    _, plain = reduced(
        Detector(**CAMERA, flats=ladder([(t, 1) for t in LEVELS])), 3, tmp_path / "b"
    )
    assert plain["saturation_adu"]["found"] is None


def test_levels_that_some_pixels_fill_are_left_out(tmp_path: Path) -> None:
    """The brightest pixels are full, and have no photon noise, where the mean is well below."""
    camera = Detector(
        **CAMERA,
        flats=ladder([(1.1 * t, 1) for t in LEVELS], 4),
        prnu=0.03,
        response=lambda e: np.minimum(e, 8000 * 1.02),
    )
    _, report = reduced(camera, 6, tmp_path)
    # At the last but one level the usual pixel is at 0.99 of its full well, at the one before 0.89.
    assert report["saturation_adu"]["full_frames"] == list(range(4 * 10, 4 * 12))


@pytest.mark.parametrize("above", [1500, 3000])
def test_flats_that_another_amplifier_reads_are_not_compared(tmp_path: Path, above: float) -> None:
    """Bright pixels of a dual-gain camera have more read noise; the gain is that of dim ones."""
    rng = np.random.default_rng(3)
    camera = Detector(
        **CAMERA,
        flats=ladder([(t, 1) for t in LEVELS], 4),
        response=lambda e: e + (e > above) * rng.normal(0, 60, e.shape),
    )
    _, report = reduced(camera, 6, tmp_path)
    assert report["gain_e_per_adu"]["measured"] == pytest.approx(2.3, rel=0.02)
    below = sum(8000 * t < above for t in LEVELS)
    found = set(report["saturation_adu"]["frames_above_step"])
    assert set(range(4 * below, 4 * len(LEVELS))) <= found
    assert not found & set(range(4))


@pytest.mark.parametrize("fraction", [0.0, 0.5])
@pytest.mark.parametrize("noise", [0.28, 0.4])
def test_rounding_leaves_the_spread_of_the_bias(
    tmp_path: Path, noise: float, fraction: float
) -> None:
    """The mean of samples rounded to steps of twice the noise follows the level in a staircase."""
    offset = {"noise": 2.3 * noise, "scatter": 0.15, "bias": 200 + fraction, "dark": 0.0}
    camera = Detector(**CAMERA | offset, flats=ladder([(t, 1) for t in LEVELS]))
    _, report = reduced(camera, 3, tmp_path)
    found = report["figures_of_merit"]
    told = found["read_noise"]
    assert abs(told["value"] - 2.3 * noise) < 3 * told["error"] < 0.1 * told["value"]
    value, error = (found["dsnu"][key] for key in ("value", "error"))
    assert abs(value - 2.3 * 0.15) < 3 * error
    assert error < (0.02 if noise > 0.35 else 0.6) * value


def test_dim_levels_are_not_full_where_the_wells_are(tmp_path: Path) -> None:
    """At the dimmest level the read noise is as large as the signal, and outweighs the photons'."""
    well, lamps = 10_000.0, np.linspace(0.01, 1.08, 23)
    camera = Detector(
        gain=50.0,
        noise=103.0,
        bias=40.4,
        top=255,
        dark=0.0,
        rate=well,
        shape=(160, 160),
        flats=ladder([(1.0, lamp) for lamp in lamps]),
        response=lambda e: np.minimum(e, well),
    )
    _, report = reduced(camera, 3, tmp_path)
    bright = np.flatnonzero(np.repeat(lamps, 2) > 0.93).tolist()
    assert set(report["saturation_adu"]["full_frames"]) <= set(bright)
    gain = report["gain_e_per_adu"]
    assert gain["measured"] == pytest.approx(50.0, abs=3 * gain["error"])


def test_levels_of_a_steady_lamp_a_little_apart_are_levels() -> None:
    pairs = np.repeat(np.linspace(0.02, 1, 50), 2) * 3000
    pairs *= 1 + 2e-4 * np.random.default_rng(3).standard_normal(len(pairs))
    survey = FlatSurvey(pairs, None)
    assert survey.steps([0.1] * len(pairs)) == np.repeat(np.arange(50), 2).tolist()
    # Back at a level that was there before.
    again = FlatSurvey(np.array([1000, 1001, 1030, 1031, 1060, 1060.5, 1000.5, 1000.0]), None)
    assert again.steps([0.1] * 8) == [0, 0, 1, 1, 2, 2, 0, 0]


@pytest.mark.parametrize("levels", [np.linspace(2000, 1000, 41), np.full(41, 1000.0)])
def test_a_lamp_that_flickers_or_fades_is_at_one_level(levels: F64) -> None:
    flickers = levels * (1 + 1e-3 * np.random.default_rng(4).standard_normal(len(levels)))
    for seen in (levels, flickers):
        assert set(FlatSurvey(seen, None).steps([0.1] * len(levels))) == {0}


def test_full_wells_below_the_highest_code_are_no_response(tmp_path: Path) -> None:
    flats = ladder([(t, 1) for t in LEVELS], 4)
    camera = Detector(**CAMERA, flats=flats, prnu=0.03, response=lambda e: np.minimum(e, 5600.0))
    evidence, report = reduced(camera, 6, tmp_path)
    assert report["saturation_adu"]["found"] is None
    full = report["saturation_adu"]["full_frames"]
    assert set(full) >= set(range(4 * 9, 4 * 12))
    assert report["flags"]["nonlinear"] <= 0.001 * 96**2
    assert report["gain_e_per_adu"]["measured"] == pytest.approx(2.3, rel=0.02)
    assert np.std(evidence.flat[evidence.good]) == pytest.approx(0.03, rel=0.05)


def test_wells_that_end_just_below_the_highest_code_are_not_the_converters_end(
    tmp_path: Path,
) -> None:
    well = 0.98 * 2.3 * (4095 - 200.4)
    flats = ladder([(1.4 * t, 1) for t in LEVELS], 4)
    camera = Detector(**CAMERA, flats=flats, response=lambda e: np.minimum(e, well))
    _, report = reduced(camera, 6, tmp_path)
    assert report["saturation_adu"]["found"] is None
    found = report["figures_of_merit"]["saturation"]
    assert abs(well / 2.3 - found["value"]) < 1.1 * found["error"]
    said = f"the wells are full at {found['value']:.0f} ADU above bias"
    assert any(warning.startswith(said) for warning in report["warnings"])


def test_wells_that_end_where_the_converter_could_clip_noise_are_no_bent_response(
    tmp_path: Path,
) -> None:
    gain = 0.14
    well = 0.98 * gain * (65535 - 200.4)
    flats = ladder([(t, 1) for t in (0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 1.09, 1.3)], 4)
    made = {**CAMERA, "gain": gain, "top": 65535}
    camera = Detector(**made, flats=flats, response=lambda e: np.minimum(e, well))
    _, report = reduced(camera, 6, tmp_path)
    assert report["linearity"]["max_deviation_percent"] < 0.2
    found = report["figures_of_merit"]["saturation"]
    assert abs(well / gain - found["value"]) < 1.1 * found["error"]


def test_flats_with_full_wells_are_not_diagnosed() -> None:
    tables = {
        "bias": {"exptime_s": [0.0] * 4},
        "flat": {"exptime_s": [1.0] * 4 + [2.0] * 4, "step": [0] * 8},
    }
    parted = split(tables, 100, full_flats=(4, 5, 6, 7))
    both = np.concatenate([parted.learn["flat"], parted.test["flat"]])
    assert sorted(set(both.tolist())) == [0, 1, 2, 3]
    whole = split(tables, 100, full_flats=range(8))
    assert len(whole.learn["flat"]) > 0


def test_a_curve_that_all_pixels_share_is_no_defect(tmp_path: Path) -> None:
    flats = ladder([(t, 1) for t in LEVELS], 4)
    curved = Detector(**CAMERA, flats=flats, prnu=0.1, response=lambda e: e * (1 - 0.12 * e / 8000))
    _, report = reduced(curved, 4, tmp_path)
    assert report["flags"]["nonlinear"] <= 0.001 * 96**2
    assert report["linearity"]["max_deviation_percent"] > 3
    assert any("photon-transfer curve is not straight" in warning for warning in report["warnings"])
    assert any("straight line over exposure time" in warning for warning in report["warnings"])


@pytest.mark.quick(1)
@pytest.mark.parametrize("gain", [1.0, 1.06])
@pytest.mark.parametrize("quadratic", [0.0, -0.02])
def test_gain_is_told_by_noise_and_response_by_levels(gain: float, quadratic: float) -> None:
    camera = Detector(
        **(CAMERA | {"gain": 2.3 * gain, "shape": (128, 128)}),
        flats=[*ladder([(t, 1) for t in LEVELS], 6), (0.52, 60, 1)],
        response=lambda e: e * (1 + quadratic * e / 8000),
    )
    arrays, tables = camera.frames(7)
    declared = replace(camera, gain=2.3).described()
    raw = RawFrames(declared, arrays, tables, reduce.Config())
    evidence = evidence_of(raw, whole_of(camera.shape), camera.shape)
    of_gain, response = GainError.estimate(evidence), Nonlinearity.estimate(evidence)
    assert of_gain is not None
    assert response is not None
    error = of_gain.errors["relative"]
    assert error < 0.008
    assert of_gain.effect.relative == pytest.approx(gain - 1, abs=4 * error)
    assert (response.significance > 10) == (quadratic != 0)
    assert isinstance(response.effect, Nonlinearity)
    at_top = response.effect.response(np.array([8000.0], np.float32))[0] / 8000 - 1
    assert at_top == pytest.approx(quadratic, abs=2e-3)


def test_row_noise_with_a_repeat_shows_at_its_distance(tmp_path: Path) -> None:
    evidence, _ = reduced(Detector(**CAMERA), 8, tmp_path)
    rng = np.random.default_rng(1)
    stacks = []
    for stack in evidence.stacks:
        shared = 4 * rng.standard_normal((len(stack.adu), 24, 1, 2, 1))
        rows = np.broadcast_to(shared, (len(stack.adu), 24, 2, 2, 1)).reshape(-1, 96, 1)
        stacks.append(replace(stack, adu=(stack.adu + rows).astype(np.float32)))
    before, after = measure(evidence), measure(replace(evidence, stacks=tuple(stacks)))
    for kind in ("bias", "dark"):
        # Rows, one to four apart: every second one is alike in half of the pairs.
        plain, repeated = (m[f"{kind}_line_repeats", DETECTOR].value for m in (before, after))
        assert np.abs(plain).max() < 0.4
        assert repeated[1] > 10
        assert np.abs(repeated[[0, 2, 4, 5, 6, 7]]).max() < 0.3 * repeated[1]
        # Noise of whole rows is no coupling of their pixels.
        names = f"{kind}_neighbours", f"{kind}_far_neighbours"
        correlation = np.concatenate([after[name, DETECTOR].value for name in names])
        for step in ((2, 0), (0, 1)):
            assert abs(correlation[STEPS.index(step)]) < 0.01


@pytest.mark.parametrize("stated", [10.0, 0.0004])
def test_a_flat_whose_light_contradicts_its_exposure_time_is_left_out(stated: float) -> None:
    times = np.repeat([0.004, 0.02, 0.1, 0.3, 0.5, 0.7, 1.3], 2)
    levels = np.minimum(4000 * times, 3800)  # the last are full
    right = times.copy()
    assert not FlatSurvey(levels, None).mistimed([*right]).any()
    times[0] = stated
    np.testing.assert_array_equal(np.flatnonzero(FlatSurvey(levels, None).mistimed([*times])), [0])
    # A lamp that is set anew for each exposure time contradicts none, nor do unknown times.
    set_anew = levels * np.repeat([1, 3, 0.5, 1, 2, 0.2, 1], 2)
    assert not FlatSurvey(set_anew, None).mistimed([*right]).any()
    assert not FlatSurvey(levels, None).mistimed([None] * len(levels)).any()
