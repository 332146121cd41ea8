"""Level and noise of frames whose noise is cut off at code zero."""

import numpy as np
import pytest

from pixcal.estimators.detector.cut_off import without_cut_off
from pixcal.kernels.robust import Combination, Combined

FRAMES = 60


def combined(rng: np.random.Generator, level: float, noise: float, step: int = 1) -> Combined:
    """Frames of normal noise, written as codes from zero on."""
    samples = rng.normal(level, noise, (FRAMES, 128, 128))
    codes = (step * np.maximum(np.rint(samples / step), 0)).astype(np.float32)
    combination = Combination(clip=5.0, lamp=False, quantum=max(float(step), noise))
    combination.update(codes)
    return combination.result()


@pytest.mark.parametrize("noise", [0.8, 3.0, 40.0])
@pytest.mark.parametrize("level", [0.0, 0.7, 1.5, 2.5])
def test_level_and_noise_are_those_before(level: float, noise: float) -> None:
    found = combined(np.random.default_rng(1), level * noise, noise)
    mended, factor = without_cut_off(found, FRAMES, 1.0)
    whole = noise**2 + 1 / 12
    assert np.mean(mended.mean) == pytest.approx(level * noise, abs=0.03 * noise)
    assert float(np.mean(found.variance)) * factor == pytest.approx(whole, rel=0.02)
    assert float(np.mean(mended.variance)) == pytest.approx(whole, rel=0.1)


def test_codes_in_steps() -> None:
    found = combined(np.random.default_rng(2), 16.0, 24.0, 16)
    mended, factor = without_cut_off(found, FRAMES, 16.0)
    assert np.median(mended.mean) == pytest.approx(16.0, abs=0.5)
    assert float(np.mean(found.variance)) * factor == pytest.approx(24**2 + 256 / 12, rel=0.02)


def test_frames_well_above_zero_stay_as_they_are() -> None:
    found = combined(np.random.default_rng(3), 50.0, 8.0)
    assert without_cut_off(found, FRAMES, 1.0) == (found, 1.0)
