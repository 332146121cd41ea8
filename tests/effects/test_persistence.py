"""Charge that comes out of traps in frames without light: found again, and simulated so."""

import re
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from all_frames import frames_of

from pixcal.effects.lag import Lag
from pixcal.estimators.detector.emva import dark_slope
from pixcal.estimators.detector.persistence import persistence, released_late
from pixcal.estimators.diagnosis.evidence import Evidence, Stack
from pixcal.model.arrays import F32
from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.recording import recordings
from pixcal.stages.advice import size_of
from pixcal.stages.diagnose.frames import in_series
from pixcal.stages.reduce.dark_current import DarkLevels, LateRate, late_rate
from pixcal.stages.reduce.exposures import group_exposures
from pixcal.stages.reduce.ingested import Ingested

BIAS, READ_NOISE, SHAPE = 300.0, 6.0, (37, 41)
DEAD_S = 1.5  # between frames


def recorded(
    share: float,
    kept: Callable[[float], float],
    pause: float = 0.0,
    stamp: float = 0.0,
    repeats: int = 0,
    slow: tuple[float, Callable[[float], float]] | None = None,
) -> Evidence:
    """Bias, flats and darks of a camera whose traps hold whole electrons.

    ``kept``: part of the held charge that stays after a time, s; ``pause``: before the darks, s;
    ``stamp``: unit of the time stamps, s; ``repeats``: flats of the first level at the end of them;
    ``slow``: share and kept part of a second kind of traps.
    """
    rng = np.random.default_rng(3)
    kinds = [(share, kept), *([slow] if slow else [])]
    held, clock, stacks = [np.zeros(SHAPE, int) for _ in kinds], 0.0, []
    series = [("bias", 0.0, 0.0, 8), *(("flat", t, 4000 * t, 6) for t in (0.5, 2.0, 6.0))]
    series += [("flat", 0.5, 2000.0, repeats)] * bool(repeats)
    for kind, seconds, light, count in [*series, ("dark", 10.0, 0.0, 12)]:
        frames, times = [], []
        if kind == "dark" and pause:
            held = [rng.binomial(n, of(pause)) for n, (_, of) in zip(held, kinds, strict=True)]
            clock += pause
        for _ in range(count):
            charge = signal = rng.poisson(light, SHAPE)
            for own, (part, of) in zip(held, kinds, strict=True):
                released = rng.binomial(own, 1 - of(seconds + DEAD_S))
                taken = rng.binomial(charge, part)
                own += taken - released
                signal = signal - taken + released
            frames.append(BIAS + signal + rng.normal(0, READ_NOISE, SHAPE))
            times.append(clock)
            clock += seconds + DEAD_S
        time = np.floor(np.array(times) / stamp) * stamp if stamp else np.array(times)
        start, number = time[0], np.arange(count)
        if repeats and kind == "flat" and len(stacks) == 4:
            start, frames = stacks[1].start_s, [*stacks[1].adu, *frames]
            time = np.concatenate([start + stacks[1].time_s, time])
            number = np.arange(len(frames))
            del stacks[1]
        stacks.append(Stack(kind, seconds, number, time - start, np.array(frames), start))
    maps = {"bias": np.full(SHAPE, BIAS), "dark_rate": np.zeros(SHAPE), "flat": np.ones(SHAPE)}
    noise, good = (READ_NOISE, READ_NOISE), np.ones(SHAPE, np.bool_)
    rest = {"saturation_adu": 65535, "pitch_um": 5.0, "wavelength_nm": 600.0, "distance_mm": 400.0}
    return Evidence({}, tuple(stacks), 1.0, *noise, **maps, good=good, **rest)


@pytest.mark.parametrize(
    ("decay", "in_seconds", "pause", "stamp"),
    [
        (0.8, False, 0, 0),
        (3.0, False, 0, 1),
        (15.0, True, 0, 0),
        (50.0, True, 0, 0),
        (50.0, True, 60, 1),
    ],
)
def test_traps_are_found_again_by_frames_or_by_time(
    decay: float, in_seconds: bool, pause: float, stamp: float
) -> None:
    evidence = recorded(
        0.01, lambda t: float(np.exp(-(t if in_seconds else 1) / decay)), pause, stamp
    )
    found = persistence(evidence)
    assert found is not None
    assert found.in_seconds == in_seconds
    assert found.slow_part == 0
    assert abs(found.share - 0.01) < 4 * found.share_error < 1e-3
    assert abs(found.decay - decay) < 4 * found.decay_error < 0.4 * decay
    estimate = Lag.estimate(evidence)
    assert estimate is not None
    assert isinstance(estimate.effect, Lag)
    assert (estimate.effect.decay_s > 0) == in_seconds
    assert estimate.significance > 20
    # What is told names the share and the decay.
    told = size_of({"size": estimate.size})
    words = re.fullmatch(r"(\S+) ± \S+ % of the signal, decays over (\S+) (\w+)", told)
    assert words is not None, told
    share, decays, unit = words.groups()
    assert float(share) == pytest.approx(100 * found.share, rel=0.01)
    assert float(decays) == pytest.approx(found.decay, rel=0.05)
    assert unit == ("s" if in_seconds else "frames")


def test_bias_frames_without_time_stamps_hide_no_charge_of_traps() -> None:
    """Light may have come at any time of flats without them; bias frames are placed first."""
    whole = recorded(0.01, lambda t: float(np.exp(-t / 50)))
    found = []
    for kind in ("bias", "flat"):
        stacks = [replace(s, start_s=np.nan) if s.kind == kind else s for s in whole.stacks]
        found.append(persistence(replace(whole, stacks=tuple(stacks))))
    assert found[0] is not None
    assert abs(found[0].share - 0.01) < 4 * found[0].share_error < 1e-3
    assert found[1] is None


def test_flats_of_the_first_level_may_be_repeated_at_the_end() -> None:
    found = persistence(recorded(0.01, lambda t: float(np.exp(-t / 50)), repeats=4))
    assert found is not None
    assert abs(found.share - 0.01) < 4 * found.share_error < 1e-3
    assert abs(found.decay - 50) < 4 * found.decay_error < 20


def test_traps_of_two_kinds_are_found_again() -> None:
    fast, slow = (lambda t, decay=decay: float(np.exp(-t / decay)) for decay in (8.0, 80.0))
    evidence = recorded(0.03, fast, slow=(0.02, slow))
    found = persistence(evidence)
    assert found is not None
    assert abs(found.share - 0.05) < 4 * found.share_error < 0.01
    assert abs(found.slow_part - 0.4) < 4 * found.slow_part_error < 0.1
    assert abs(found.decay - 8) < 4 * found.decay_error < 2
    assert abs(found.slow - 80) < 4 * found.slow_error < 30
    estimate = Lag.estimate(evidence)
    assert estimate is not None
    assert re.search(r"decays over 8\S* s and, 4\S* % of it, [78]\S* s$", estimate.size["of"])
    (slope, _), late = dark_signal(evidence)
    assert late is not None
    assert abs(slope - late.rate) < 4 * late.error < 0.1 * slope
    assert re.search(
        r"over 8\S* s and [78]\S* s: .* darks [34]\d\d s or more", late.warning("e-/s")
    )


class Samples:
    """Frames (t, y, x) in memory, read as from a store."""

    def __init__(self, frames: F32) -> None:
        self.frames = frames

    def read(self, numbers: tuple[int, int], y: tuple[int, int], x: tuple[int, int]) -> F32:
        return self.frames[slice(*numbers), slice(*y), slice(*x)]


def dark_signal(evidence: Evidence) -> tuple[tuple[float, float], LateRate | None]:
    """Of frames as the reduction reads them, e-/s: with late charge and its error; that charge."""
    tables, arrays = {}, {}
    for kind in ("bias", "dark", "flat"):
        own = [s for s in evidence.stacks if s.kind == kind]
        time = np.concatenate([s.start_s + s.time_s for s in own])
        tables[kind] = {
            "exptime_s": np.concatenate([[s.exptime_s] * len(s.adu) for s in own]).tolist(),
            "time_s": (time - time[0]).tolist(),
            "mjd": (60_000 + time / 86400).tolist(),
        }
        arrays[kind] = Samples(np.concatenate([s.adu for s in own]))
    exposures = group_exposures(tables)
    source = cast(Ingested, SimpleNamespace(tables=tables, arrays=arrays, exposures=exposures))
    levels = DarkLevels.of(source, ((0, SHAPE[0]), (0, SHAPE[1])), evidence.good)
    slope = dark_slope(levels.times, levels.means)
    assert slope is not None
    return slope, late_rate(source, levels, 1.0, READ_NOISE)


@pytest.mark.parametrize("decay", [15.0, 50.0])
def test_dark_signal_of_darks_after_light_is_given_without_what_that_left(decay: float) -> None:
    """The camera has no dark signal: all that the darks hold is late."""
    (slope, _), late = dark_signal(recorded(0.01, lambda t: float(np.exp(-t / decay))))
    assert late is not None
    assert abs(slope - late.rate) < 4 * late.error < 0.1 * slope
    assert late.sure
    assert f"decays over {decay:.0f} s" in late.warning("e-/s")
    assert "e-/exposure of it" in late.warning("e-/exposure")
    clean, none = dark_signal(recorded(0.0, lambda _: 0.0))
    assert none is None
    assert abs(clean[0]) < 4 * clean[1]


def changed(evidence: Evidence, change: Callable[[Stack], F32]) -> Evidence:
    return replace(evidence, stacks=tuple(replace(s, adu=change(s)) for s in evidence.stacks))


def test_missing_samples_do_not_shift_the_levels() -> None:
    pattern = np.linspace(0, 500, SHAPE[0])[:, None]

    def whole_of(stack: Stack) -> F32:
        return np.array(stack.adu + pattern)

    def lacking_one(stack: Stack) -> F32:
        adu = whole_of(stack)
        adu[1, 5, 7] = np.nan
        return adu

    def lacking(stack: Stack) -> F32:
        adu = whole_of(stack)
        if stack.kind == "flat":
            adu[1, 5, 7] = np.nan
        if stack.kind == "dark":
            adu[3, :20], adu[6] = np.nan, np.nan
        return adu

    evidence = recorded(0.01, lambda t: float(np.exp(-t / 50)))
    whole, found = (persistence(changed(evidence, change)) for change in (whole_of, lacking_one))
    assert whole is not None
    assert found is not None
    assert found.share == pytest.approx(whole.share, abs=whole.share_error)
    (slope, _), late = dark_signal(changed(evidence, lacking))
    assert late is not None
    assert late.sure
    assert abs(slope - late.rate) < 4 * late.error < 0.1 * slope


@pytest.mark.parametrize("settles", [50.0, 100.0, 200.0])
def test_a_bias_that_settles_is_told_from_charge_of_light(settles: float) -> None:
    """The same fall of the darks: before light, the bias frames fall too."""
    evidence = recorded(0.0, lambda _: 0.0)

    def settling(stack: Stack) -> F32:
        time = stack.start_s + stack.time_s
        return stack.adu + (40 * np.exp(-time / settles))[:, None, None]

    _, late = dark_signal(changed(evidence, settling))
    assert late is not None
    assert not late.sure
    assert "or a drift of the bias; record darks before the light" in late.warning("e-/s")


def test_a_camera_without_traps_has_none() -> None:
    assert persistence(recorded(0.0, lambda _: 0.0)) is None
    assert persistence(recorded(0.0, lambda _: 0.0, stamp=60.0)) is None


@pytest.mark.parametrize("slow", [0.0, 0.4])
def test_darks_after_flats_hold_what_came_out_by_then_with_its_shot_noise(
    make_effect_bench: Callable[..., Bench], slow: float
) -> None:
    """Levels by the sum over all earlier frames; the variance is that of single electrons."""
    changes = {
        "detector.shape": [61, 64],
        "detector.dark_e_s": 0.0,
        "detector.read_noise_e": 0.0,
        "detector.prnu_rms": 0.0,
        "frames.flats": [{"exptime_s": 0.05, "count": 3}, {"exptime_s": 0.1, "count": 5}],
    }
    bench, lag = make_effect_bench(changes), Lag(0.05, spread=0.0, carried=1.0, decay_s=0.4)
    kinds = ((1 - slow, 0.4), (slow, 1.5))
    lag = replace(lag, slow_part=slow, slow_s=1.5)
    first, second = (r for r in recordings(bench) if r.kind == "flat")
    dark = next(r for r in recordings(bench) if r.kind == "dark")
    start = second.start_s + second.count * second.period_s
    second = replace(second, before=first)
    dark = replace(dark, before=second, start_s=start, count=4)
    adu = frames_of(bench, dark, [lag]).astype(float) - frames_of(bench, dark).astype(float)
    made = adu * bench.detector.gain_e_per_adu
    begins = [
        (r.start_s + (n + 1) * r.period_s, r.electrons)
        for r in (first, second)
        for n in range(r.count)
    ]
    for n, frame in enumerate(made):
        at = start + n * dark.period_s
        expected = sum(
            q * 0.05 * part * np.exp(-(at - t) / decay) * (1 - np.exp(-dark.period_s / decay))
            for t, q in begins
            for part, decay in kinds
        )
        few = 5 * np.sqrt(expected / frame.size)
        assert frame.mean() == pytest.approx(expected, abs=few + 0.003 * expected)
        assert frame.var() == pytest.approx(expected, rel=0.2)


def table(*days: float, seconds: float = 1.0) -> dict[str, list[float]]:
    time = [86400 * (day - days[0]) for day in days]
    return {"exptime_s": [seconds] * len(days), "mjd": list(days), "time_s": time}


def test_light_divides_darks_that_follow_it_at_once() -> None:
    minute = 1 / 1440
    before, after = [n * minute for n in range(5)], [(20 + n) * minute for n in range(4)]
    late = [(400 + n) * minute for n in range(4)]
    flats = table(*((10 + n) * minute for n in range(8)), seconds=3.0)
    found = in_series({"dark": table(*before, *after, *late), "flat": flats})
    assert found["dark"]["step"] == [0] * 5 + [1] * 8
    assert found["dark"]["after_light"] == [False] * 5 + [True] * 8
    assert "step" not in found["flat"]
    # Hours later, or with too few frames for a series of their own, they are not divided.
    assert in_series({"dark": table(*before, *late), "flat": flats})["dark"]["step"] == [0] * 9
    few = in_series({"dark": table(*before, *after[:3]), "flat": flats})["dark"]
    assert few["step"] == [0] * 8
    assert few["after_light"] == [False] * 8
    assert "step" not in in_series({"dark": table(*before)})["dark"]
    assert few["last"] == [7] * 8
    assert found["dark"]["last"] == [4] * 5 + [12] * 8


def test_charge_decays_in_a_pause_before_the_darks(make_effect_bench: Callable[..., Bench]) -> None:
    changes = {
        "detector.shape": [31, 37],
        "detector.dark_e_s": 0.0,
        "detector.read_noise_e": 0.0,
        "frames.flats": [{"exptime_s": 0.1, "count": 3}],
    }
    bench, lag = make_effect_bench(changes), Lag(0.05, spread=0.0, carried=1.0, decay_s=0.4)
    bench = replace(bench, shot_noise=False)
    flat = next(r for r in recordings(bench) if r.kind == "flat")
    dark = next(r for r in recordings(bench) if r.kind == "dark")
    end = flat.start_s + flat.count * flat.period_s
    late = []
    for pause in (0.0, 0.3):
        after = replace(dark, before=flat, start_s=end + pause, count=1)
        late.append(frames_of(bench, after, [lag])[0].astype(float).mean())
    late = np.array(late) - frames_of(bench, replace(dark, count=1))[0].mean()
    assert late[1] / late[0] == pytest.approx(np.exp(-0.3 / 0.4), rel=0.02)
    with pytest.raises(InputError, match="decay_s"):
        replace(lag, capacity_e=1e4).check(bench)
    with pytest.raises(InputError, match="slow_part: needs decay_s and slow_s"):
        replace(lag, slow_part=0.1).check(bench)


def test_errors_of_decays_that_are_alike_are_real_numbers() -> None:
    """Where nothing is released, two decays may be anything, and the same."""
    rng = np.random.default_rng(7)
    series = [("bias", 0.0, 0.0, 8), *(("flat", t / 100, 2e3 * t, 2) for t in (1, 3, 5, 7))]
    for _ in range(60):
        clock, levels = 0.0, []
        for kind, seconds, light, count in [*series, ("dark", 0.5, 0.0, 5), ("dark", 1.5, 0.0, 5)]:
            number = np.arange(count)
            none = np.zeros((count, 1, 1), np.float32)
            stack = Stack(kind, seconds, number, number * (seconds + 1), none, clock)
            levels.append((stack, light + rng.normal(0, 0.05, count)))
            clock += count * (seconds + 1)
        with np.errstate(invalid="raise"):
            released_late(levels, 0.05**2)
