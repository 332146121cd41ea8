"""Level and noise of frames whose noise is cut off at code zero."""

from typing import Any

import numpy as np
import pytest
from scipy import stats

from pixcal.estimators.detector.cut_off import without_cut_off
from pixcal.kernels.robust import Combination, Combined
from pixcal.model.arrays import F32

FRAMES = 60


def samples_of(
    rng: np.random.Generator, level: Any, noise: float, step: int = 1, frames: int = FRAMES
) -> F32:
    """Samples (t, y, x) of normal noise, written as codes from zero on."""
    samples = rng.normal(level, noise, (frames, 128, 128))
    return (step * np.maximum(np.rint(samples / step), 0)).astype(np.float32)


def combined(codes: F32, noise: float) -> Combined:
    """What many frames say of each pixel."""
    combination = Combination(clip=5.0, lamp=False, quantum=max(1.0, noise))
    combination.update(codes)
    return combination.result()


@pytest.mark.parametrize("frames", [10, 60])
@pytest.mark.parametrize("noise", [0.8, 3.0, 40.0])
@pytest.mark.parametrize("level", [0.0, 0.7, 1.5, 2.5])
def test_level_and_noise_are_those_before(level: float, noise: float, frames: int) -> None:
    """Each pixel has a level of its own."""
    rng = np.random.default_rng(1)
    levels = noise * (level + 0.2 * rng.standard_normal((128, 128)))
    found = combined(samples_of(rng, levels, noise, 1, frames), noise)
    mended, factor = without_cut_off(found, frames, 1.0)
    whole = noise**2 + 1 / 12
    assert np.mean(mended.mean) == pytest.approx(levels.mean(), abs=0.03 * noise)
    assert float(np.mean(found.variance)) * factor == pytest.approx(whole, rel=0.01)
    assert float(np.mean(mended.variance)) == pytest.approx(whole, rel=0.1)


@pytest.mark.parametrize("spread", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("level", [0.5, 1.5])
@pytest.mark.parametrize("frames", [2, 3, 12])
def test_few_frames_tell_the_noise_too(frames: int, level: float, spread: float) -> None:
    """Means of two frames scatter by more than the levels."""
    rng = np.random.default_rng(7)
    levels = 1.1 * (level + spread * rng.standard_normal((128, 128)))
    found = combined(samples_of(rng, levels, 1.1, 1, frames), 1.1)
    mended, factor = without_cut_off(found, frames, 1.0)
    assert float(np.mean(found.variance)) * factor == pytest.approx(1.1**2 + 1 / 12, rel=0.06)
    # Each level is drawn to the mean of all, where those of few frames say little.
    near = 0.06 if spread < 1 else 0.2
    assert np.mean(mended.mean) == pytest.approx(levels.mean(), abs=near)


@pytest.mark.parametrize("level", [-5.0, 0.0, 20.0])
def test_likelihood_of_scipy_gives_the_same_noise(level: float) -> None:
    """Where all pixels have the same level, the censored likelihood has no nuisance."""
    codes = samples_of(np.random.default_rng(4), level, 40.0)
    found = combined(codes, 40.0)
    _, factor = without_cut_off(found, FRAMES, 1.0)
    some = codes.ravel()[::50].astype(float)
    # A code of zero may have been any number below a half.
    censored = stats.CensoredData.left_censored(np.where(some > 0, some, 0.5), some == 0)
    _, scale = stats.norm.fit(censored)
    error = scale / np.sqrt(some.size)
    ours = np.sqrt(float(np.mean(found.variance)) * factor)
    assert ours == pytest.approx(scale, abs=4 * error)


def test_codes_in_steps() -> None:
    found = combined(samples_of(np.random.default_rng(2), 16.0, 24.0, 16), 24.0)
    mended, factor = without_cut_off(found, FRAMES, 16.0)
    assert np.median(mended.mean) == pytest.approx(16.0, abs=0.5)
    assert float(np.mean(found.variance)) * factor == pytest.approx(24**2 + 256 / 12, rel=0.02)


def test_frames_well_above_zero_stay_as_they_are() -> None:
    found = combined(samples_of(np.random.default_rng(3), 50.0, 8.0), 8.0)
    assert without_cut_off(found, FRAMES, 1.0) == (found, 1.0)


def test_any_lowest_code_is_as_good_as_zero() -> None:
    codes = samples_of(np.random.default_rng(2), 30.0, 20.0)
    at_zero, factor = without_cut_off(combined(codes, 20.0), FRAMES, 1.0)
    raised, same = without_cut_off(combined(codes + 64, 20.0), FRAMES, 1.0, 64.0)
    assert same == pytest.approx(factor, rel=1e-4)
    np.testing.assert_allclose(raised.mean - 64, at_zero.mean, atol=1e-3)
