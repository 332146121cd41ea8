"""Noise below a step is told from codes, with pixels of unequal noise at unequal levels."""

import numpy as np
import pytest

from pixcal.estimators.detector.rounded_noise import noise_of_codes
from pixcal.model.arrays import I64

PIXELS = 60_000


def recorded(
    noise: float, spread: float, level: float, scatter: float, frames: int = 6
) -> tuple[I64, float]:
    """Codes (t, n) of pixels with log-normal noise (rms of all) about normal levels; that rms."""
    rng = np.random.default_rng(round(1000 * noise + 100 * spread + 10 * level + scatter))
    each = noise * np.exp(spread * rng.standard_normal(PIXELS) - spread**2)
    levels = level + scatter * rng.standard_normal(PIXELS)
    codes = np.rint(levels + each * rng.standard_normal((frames, PIXELS))).astype(np.int64)
    return codes, float(np.sqrt((each**2).mean()))


def told(codes: I64, shot: float = 0.0) -> tuple[float, float, float]:
    """Noise, its error, and the scatter of its logarithm."""
    found, spread = noise_of_codes(codes, shot)
    assert found is not None
    return *found, spread


@pytest.mark.parametrize("scatter", [0.1, 0.4, 3.0])
@pytest.mark.parametrize("spread", [0.0, 0.3])
@pytest.mark.parametrize(("noise", "level"), [(0.25, 29.4), (0.35, 29.0), (0.6, 200.5)])
def test_noise_below_a_step_is_found_within_a_per_cent(
    noise: float, level: float, spread: float, scatter: float
) -> None:
    codes, true = recorded(noise, spread, level, scatter)
    found, error, over_pixels = told(codes)
    assert abs(found - true) < 4 * error < 0.05 * true
    assert abs(found - true) < max(0.01 * true, 2 * error)
    assert over_pixels == pytest.approx(spread, abs=0.06)


@pytest.mark.parametrize("frames", [2, 3, 12])
def test_any_number_of_frames_tells_the_noise(frames: int) -> None:
    codes, true = recorded(0.4, 0.2, 31.2, 0.5, frames)
    found, error, _ = told(codes)
    assert abs(found - true) < 3 * error < 0.04 * true


def test_one_code_in_all_pixels_tells_no_noise() -> None:
    found, _ = noise_of_codes(recorded(0.05, 0.0, 29.2, 0.02)[0])
    assert found is None


def test_shot_noise_and_a_level_common_to_a_frame_are_no_read_noise() -> None:
    true = recorded(0.5, 0.0, 29.3, 1.5)[1]
    with_shot, _ = recorded(float(np.hypot(0.5, 0.3)), 0.0, 29.3, 1.5)
    found, error, _ = told(with_shot, 0.3**2)
    assert found == pytest.approx(true, abs=3 * error)


def test_hits_by_particles_do_not_count() -> None:
    codes, true = recorded(0.3, 0.0, 29.3, 0.4)
    rng = np.random.default_rng(2)
    codes[rng.integers(6, size=300), rng.integers(PIXELS, size=300)] += rng.integers(5, 200, 300)
    found, error, _ = told(codes)
    assert found == pytest.approx(true, abs=max(3 * error, 0.01 * true))


def test_pixels_that_span_too_many_codes_tell_no_noise() -> None:
    wide = np.array([[0], [1000]]) * np.ones((1, PIXELS), np.int64)
    assert noise_of_codes(wide) == (None, None)
