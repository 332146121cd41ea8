"""Third moment of the noise: multiplied electrons are told from single ones, without a gain."""

import numpy as np
import pytest

from pixcal.estimators.detector.multiplication import is_multiplied, skew

SHAPE, READ = (150, 160), 4.0


def found(multiplication: float, light: tuple[float, ...], hits: float = 0.0) -> bool:
    """Whether flats of some light (e-) look multiplied; ``hits``: share of samples hit."""
    rng = np.random.default_rng(3)
    flat = 1 + 0.01 * rng.standard_normal(SHAPE)
    slope = 2 * multiplication - 1
    points = []
    for level in (0.0, *light):
        electrons = rng.poisson(level * flat, (20 if not level else 4, *SHAPE))
        # Each electron becomes a geometric number of them.
        more = rng.negative_binomial(np.maximum(electrons, 1), 1 / multiplication)
        samples = electrons + np.where(electrons > 0, more, 0)
        samples = samples + READ * rng.standard_normal(samples.shape)
        samples += 1e4 * multiplication * (rng.random(samples.shape) < hits)
        one = skew(
            np.rint(samples).astype(np.float32),
            level * multiplication,
            READ**2,
            slope,
            np.ones(SHAPE, np.bool_),
        )
        points += [] if one is None else [one]
    return is_multiplied(points, slope)


@pytest.mark.parametrize("light", [(0.05, 0.2, 0.5), (5.0, 20.0, 80.0), (20.0, 50.0, 300.0)])
@pytest.mark.parametrize("multiplication", [10.0, 300.0])
def test_multiplied_electrons_have_half_more_skew(
    multiplication: float, light: tuple[float, ...]
) -> None:
    assert found(multiplication, light)
    assert found(multiplication, light, hits=1e-3)


@pytest.mark.parametrize("light", [(20.0, 50.0, 300.0), (2000.0, 5000.0, 20000.0)])
def test_single_electrons_do_not(light: tuple[float, ...]) -> None:
    assert not found(1.0, light)
    assert not found(1.0, light, hits=1e-3)


def test_two_frames_have_no_third_moment() -> None:
    frames = np.ones((2, *SHAPE), np.float32)
    assert skew(frames, 1.0, 1.0, 1.0, np.ones(SHAPE, np.bool_)) is None
    assert not is_multiplied([], 1.0)


def test_a_lamp_that_flickers_over_a_bright_spot_leaves_the_third_moment_of_single_electrons() -> (
    None
):
    rng = np.random.default_rng(4)
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    spot = 0.3 + np.exp(-((y - 75) ** 2 + (x - 80) ** 2) / 1800)
    level = 2000 / spot.mean()
    frames = rng.poisson(level * spot * np.array([1.1, 0.95, 0.95])[:, None, None])
    one = skew(frames.astype(np.float32), 2000.0, READ**2, 1.0, np.ones(SHAPE, np.bool_))
    assert one is not None
    assert one.cumulant == pytest.approx(2000, abs=4 * one.error)


def test_noise_of_rows_is_one_sample_a_row() -> None:
    rng = np.random.default_rng(5)
    pulls = []
    for _ in range(30):
        frames = 10 * rng.standard_normal((4, *SHAPE)) + 20 * rng.standard_normal((4, SHAPE[0], 1))
        one = skew(frames.astype(np.float32), 0.0, 500.0, 1.0, np.ones(SHAPE, np.bool_))
        assert one is not None
        pulls.append(one.cumulant / one.error)
    assert 0.6 < np.std(pulls) < 1.4


def test_noise_below_a_step_does_not_tell() -> None:
    frames = np.rint(np.random.default_rng(6).normal(0.25, 0.3, (4, *SHAPE))).astype(np.float32)
    assert skew(frames, 0.0, 0.09, 0.01, np.ones(SHAPE, np.bool_), 1.0) is None


def test_pixels_that_blink_leave_the_third_moment_of_single_electrons() -> None:
    rng = np.random.default_rng(7)
    frames = rng.poisson(1000.0, (20, *SHAPE))
    blinking = (rng.random(SHAPE) < 3e-3) & (rng.random(frames.shape) < 0.1)
    frames[blinking] += 200
    one = skew(frames.astype(np.float32), 1000.0, READ**2, 1.0, np.ones(SHAPE, np.bool_))
    assert one is not None
    assert one.cumulant == pytest.approx(1000, abs=4 * one.error)
