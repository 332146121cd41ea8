"""Tones and smooth patterns of single frames: what white noise gives, and what they add to it."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scipy.stats import gamma

from pixcal.estimators.test_statistics.fringe_set_data import FringeSetData, pattern_sizes
from pixcal.estimators.test_statistics.patterns import (
    highest_ordinate,
    smooth_patterns,
    smooth_patterns_by_phase,
    strongest,
    tone_sigmas,
)
from pixcal.model.arrays import F32, Mask

SHAPE = (41, 48)
GOOD: Mask = np.random.default_rng(5).random(SHAPE) > 0.02
FRAMES = 60


def noise(seed: int, frames: int = FRAMES) -> F32:
    white = np.random.default_rng(seed).standard_normal((frames, *SHAPE))
    return np.asarray(white * GOOD, np.float32)


def read_out(amplitude: float, turns: float, seed: int) -> F32:
    """A tone along the samples in the order of readout, of another phase in every frame."""
    sample = np.arange(SHAPE[0])[:, None] * (SHAPE[1] + 12) + np.arange(SHAPE[1])
    start = np.random.default_rng(seed).random((FRAMES, 1, 1))
    return np.asarray(amplitude * np.sin(2 * np.pi * (turns * sample + start)) * GOOD, np.float32)


def a_look(residual: F32, phi: np.ndarray) -> FringeSetData:
    given = SimpleNamespace(
        residual=residual,
        pattern_sizes=pattern_sizes(residual, GOOD),
        fringes=SimpleNamespace(phi=phi),
    )
    return cast(FringeSetData, given)


def patch(amplitude: float) -> np.ndarray:
    """Light that falls off from a corner (y, x)."""
    y, x = (np.arange(n) / n for n in SHAPE)
    return np.asarray(amplitude * np.exp(-np.hypot(y[:, None], x) / 0.4) * GOOD)


def test_of_white_noise_the_highest_ordinate_is_the_largest_of_independent_ones() -> None:
    found = [float(highest_ordinate(noise(seed), GOOD).value[0]) for seed in range(40)]
    ordinates = (SHAPE[0] - 1) * (SHAPE[1] // 2 - 1) + SHAPE[0] // 2
    # Means of exponentials over the frames; the median of the largest.
    law = gamma(FRAMES, scale=1 / FRAMES)
    expected = law.ppf(0.5 ** (1 / ordinates))
    assert np.median(found) == pytest.approx(expected, rel=0.015)
    assert np.max(found) < law.ppf((1 - 1e-4) ** (1 / ordinates))


@pytest.mark.parametrize("frames", [2, 10, FRAMES])
def test_of_white_noise_the_significance_of_a_tone_is_a_standard_normal(frames: int) -> None:
    found = [float(tone_sigmas(noise(seed, frames), GOOD).value[0]) for seed in range(200)]
    assert np.mean(found) == pytest.approx(0, abs=4 / np.sqrt(200))
    assert np.std(found) == pytest.approx(1, abs=4 / np.sqrt(400))
    assert np.max(found) < 4.5


def test_a_tone_in_the_order_of_readout_adds_to_one_ordinate() -> None:
    # Whole periods along a row and over the rows: all of its power is in one ordinate.
    fx, fy = 5 / SHAPE[1], 11 / SHAPE[0]
    rows = fx * (SHAPE[1] + 12)
    turns = fx + (round(rows - fy) + fy - rows) / (SHAPE[1] + 12)
    amplitude = 0.15
    found = highest_ordinate(noise(1) + read_out(amplitude, turns, 2), GOOD)
    whole = 1 + np.count_nonzero(GOOD) * amplitude**2 / 4
    assert found.value[0] == pytest.approx(whole, rel=0.15)
    assert found.x[0] == pytest.approx(np.hypot(fx, fy), abs=1.5 / min(SHAPE))


@pytest.mark.parametrize("turns", [0.013, 0.2371])
def test_a_tone_between_ordinates_keeps_a_sixth_of_its_power(turns: float) -> None:
    """Halfway between two along both axes it keeps (2 / π)⁴."""
    amplitude = 0.25
    found = highest_ordinate(noise(1) + read_out(amplitude, turns, 2), GOOD)
    assert found.value[0] > 1 + np.count_nonzero(GOOD) * amplitude**2 / 4 * (2 / np.pi) ** 4


def test_rows_and_columns_are_no_tone() -> None:
    rng = np.random.default_rng(3)
    # Without bad pixels, which spread what rows share.
    full = np.ones(SHAPE, bool)
    plain = rng.standard_normal((FRAMES, *SHAPE)).astype(np.float32)
    lines = rng.standard_normal((FRAMES, SHAPE[0], 1)) + rng.standard_normal((FRAMES, 1, SHAPE[1]))
    of_plain, of_both = (
        highest_ordinate(np.asarray(n, np.float32), full) for n in (plain, plain + lines)
    )
    assert of_both.value[0] == pytest.approx(of_plain.value[0], rel=1e-4)


def test_sizes_of_patterns_of_white_noise_are_white() -> None:
    sizes = pattern_sizes(noise(7, 4000), GOOD)
    covariance = sizes.T @ sizes / len(sizes)
    np.testing.assert_allclose(covariance, np.eye(sizes.shape[1]), atol=5 / np.sqrt(4000))


def test_a_change_of_level_is_no_pattern() -> None:
    level = np.random.default_rng(3).standard_normal((FRAMES, 1, 1)) * GOOD
    assert np.abs(pattern_sizes(np.asarray(level, np.float32), GOOD)).max() < 1e-3


def test_of_white_noise_patterns_are_as_strong_as_those_of_a_random_matrix() -> None:
    """Whatever the frames' phases are, four if there are many, and two of four phases."""
    for phases, shapes in ((FRAMES, 4), (5, 2)):
        phi = 2 * np.pi * np.arange(FRAMES) / phases
        found = np.array(
            [
                [
                    float(one.measure(a_look(noise(seed), phi)).value[0])
                    for one in (smooth_patterns, smooth_patterns_by_phase)
                ]
                for seed in range(60)
            ]
        )
        rng = np.random.default_rng(1)
        by_frame = [strongest(rng.standard_normal((FRAMES - 1, 9))) for _ in range(400)]
        by_phase = [strongest(rng.standard_normal((shapes, 9))) for _ in range(400)]
        law = np.stack([np.array(by_frame) / np.sqrt(FRAMES), by_phase], axis=1)
        error = law.std(axis=0) * np.sqrt(1 / 60 + 1 / 400)
        assert (np.abs(found.mean(axis=0) - law.mean(axis=0)) < 4 * error).all()
        np.testing.assert_allclose(found.std(axis=0), law.std(axis=0), rtol=0.4)


def test_a_patch_that_varies_shows_with_its_size() -> None:
    """Once its smooth part, summed over the pixels, is beyond the noise of one number a frame."""
    light = patch(0.8)
    change = np.random.default_rng(11).standard_normal(FRAMES)
    change -= change.mean()
    smooth = pattern_sizes((change[:, None, None] * light).astype(np.float32), GOOD)
    size = float(np.sqrt((smooth**2).sum() / FRAMES))
    varied = (noise(1) + change[:, None, None] * light).astype(np.float32)
    phi = np.linspace(0, 40, FRAMES)
    found = smooth_patterns.measure(a_look(varied, phi))
    assert size > 3
    assert found.value[0] == pytest.approx(np.hypot(size, 1), rel=0.1)


def test_a_patch_that_follows_the_phase_adds_to_chance_in_squares() -> None:
    """As the light of a modulator's driver, bright where its voltage is high."""
    phi = 2.0 * np.arange(300)
    voltage = (phi % (2 * np.pi)) / (2 * np.pi)
    turns = [f(n * phi) for n in range(4) for f in (np.cos, np.sin)]
    taken, followed = np.stack(turns[:1] + turns[2:4], axis=1), np.stack(turns[4:], axis=1)
    # What is left by the fit of the pixels.
    change = voltage**2 - taken @ np.linalg.lstsq(taken, voltage**2)[0]
    light = patch(0.6)
    varied = change[:, None, None] * light
    looks = [a_look((noise(seed, 300) + varied).astype(np.float32), phi) for seed in range(12)]
    plain = [a_look(noise(seed, 300), phi) for seed in range(12)]
    found, same = (
        np.array([float(smooth_patterns_by_phase.measure(one).value[0]) for one in own])
        for own in (looks, plain)
    )
    kept = followed @ np.linalg.lstsq(followed, change)[0]
    true = np.linalg.norm(pattern_sizes((kept[:, None, None] * light).astype(np.float32), GOOD))
    # One strong singular value of a random matrix of 4 by 9.
    assert np.mean(found**2) == pytest.approx(true**2 + 4 + 9 - 1, rel=0.1)
    assert found.mean() - same.mean() > 6 * same.std()


def test_phases_that_cannot_tell_are_left_out() -> None:
    phi = 2 * np.pi / 3 * np.arange(FRAMES)
    assert smooth_patterns_by_phase.measure(a_look(noise(1), phi)) is None
