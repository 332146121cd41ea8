"""Bias drift: frames move as given, and it is told from noise of rows, columns and light."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.bias_drift import BiasDrift
from pixcal.effects.row_noise import RowNoise
from pixcal.estimators.detector.noiseless_charge import noiseless_level
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.offset import FEWEST, fringe_offsets, unlit_stacks
from pixcal.kernels.processes import brownian
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect, FringeMaps
from pixcal.simulation.recording import recordings
from pixcal.simulation.track import Track

Offset = Callable[[np.ndarray], np.ndarray]


def in_the_dark(evidence: Evidence, bench: Bench, *on: Effect) -> Evidence:
    """The same evidence with bias and dark frames made anew, and no others."""
    made = {r.kind: r for r in recordings(bench)}
    stacks = []
    for stack in evidence.stacks:
        if stack.kind in ("bias", "dark"):
            r = made[stack.kind]
            frames = frames_of(bench, r, on).astype(np.float32)
            time = np.arange(r.count) * r.period_s
            stacks.append(replace(stack, adu=frames, time_s=time, start_s=r.start_s))
    return replace(evidence, stacks=tuple(stacks), fringes={})


def levelled(
    evidence: Evidence, rng: np.random.Generator, offset: Offset, **count: int
) -> Evidence:
    """Bias and dark frames of read noise (some of rows) with an offset (e-) by their times."""
    stacks = []
    for stack in evidence.stacks:
        n = count.get(stack.kind, 0)
        if n:
            start, step = {"bias": (0.0, 0.14), "dark": (8.4, 0.5)}[stack.kind]
            stacks.append((stack, start, step * np.arange(n)))
    levels = offset(np.concatenate([start + time for _, start, time in stacks]))
    made = []
    for stack, start, time in stacks:
        adu = rng.normal(0, 16, (len(time), *evidence.good.shape))
        adu += rng.normal(0, 1, (len(time), evidence.good.shape[0], 1))
        own, levels = levels[: len(time)], levels[len(time) :]
        adu = (adu + own[:, None, None]).astype(np.float32)
        made.append(replace(stack, adu=adu, time_s=time, start_s=start))
    return replace(evidence, stacks=tuple(made), fringes={})


def walking(rng: np.random.Generator, walk: float) -> Offset:
    def offset(time: np.ndarray) -> np.ndarray:
        steps = np.sqrt(np.diff(time, prepend=0.0) / 3600)
        return np.asarray(walk * np.cumsum(steps * rng.standard_normal(len(time))))

    return offset


def test_the_walk_spreads_with_the_root_of_time_and_remembers() -> None:
    times = (3.0, 50.0, 7200.0)
    walks = np.empty((1500, len(times)))
    for seed in range(len(walks)):
        drawn: dict[tuple[int, int], float] = {}
        rng = np.random.default_rng(seed)

        def normal(
            level: int,
            place: int,
            drawn: dict[tuple[int, int], float] = drawn,
            rng: np.random.Generator = rng,
        ) -> float:
            return drawn.setdefault((level, place), float(rng.standard_normal()))

        walks[seed] = [brownian(t, normal) for t in times]
    expected = np.minimum.outer(times, times)
    scale = np.sqrt(np.outer(times, times))
    covariance = walks.T @ walks / len(walks)
    np.testing.assert_allclose(covariance / scale, expected / scale, atol=4 * np.sqrt(2 / 1500))


def test_frames_move_as_a_whole_through_all_recordings(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench({"detector.gain_e_per_adu": 0.5})
    effect = BiasDrift(0.0, 3600.0, 0.0, -200.0, 4.0)
    for recording in recordings(bench):
        if recording.kind not in ("bias", "dark"):
            continue
        change = frames_of(bench, recording, [effect]).astype(float) - frames_of(bench, recording)
        time = recording.start_s + np.arange(recording.count) * recording.period_s
        expected = (time - 200 * np.exp(-time / 4.0)) / 0.5
        # Samples are cut at zero where they would fall below.
        seen = expected > -400
        assert seen.any()
        np.testing.assert_allclose(change.mean(axis=(1, 2))[seen], expected[seen], atol=0.05)


def test_the_walk_goes_on_from_recording_to_recording(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench, effect = make_effect_bench(), BiasDrift(0.0, 0.0, 600.0, 0.0)
    found = [r for r in recordings(bench) if r.kind in ("bias", "dark")]
    ends = [
        [
            effect.offset(r.start_s + n * r.period_s, bench.seed, r.rng("bias_drift", n))
            for n in range(r.count)
        ]
        for r in found
    ]
    step = 10.0 * np.sqrt(0.14)
    assert abs(ends[1][0] - ends[0][-1]) < 4 * step
    assert np.diff(ends[0]).std() == pytest.approx(step, rel=4 / np.sqrt(2 * 59))


@pytest.mark.parametrize("jitter", [0.6, 2.0, 20.0])
def test_jitter_is_found(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench], jitter: float
) -> None:
    effect = BiasDrift(jitter, 0.0, 0.0, 0.0)
    found = BiasDrift.estimate(in_the_dark(acquired(), make_effect_bench(), effect))
    assert found is not None
    assert isinstance(found.effect, BiasDrift)
    assert found.errors["jitter_rms"] < 0.15 * jitter
    assert abs(found.effect.jitter_rms - jitter) < 4 * found.errors["jitter_rms"]
    assert found.significance > 5
    assert found.effect.walk_e_h < 4 * found.errors["walk_e_h"]
    assert abs(found.effect.ramp_e_h) < 4 * found.errors["ramp_e_h"]


def test_a_ramp_is_found(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    effect = BiasDrift(0.0, 3000.0, 0.0, 0.0)
    found = BiasDrift.estimate(in_the_dark(acquired(), make_effect_bench(), effect))
    assert found is not None
    assert isinstance(found.effect, BiasDrift)
    assert abs(found.effect.ramp_e_h - 3000) < 4 * found.errors["ramp_e_h"] < 2000
    assert found.significance > 5


def test_a_walk_is_found(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    effect = BiasDrift(0.0, 0.0, 120.0, 0.0)
    found = BiasDrift.estimate(in_the_dark(acquired(), make_effect_bench(), effect))
    assert found is not None
    assert isinstance(found.effect, BiasDrift)
    assert abs(found.effect.walk_e_h - 120) < 4 * found.errors["walk_e_h"] < 100
    assert found.significance > 5


@pytest.mark.long
@pytest.mark.parametrize("count", [{"bias": 29}, {"bias": 29, "dark": 11}])
def test_what_a_walk_explains_as_well_is_no_ramp(
    acquired: Callable[..., Evidence], count: dict[str, int]
) -> None:
    evidence, rng, walk = acquired(), np.random.default_rng(12), 200.0
    pulls, ramps = [], 0
    for _ in range(60):
        found = BiasDrift.estimate(levelled(evidence, rng, walking(rng, walk), **count))
        assert found is not None
        assert isinstance(found.effect, BiasDrift)
        pulls.append((found.effect.walk_e_h - walk) / found.errors["walk_e_h"])
        ramps += found.effect.ramp_e_h != 0
    assert ramps <= 2
    assert abs(np.mean(pulls)) < 1
    assert np.std(pulls) < 1.5
    steady = BiasDrift.estimate(levelled(evidence, rng, lambda t: 2.0 * t, **count))
    assert steady is not None
    assert isinstance(steady.effect, BiasDrift)
    assert steady.effect.ramp_e_h == pytest.approx(7200, abs=4 * steady.errors["ramp_e_h"])


@pytest.mark.long
def test_few_frames_count_and_nothing_in_them_is_nothing(acquired: Callable[..., Evidence]) -> None:
    evidence, rng = acquired(), np.random.default_rng(14)
    seen = []
    for _ in range(60):
        found = BiasDrift.estimate(levelled(evidence, rng, np.zeros_like, dark=FEWEST))
        assert found is not None
        seen.append(found.significance)
    assert np.mean(np.array(seen) > 1.645) < 0.12
    assert max(seen) < 3.5
    fewer = levelled(evidence, rng, np.zeros_like, dark=FEWEST - 1)
    assert BiasDrift.estimate(fewer) is None


def test_a_settling_is_found(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    effect = BiasDrift(0.2, 0.0, 0.0, 8.0, 3.0)
    evidence = in_the_dark(acquired(), make_effect_bench(), effect)
    found = BiasDrift.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, BiasDrift)
    assert abs(found.effect.settle_e - 8) < 4 * found.errors["settle_e"] < 4
    assert abs(found.effect.settle_s - 3) < 4 * found.errors["settle_s"] < 3
    assert found.significance > 5
    # By time constants that are not refined.
    assert BiasDrift.detect(evidence) == pytest.approx(found.significance, rel=0.1)


def test_row_and_column_noise_is_not_taken_for_it(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    noise = RowNoise(5.0, 2.0, 2.0, 5.0)
    found = BiasDrift.estimate(in_the_dark(acquired(), make_effect_bench(), noise))
    assert found is not None
    assert found.significance < 4
    both = BiasDrift.estimate(
        in_the_dark(acquired(), make_effect_bench(), noise, BiasDrift(3.0, 0.0, 0.0, 0.0))
    )
    assert both is not None
    assert isinstance(both.effect, BiasDrift)
    assert abs(both.effect.jitter_rms - 3) < 4 * both.errors["jitter_rms"] < 2
    assert both.significance > 5


@pytest.mark.long
def test_light_that_changes_is_not_taken_for_it(acquired: Callable[..., Evidence]) -> None:
    found = BiasDrift.estimate(acquired(None, {"intensity_noise": {"rms": 0.02}}))
    assert found is not None
    assert found.significance < 4


def test_fringes_hold_what_is_no_light(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired()
    fringes = evidence.fringes["vertical"]
    offsets = np.random.default_rng(4).normal(0, 3000, len(fringes.g)).astype(np.float32)
    pattern = (1 / evidence.flat).astype(np.float32)
    moved = replace(fringes, electrons=fringes.electrons + offsets[:, None, None] * pattern)
    before, after = (fringe_offsets(f, evidence.flat) for f in (fringes, moved))
    assert before is not None
    assert after is not None
    # Linear: the offset itself, whatever the noise.
    np.testing.assert_allclose((after.values - before.values)[:, 0], offsets, rtol=0.02, atol=20)
    # And the noise is what is foreseen.
    assert before.values[:, 0].var() == pytest.approx(before.noise[0], rel=6 / np.sqrt(2 * 300))


def test_fringes_of_even_light_alone_say_nothing(acquired: Callable[..., Evidence]) -> None:
    assert BiasDrift._through(replace(acquired(), stacks=())) is None


def test_evidence_tells_when_each_part_began(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    begun = {r.stem: r.start_s for r in recordings(make_effect_bench())}
    evidence = acquired()
    for fringes in evidence.fringes.values():
        assert fringes.start_s == pytest.approx(begun[fringes.name], abs=2e-3)
    for stack in evidence.stacks:
        if stack.kind != "flat":
            stem = {"bias": "bias", "dark": "dark-0"}[stack.kind]
            assert stack.start_s == pytest.approx(begun[stem], abs=2e-3)


RUN = {"jitter_rms": 0.0, "ramp_e_h": 0.0, "walk_e_h": 0.0, "settle_e": 0.0}


@pytest.mark.long
def test_a_walk_of_the_fringe_runs_alone_is_found(acquired: Callable[..., Evidence]) -> None:
    """The mean light moves, the fringe amplitude does not, and bias frames know nothing of it."""
    evidence = acquired(None, {"bias_drift": RUN | {"run_walk_e_h": 600.0}})
    found = BiasDrift.estimate(evidence)
    assert found is not None
    assert isinstance(found.effect, BiasDrift)
    assert found.significance > 8
    assert BiasDrift.detect(evidence) == pytest.approx(found.significance)
    # Of two runs a walk shows its size in few modes.
    assert found.effect.run_walk_e_h == pytest.approx(600, rel=0.5)
    assert found.effect.walk_e_h == 0
    again = found.effect.replayed(evidence)
    assert again is not None
    assert {track.set for track in again.tracks} == {
        *evidence.fringes,
        "bias frames",
        "dark frames",
    }


@pytest.mark.long
def test_a_ramp_that_begins_anew_with_each_run_is_found(acquired: Callable[..., Evidence]) -> None:
    found = BiasDrift.estimate(acquired(None, {"bias_drift": RUN | {"run_ramp_e_h": -4000.0}}))
    assert found is not None
    assert isinstance(found.effect, BiasDrift)
    assert found.law == "ramp in each fringe set"
    assert found.significance > 8
    error = found.errors["run_ramp_e_h"]
    assert error < 800
    assert abs(found.effect.run_ramp_e_h + 4000) < 4 * error


@pytest.mark.long
@pytest.mark.quick(1)
@pytest.mark.parametrize("other", ["intensity_noise", "contrast_noise"])
def test_light_that_changes_is_no_drift_of_the_runs(
    acquired: Callable[..., Evidence], other: str
) -> None:
    found = BiasDrift._in_runs(acquired(None, {other: {}}))
    assert found is not None
    assert found.significance < 4


@pytest.mark.long
def test_power_and_contrast_that_change_together_are_no_drift(
    acquired: Callable[..., Evidence],
) -> None:
    """As where a laser's mode hops: pixels of larger response change by more."""
    hops = np.random.default_rng(5).random(60) < 0.1
    mode = np.repeat(np.cumsum(hops) % 2, 2).astype(float)

    def tracks(change: float) -> list[dict[str, Any]]:
        return [
            {
                "set": s,
                "time_s": np.linspace(0, 50, 120).tolist(),
                "value": list(map(float, change * mode)),
            }
            for s in ("vertical", "horizontal")
        ]

    on = {"rms": 0.0, "tracks": tracks(0.03), "contrast_tracks": tracks(-0.05)}
    found = BiasDrift.estimate(acquired(None, {"intensity_noise": on}))
    assert found is None or found.significance < 4


def test_tracks_are_replayed(make_effect_bench: Callable[..., Bench]) -> None:
    bench = make_effect_bench({"detector.shape": [20, 24]})
    track = Track("vertical", (0.0, 20.0), (0.0, 100.0))
    drift = BiasDrift(**RUN, tracks=(track,))
    for r in recordings(bench):
        plain, on = (frames_of(bench, r, e).mean(axis=(1, 2)) for e in ((), (drift,)))
        time = r.period_s * np.arange(r.count)
        wanted = np.interp(time, track.time_s, track.value) * (r.folder == "vertical")
        np.testing.assert_allclose(on - plain, wanted, atol=0.1)


@pytest.mark.long
def test_a_track_takes_the_place_of_the_laws_in_its_run_alone(
    make_effect_bench: Callable[..., Bench],
) -> None:
    bench = make_effect_bench({"detector.shape": [20, 24]})
    law = BiasDrift(
        **RUN | {"ramp_e_h": 1e4, "walk_e_h": 300.0, "run_walk_e_h": 300.0, "run_ramp_e_h": 1e4}
    )
    both = replace(law, tracks=(Track("vertical", (0.0,), (50.0,)),))
    for r in recordings(bench):
        plain, by_law, on = (frames_of(bench, r, e) for e in ((), (law,), (both,)))
        if r.folder == "vertical":
            np.testing.assert_allclose((on - plain).mean(axis=(1, 2)), 50, atol=0.1)
        else:
            np.testing.assert_array_equal(on, by_law)
            assert np.ptp((on - plain).mean(axis=(1, 2))) > 1


def test_offsets_of_bias_and_dark_frames_are_replayed_as_they_were(
    acquired: Callable[..., Evidence], make_effect_bench: Callable[..., Bench]
) -> None:
    """Frame by frame: those of bias frames may walk faster than those of other runs."""
    rng = np.random.default_rng(3)
    truth = {"bias": rng.normal(0, 9, 40).cumsum(), "dark": rng.normal(0, 2, 20)}
    every = levelled(
        acquired(), rng, lambda t: np.concatenate(list(truth.values())), bias=40, dark=20
    )
    again = BiasDrift(**RUN).replayed(every)
    assert again is not None
    bench = make_effect_bench({"frames.bias": 40})
    for r in recordings(bench):
        if r.kind not in truth:
            continue
        plain, on = (frames_of(bench, r, e).mean(axis=(1, 2)) for e in ((), (again,)))
        wanted = truth[r.kind] - truth[r.kind].mean()
        step = {"bias": 0.14, "dark": 0.5}[r.kind]
        assert r.period_s == pytest.approx(step)
        np.testing.assert_allclose(on - plain, wanted, atol=1.0)


@pytest.mark.long
@pytest.mark.parametrize("jitter", [0.0, 20.0])
def test_the_jitter_of_a_replay_is_that_of_the_fringes(
    acquired: Callable[..., Evidence], jitter: float
) -> None:
    """Not what few bias frames passed for jitter."""
    truth = RUN | {"jitter_rms": jitter, "run_walk_e_h": 600.0}
    again = BiasDrift(**RUN | {"jitter_rms": 90.0}).replayed(acquired(None, {"bias_drift": truth}))
    assert again is not None
    assert again.jitter_rms == pytest.approx(jitter, rel=0.15, abs=3)


@pytest.mark.long
def test_the_level_of_an_offset_shows_in_the_shot_noise_it_lacks(
    acquired: Callable[..., Evidence],
) -> None:
    evidence = acquired(
        None,
        {"bias_drift": {**RUN, "tracks": [{"set": "vertical", "time_s": [0.0], "value": [900.0]}]}},
    )
    level, error = noiseless_level(evidence, evidence.fringes["vertical"])
    none, _ = noiseless_level(evidence, evidence.fringes["horizontal"])
    assert error < 200
    assert abs(level - 900) < 4 * error
    assert abs(none) < 4 * error


def test_light_alone_has_no_level_without_noise(acquired: Callable[..., Evidence]) -> None:
    """What the fit of each pixel takes up of the noise of dark samples is allowed for.

    It would pass for an offset of three over the number of frames of the harmonic mean signal.
    """
    off = []
    for visibility in (None, {"optics.visibility": 0.9}):
        evidence = acquired(visibility, {})
        off += [noiseless_level(evidence, fringes) for fringes in evidence.fringes.values()]
    pulls = [level / error for level, error in off]
    assert np.mean([level for level, _ in off]) < 3 * np.hypot.reduce([e for _, e in off]) / 4
    assert max(map(abs, pulls)) < 3


def test_late_charge_is_no_level(acquired: Callable[..., Evidence]) -> None:
    evidence = acquired(None, {"lag": {"share": 0.01, "decay_frames": 0.6}})
    for fringes in evidence.fringes.values():
        level, error = noiseless_level(evidence, fringes)
        assert abs(level) < 3 * error


def test_the_level_of_a_replayed_run_is_no_light() -> None:
    drift = BiasDrift(**RUN, tracks=(Track("vertical", (0.0, 20.0), (100.0, 300.0)),))
    theta, flat = np.full((3, 4, 5), 5000.0), np.full((4, 5), 0.8)
    maps = FringeMaps(theta, (0.6, 0.0), (0, 0), flat, "vertical")
    undone = drift.undo(maps)
    assert undone is not None
    np.testing.assert_allclose(undone.theta[0], 5000 - 200 / 0.8)
    np.testing.assert_array_equal(undone.theta[1:], theta[1:])
    # The other set had no offset, or is not known to have had one.
    same = drift.undo(replace(maps, name="horizontal"))
    assert same is not None
    np.testing.assert_array_equal(same.theta, theta)
    twice = replace(drift, tracks=2 * drift.tracks).undo(maps)
    assert twice is not None
    np.testing.assert_allclose(twice.theta[0], 5000 - 400 / 0.8)
    in_the_dark = replace(drift, tracks=(replace(drift.tracks[0], set="bias frames"),))
    assert in_the_dark.undo(maps) is None


def test_frames_without_light_that_follow_light_are_left_out(
    acquired: Callable[..., Evidence],
) -> None:
    """Their level may fall for many frames, as charge of the light before is released."""
    evidence = acquired(None, {})
    assert {s.kind for s in unlit_stacks(evidence, "bias", "dark")} == {"bias", "dark"}
    last = max(float(s.start_s + s.time_s[-1]) for s in evidence.of_kind("flat"))
    moved = tuple(
        replace(s, start_s=last + 0.1) if s.kind == "dark" else s for s in evidence.stacks
    )
    after = replace(evidence, stacks=moved)
    assert {s.kind for s in unlit_stacks(after, "bias", "dark")} == {"bias"}
    # Without time stamps, nothing is known to be before.
    unknown = tuple(replace(s, start_s=np.nan) for s in moved)
    found = unlit_stacks(replace(evidence, stacks=unknown), "bias", "dark")
    assert {s.kind for s in found} == {"bias", "dark"}
