"""Series of the frames: what follows the phase goes, noise keeps its size, drifts stay."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.diagnosis.free_frames import NO_SAMPLE, free_frames, stripes
from pixcal.estimators.frame_series.series import (
    FrameSeries,
    _follows_phase,
    light_series,
    motion_series,
    without,
)
from pixcal.estimators.frame_series.spectral_line import find_line, without_line
from pixcal.estimators.frame_series.variance_components import walk_modes
from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.tile_fit import Coding

T = 297
SHAPE = (61, 67)
INSIDE, EVEN = np.arange(1, T + 1), walk_modes(np.arange(float(T)))


def phases(seed: int) -> np.ndarray:
    return 2 * np.pi * np.random.default_rng(seed).random(T + 2)


def test_what_follows_the_phase_goes_and_white_noise_keeps_its_size() -> None:
    rng, phase = np.random.default_rng(1), phases(1)
    own = phase[1:-1]
    bent = 4 * np.cos(own) + np.sin(3 * own) + 3 * np.cos(phase[2:] - own)
    sizes = []
    for _ in range(20):
        noise = rng.standard_normal((T, 2))
        rest = without(noise + bent[:, None], _follows_phase(phase, INSIDE, EVEN), EVEN)
        # Weights see the whole series, so that the two differ by a little of the noise.
        assert np.std(rest - without(noise, _follows_phase(phase, INSIDE, EVEN), EVEN)) < 0.4
        sizes.append(rest.var(axis=0))
    assert np.mean(sizes) == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("kind", ["ramp", "walk", "line"])
def test_drifts_and_lines_are_not_taken_for_what_follows_the_phase(kind: str) -> None:
    rng, phase = np.random.default_rng(2), phases(2)
    time = np.arange(T)
    slow = {
        "ramp": 0.3 * (time - time.mean()),
        "walk": 3 * np.cumsum(rng.standard_normal(T)),
        "line": 30 * np.sin(1.1 * time),
    }[kind]
    noise = 0.1 * rng.standard_normal(T)
    rest = without((slow + noise)[:, None], _follows_phase(phase, INSIDE, EVEN), EVEN)[:, 0]
    # A walk is white at its upper end: there its steps are noise as well.
    assert np.std(rest - slow + slow.mean()) < (6 if kind == "walk" else 0.05 * np.std(slow))


def test_a_scan_so_slow_that_its_phase_is_a_drift_takes_nothing() -> None:
    assert _follows_phase(0.004 * np.arange(T + 2), INSIDE, EVEN).shape[1] == 0
    assert _follows_phase(phases(3), INSIDE, EVEN).shape[1] > 50


def test_halves_are_halves_without_a_period() -> None:
    for shape in (SHAPE, (5, 70)):
        half = np.broadcast_to(stripes(shape), shape)
        assert 0.35 < half.mean() < 0.65
    power = np.abs(np.fft.rfft(stripes((512, 512))[:, 0] - 0.5)) ** 2
    assert power.max() < 0.4 * power.sum()


def fringes(seed: int, frames: int = 80) -> FringeEvidence:
    """Fringes of five pixels on a window, with the noise of their photons."""
    rng, shape = np.random.default_rng(seed), (40, 44)
    y, x = np.mgrid[: shape[0], : shape[1]]
    psi, phi = 1.21 * (x - 21.5) + 0.02 * (y - 19.5), 2 * np.pi * rng.random(frames)
    theta = 20_000 * np.stack([np.ones(shape), 0.9 * np.sin(psi), 0.9 * np.cos(psi)])
    g = np.stack([np.ones(frames), np.cos(phi), np.sin(phi)], axis=1)
    mean = np.einsum("ti,iyx->tyx", g, theta)
    read, shot = np.full(shape, 100.0), np.ones(shape)
    electrons = (mean + np.sqrt(mean + 100) * rng.standard_normal(mean.shape)).astype(np.float32)
    good, dk = rng.random(shape) > 0.02, np.zeros((frames, 2))
    coding, start = Coding(1.0, 0.0, NO_SAMPLE), FrameParameters(g, dk, (19.5, 21.5))
    (free, covariance), *_ = free_frames(electrons, coding, start, theta, read, shot, good)
    return FringeEvidence(
        name="a",
        baseline_mm=(6.0, 0.0),
        k=(1.21, 0.02),
        origin=(0, 0),
        window=shape,
        frame=np.arange(frames),
        time_s=0.14 * np.arange(frames),
        exptime_s=0.02,
        electrons=electrons,
        adu=electrons.astype(np.uint16),
        g=g,
        dk=dk,
        free=free,
        free_covariance=covariance,
        theta=theta,
        sigma=np.ones(shape),
        delta=np.zeros(shape),
        good=good,
        read_variance=read,
        shot_factor=shot,
    )


@pytest.mark.parametrize("series_of_set", [motion_series, light_series])
def test_the_noise_of_a_series_is_that_of_its_halves(
    series_of_set: Callable[[FringeEvidence], FrameSeries | None],
) -> None:
    ratios, both = [], []
    for seed in range(6):
        found = series_of_set(fringes(seed))
        assert found is not None
        assert len(found) == 78
        series = found.cleaned()
        assert 0.7 < series.share < 0.85
        assert series.cleaned() is series
        ratios.append(
            [
                series.values.var(axis=0) / np.diag(series.noise),
                series.apart.var(axis=0) / np.diag(series.apart_noise),
            ]
        )
        both.append(np.corrcoef(series.values.T, series.apart.T)[:2, 2:])
    np.testing.assert_allclose(np.mean(ratios, axis=0), 1.0, atol=0.25)
    assert np.abs(np.mean(both, axis=0)).max() < 0.25


def test_halves_see_the_same_frame_and_not_the_same_noise() -> None:
    found = fringes(9)
    (one, one_error), (other, other_error) = found.halves
    pulls = (one - other) / np.sqrt(np.einsum("tii->ti", one_error + other_error))
    np.testing.assert_allclose(pulls.std(axis=0), 1.0, atol=0.3)
    mean = (one / np.einsum("tii->ti", one_error) + other / np.einsum("tii->ti", other_error)) / (
        1 / np.einsum("tii->ti", one_error) + 1 / np.einsum("tii->ti", other_error)
    )
    error = np.sqrt(np.einsum("tii->ti", found.free_covariance))
    assert np.abs((mean - found.free) / error).max() < 1


def test_dark_frames_and_short_sets_tell_nothing() -> None:
    found = fringes(10)
    free = found.free.copy()
    free[10:20, :3] = 0.0
    series = motion_series(replace(found, free=free))
    assert series is not None
    # Without the dark ones, those beside them, and both ends.
    assert len(series) == len(free) - 14
    assert motion_series(fringes(11, frames=20)) is None


def series_of(values: np.ndarray, frame: np.ndarray | None = None) -> FrameSeries:
    unit = np.eye(2)
    frame = np.arange(len(values)) if frame is None else frame
    nothing = np.zeros((len(values), 0))
    return FrameSeries(
        "a", (1.0, 0.0), frame, 0.14 * frame, 0.02, values, 0 * values, nothing, unit, unit
    )


def white(series: FrameSeries) -> np.ndarray:
    return np.ones((len(series) - 1, 2))


def test_frames_beside_a_gap_are_left_out_and_times_are_kept() -> None:
    found = fringes(12)
    kept = np.r_[0:20, 55 : len(found.g)]
    of_frames = ("frame", "time_s", "electrons", "adu", "g", "dk", "free", "free_covariance")
    parted = replace(found, **{name: getattr(found, name)[kept] for name in of_frames})
    series = light_series(parted)
    assert series is not None
    assert not set(series.frame) & {0, 19, 55, len(found.g) - 1}
    assert len(series) == len(kept) - 4
    np.testing.assert_allclose(series.time_s, 0.14 * series.frame)
    assert series.step_s == pytest.approx(0.14)


GAPS = np.concatenate([np.arange(n, n + T // 4) for n in (0, T // 2, 3 * T // 2, 2 * T)])


@pytest.mark.parametrize("frame", [np.arange(T), GAPS], ids=["without gaps", "with gaps"])
def test_a_line_is_found_with_its_frequency_and_amplitude(frame: np.ndarray) -> None:
    rng = np.random.default_rng(4)
    swing = np.sin(2 * np.pi * 1.7 * 0.14 * frame)[:, None] * [0.8, 0.4]
    every = [series_of(swing + rng.standard_normal(swing.shape), frame) for _ in range(2)]
    line, cleared = without_line(every, white)
    assert line is not None
    assert line.significant
    assert line.hz == pytest.approx(1.7, abs=4 * line.hz_error)
    assert line.hz_error < 0.01
    assert np.all(np.abs(line.amplitude - [0.8, 0.4]) < 4 * line.amplitude_error)
    again = find_line(cleared, white)
    assert again is not None
    assert not again.significant


@pytest.mark.parametrize("phase", np.linspace(0, 3, 7))
def test_a_strong_slow_line_leaves_no_power_behind(phase: float) -> None:
    frame = np.arange(298)
    swing = 12 * np.sin(2 * np.pi * 0.88 * 0.14 * frame + phase)[:, None] * [1.0, 1.0]
    series = series_of(swing + np.random.default_rng(8).standard_normal(swing.shape))
    line, (cleared,) = without_line([series], white)
    assert line is not None
    assert line.significant
    # 298 values: their standard deviation is known to a twenty-fourth.
    np.testing.assert_allclose(cleared.values.std(axis=0), 1.0, atol=0.13)


def test_no_line_is_found_in_noise_nor_in_a_walk_of_known_power() -> None:
    rng, power = np.random.default_rng(5), 1 + 4 * EVEN.walk
    for _ in range(20):
        noise = rng.standard_normal((T, 2)) + 2 * np.cumsum(rng.standard_normal((T, 2)), axis=0)
        line = find_line([series_of(noise)], lambda s: np.stack([power, power], axis=1))
        assert line is not None
        assert not line.significant


def test_a_run_too_short_for_a_line_has_none() -> None:
    assert find_line([series_of(np.zeros((9, 2)))], white) is None
