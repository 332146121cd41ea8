"""Read noise of the pixels, drawn as they scatter in truth."""

import numpy as np
import pytest

from pixcal.estimators.detector.pixel_read_noise import FEWEST, PixelNoise, squares_without_hits

SHAPE = (70, 61)
GOOD = np.ones(SHAPE, bool)


def frames(spread: float, count: int, seed: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    sigma = 15 * np.exp(spread * rng.standard_normal(SHAPE))
    return (sigma * rng.standard_normal((count, *SHAPE))).astype(np.float32)


@pytest.mark.parametrize("spread", [0.0, 0.2])
@pytest.mark.parametrize("counts", [(40,), (19, 22)])
def test_variances_seen_again_scatter_as_those_that_were_measured(
    spread: float, counts: tuple[int, ...]
) -> None:
    """Of frames with the noise drawn, quantiles of the pixels' variances are those of the data."""
    stacks = (
        [frames(spread, n, seed) for seed, n in enumerate(counts)]
        if len(counts) == 1
        else [
            frames(spread, sum(counts))[a:b] for a, b in ((0, counts[0]), (counts[0], sum(counts)))
        ]
    )
    noise = PixelNoise.of(stacks, GOOD)
    rng = np.random.default_rng(1)
    drawn = noise.drawn(rng)
    again = drawn * rng.standard_normal((sum(counts), *SHAPE))
    seen = np.var(np.concatenate(stacks), axis=0, ddof=1)
    scale = np.mean(seen)
    quantiles = (0.05, 0.5, 0.95, 0.99)
    one = np.quantile(seen / scale, quantiles)
    other = np.quantile(np.var(again, axis=0, ddof=1), quantiles)
    assert other == pytest.approx(one, rel=0.06)


@pytest.mark.parametrize("count", [24, 40])
@pytest.mark.parametrize("tail", [0.1, 0.3, 0.5])
def test_a_heavy_tail_is_drawn_as_heavy(tail: float, count: int) -> None:
    """As of amplifiers of pixels, some of which are much noisier."""
    rng = np.random.default_rng(8)
    shape = (131, 127)
    sigma = 15 * (1 + rng.exponential(tail, shape)) * rng.lognormal(0, 0.1, shape)
    stack = (sigma * rng.standard_normal((count, *shape))).astype(np.float32)
    drawn = PixelNoise.of([stack], np.ones(shape, bool)).drawn(np.random.default_rng(3))
    again = (drawn * rng.standard_normal((count, *shape))).std(axis=0, ddof=1)
    seen = stack.std(axis=0, ddof=1)
    for share, off in ((0.01, 0.025), (0.1, 0.015), (0.9, 0.015), (0.99, 0.03), (0.998, 0.06)):
        one, other = (np.quantile(noise / np.median(noise), share) for noise in (seen, again))
        assert other == pytest.approx(one, rel=off)
    # Pixel by pixel as close as their own scatter lets know.
    one, other, known = np.log(sigma).ravel(), np.log(drawn).ravel(), np.log(seen).ravel()
    told = np.corrcoef(one, known)[0, 1]
    assert np.corrcoef(one, other)[0, 1] > 0.9 * told**2


def test_a_noisy_pixel_stays_noisy() -> None:
    stack = frames(0.1, 40)
    stack[:, 7, 11] *= 10
    drawn = PixelNoise.of([stack], GOOD).drawn(np.random.default_rng(2))
    assert drawn[7, 11] == pytest.approx(10, rel=0.4)


def test_pixels_that_are_masked_for_their_noise_are_masked_again() -> None:
    """As many others of their true noise as were not masked in the data."""
    rng, count = np.random.default_rng(8), 24
    shape = (231, 227)
    sigma = 15 * (1 + rng.exponential(0.4, shape))
    stack = (sigma * rng.standard_normal((count, *shape))).astype(np.float32)

    def kept(frames: np.ndarray) -> np.ndarray:
        noise = frames.std(axis=0, ddof=1)
        return noise < 2 * np.median(noise)

    def tail(frames: np.ndarray) -> float:
        noise = frames.std(axis=0, ddof=1)
        return float(np.quantile(noise[kept(frames)] / np.median(noise), 0.99))

    off = []
    for noisy in (~kept(stack), None):
        drawn = PixelNoise.of([stack], kept(stack), noisy=noisy).drawn(np.random.default_rng(3))
        again = drawn * rng.standard_normal((count, *shape))
        off.append((tail(again) / tail(stack) - 1, (~kept(again)).sum() / (~kept(stack)).sum() - 1))
    (with_them, masked), (without, too_few) = off
    assert abs(with_them) < 0.01 < -without
    assert abs(masked) < 0.1 < -too_few


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_pixels_masked_for_other_reasons_do_not_change_the_noise_of_good_ones(share: float) -> None:
    rng = np.random.default_rng(4)
    shape = (151, 149)
    sigma = 15 * rng.lognormal(0, 0.1, shape)
    stack = (sigma * rng.standard_normal((24, *shape))).astype(np.float32)
    good = rng.random(shape) > share
    one, other = (
        PixelNoise.of([stack], good, noisy=noisy).drawn(np.random.default_rng(3))[good]
        for noisy in (~good, None)
    )
    assert np.mean(one**2) == pytest.approx(np.mean(other**2), rel=2e-3)


def test_too_few_frames_tell_nothing() -> None:
    assert PixelNoise.of([frames(0.1, FEWEST - 1)], GOOD) is None


@pytest.mark.parametrize("count", [FEWEST, 13, 40])
def test_squares_of_normal_noise_are_those_about_the_mean(count: int) -> None:
    stack = frames(0.2, count) + 7
    squares = squares_without_hits(stack)
    np.testing.assert_allclose(squares, ((stack - stack.mean(axis=0)) ** 2).sum(axis=0), rtol=1e-3)


@pytest.mark.parametrize("count", [FEWEST, 20])
def test_a_step_of_the_converter_is_no_hit(count: int) -> None:
    stack = np.rint(frames(0.0, count) * (0.65 / 15) + 0.3)
    squares = squares_without_hits(stack)
    np.testing.assert_allclose(squares, ((stack - stack.mean(axis=0)) ** 2).sum(axis=0), rtol=1e-3)


@pytest.mark.parametrize("count", [FEWEST, 20])
def test_one_hit_leaves_the_squares_of_the_other_samples(count: int) -> None:
    stack = frames(0.0, count).astype(float)
    others = np.var(stack[1:], axis=0, ddof=1) * (count - 1)
    stack[0] += 1500
    np.testing.assert_allclose(squares_without_hits(stack), others, rtol=1e-9)
    stack[1] += 1500  # Twice is no particle.
    assert (squares_without_hits(stack) > 10 * others).all()


def test_pixels_that_particles_hit_are_not_drawn_noisy() -> None:
    stack, rng = frames(0.0, 20), np.random.default_rng(6)
    hit = rng.choice(stack[0].size, 40, replace=False)
    stack.reshape(20, -1)[rng.integers(0, 20, 40), hit] += rng.exponential(2000, 40) + 500
    drawn = PixelNoise.of([stack], GOOD).drawn(np.random.default_rng(1))
    assert drawn.max() < 1.6
