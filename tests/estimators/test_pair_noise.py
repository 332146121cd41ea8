"""Noise that rows share is taken off flats, and put back as frames without light have it."""

import numpy as np
import pytest

from pixcal.estimators.detector.pair_noise import LineNoise, dark_pair_sums, flat_pair_sums
from pixcal.model.arrays import F32

GAIN, READ, ROWS = 2.0, 6.0, 5.0
SHAPE, DARKS, FLATS = (64, 96), 120, 40


def frames(rng: np.random.Generator, count: int, charge: float, line: str) -> F32:
    """Frames (t, y, x) of a level (e-), whose lines have noise of their own; ADU."""
    size = (count, SHAPE[0], 1) if line == "row" else (count, 1, SHAPE[1])
    noise = READ * rng.standard_normal((count, *SHAPE)) + ROWS * rng.standard_normal(size)
    return (rng.poisson(charge, (count, *SHAPE)) / GAIN + noise).astype(np.float32)


@pytest.mark.parametrize("line", ["row", "column"])
def test_flats_lose_the_scatter_of_lines_and_keep_their_noise(line: str) -> None:
    rng = np.random.default_rng(3)
    noise = LineNoise()
    dark = frames(rng, DARKS, 0.0, line)
    without = dark_pair_sums(dark, READ, 0.0)
    noise.add(dark, without, READ, 0.0)
    assert noise.lines == (line,)
    charge = 400.0
    flats = frames(rng, FLATS, charge, line)
    levels = flats.mean(axis=(1, 2))
    lit = flat_pair_sums(flats, levels, GAIN, READ, 0.0, noise).sum(axis=0)
    none = without.sum(axis=0)
    shot = (lit[2:] / lit[0] - none[2:] / none[0]) * GAIN**2 / charge
    # As precise as without any noise of lines: a row of few pairs alone has 20 % of scatter.
    error = (READ**2 + charge / GAIN**2) * GAIN**2 / charge * np.sqrt(2 / lit[0])
    assert shot[0] == pytest.approx(1, abs=4 * error)
    np.testing.assert_allclose(shot[1:], 0, atol=4 * error)


def test_without_noise_of_lines_nothing_is_taken() -> None:
    rng = np.random.default_rng(4)
    dark = (READ * rng.standard_normal((20, *SHAPE))).astype(np.float32)
    noise, sums = LineNoise(), dark_pair_sums(dark, READ, 0.0)
    noise.add(dark, sums, READ, 0.0)
    assert not noise.lines
    assert np.array_equal(noise.put_back(sums.copy()), sums)


def test_a_saturated_level_beside_row_noise_adds_nothing() -> None:
    dark, noise = frames(np.random.default_rng(3), DARKS, 0.0, "row"), LineNoise()
    noise.add(dark, dark_pair_sums(dark, READ, 0.0), READ, 0.0)
    assert noise.lines == ("row",)
    full = np.full((2, *SHAPE), np.nan, np.float32)
    assert not flat_pair_sums(full, np.full(2, np.nan), GAIN, READ, 0.0, noise).any()


@pytest.mark.parametrize("known", [True, False])
def test_nearly_full_pixels_of_one_colour_do_not_lower_the_noise_of_the_others(known: bool) -> None:
    """Under colour filters they stand in the same blocks as pixels that are far from full."""
    rng, full, charge = np.random.default_rng(6), 5000.0, np.full(SHAPE, 4000.0)
    charge[::2, ::2] = GAIN * full
    size = (FLATS, *SHAPE)
    flats = rng.poisson(charge, size) / GAIN + READ * rng.standard_normal(size)
    flats = np.where(flats < full, flats, np.nan).astype(np.float32)
    noise = LineNoise()
    dark = (READ * rng.standard_normal((2, *SHAPE))).astype(np.float32)
    noise.add(dark, dark_pair_sums(dark, READ, 0.0), READ, 0.0)
    levels = np.ones(FLATS)
    sums = flat_pair_sums(flats, levels, GAIN, READ, 0.0, noise, full if known else np.inf)
    dof, level, square = sums.sum(axis=0)[:3]
    off = GAIN * (square - dof * READ**2) / level - 1
    error = np.sqrt(2 / dof) * (1 + GAIN * READ**2 * dof / level)
    assert (abs(off) < 4 * error) == known
