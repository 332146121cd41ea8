"""Noise that rows share is taken off flats, and put back as frames without light have it."""

import numpy as np
import pytest

from pixcal.estimators.detector.pair_noise import (
    LineNoise,
    dark_pair_sums,
    flat_pair_sums,
    shared_by_blocks,
    shared_by_lines,
    without_bands,
)
from pixcal.kernels.photon_transfer import BLOCK, LAGS
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
    lit = flat_pair_sums(flats, levels, GAIN, READ, 0.0, noise)[0].sum(axis=0)
    none = without.sum(axis=0)
    shot = (lit[2:] / lit[0] - none[2:] / none[0]) * GAIN**2 / charge
    # As precise as without any noise of lines: a row of few pairs alone has 20 % of scatter.
    error = (READ**2 + charge / GAIN**2) * GAIN**2 / charge * np.sqrt(2 / lit[0])
    assert shot[0] == pytest.approx(1, abs=4 * error)
    np.testing.assert_allclose(shot[1:], 0, atol=4 * error)


def test_bands_of_a_flickering_lamp_are_no_noise_of_light() -> None:
    rng = np.random.default_rng(5)
    charge, shape = 4000.0, (10, 128, 128)
    phase = rng.uniform(0, 2 * np.pi, (shape[0], 1, 1))
    bands = 1 + 0.02 * np.sin(np.arange(shape[1])[:, None] / 9 + phase)
    flats = (rng.poisson(charge * bands, shape) / GAIN).astype(np.float32)
    whole, rest = flat_pair_sums(flats, flats.mean(axis=(1, 2)), GAIN, READ, 0.0, LineNoise())
    assert without_bands(whole, rest) is rest
    lit = rest.sum(axis=0)
    shot = lit[2:] / lit[1] * GAIN
    error = np.sqrt(2 / lit[0])
    assert shot[0] == pytest.approx(1, abs=4 * error)
    np.testing.assert_allclose(shot[1:], 0, atol=4 * error)


@pytest.mark.parametrize("line", ["row", "column"])
def test_subtracted_lines_leave_no_covariance_across_them(line: str) -> None:
    rng = np.random.default_rng(6)
    frames = rng.standard_normal((6000, 32, 32), dtype=np.float32)
    whole, rest = (dark_pair_sums(frames, 1.0, 0.0, lines).sum(axis=0) for lines in ((), (line,)))
    across = LAGS[:, 0 if line == "row" else 1] != 0
    more = (rest[3:] / rest[2] - whole[3:] / whole[2])[across]
    # Means of blocks take 1/256 less off each covariance where they vary less without the lines.
    less = 1 / 32 / BLOCK
    assert np.mean(more) == pytest.approx(0, abs=less / 3)


def test_crosstalk_makes_no_bands() -> None:
    """Its neighbours share noise, so that means of rows vary more; nothing but that is taken."""
    rng = np.random.default_rng(7)
    charge, share = 40_000.0, 0.08
    light = rng.poisson(charge, (40, *SHAPE)).astype(np.float32)
    steps = ((0, 1), (0, -1), (1, 0), (-1, 0))
    near = np.sum([np.roll(light, step, (1, 2)) for step in steps], axis=0)
    flats = light + np.float32(share) * (near - 4 * light)
    whole, rest = flat_pair_sums(flats, flats.mean(axis=(1, 2)), 1.0, READ, 0.0, LineNoise())
    assert without_bands(whole, rest) is whole
    assert rest[:, 2].sum() == pytest.approx(whole[:, 2].sum(), rel=2e-3)


def test_without_noise_of_lines_nothing_is_taken() -> None:
    rng = np.random.default_rng(4)
    dark = (READ * rng.standard_normal((20, *SHAPE))).astype(np.float32)
    noise, sums = LineNoise(), dark_pair_sums(dark, READ, 0.0)
    noise.add(dark, sums, READ, 0.0)
    assert not noise.lines
    lit = rng.poisson(400.0, dark.shape).astype(np.float32)
    flats = flat_pair_sums(lit, lit.mean(axis=(1, 2)), 1.0, READ, 0.0, noise)
    assert np.array_equal(without_bands(*flats), flats[0])
    assert np.array_equal(noise.put_back(sums.copy()), sums)


@pytest.mark.parametrize(
    ("shape", "scale"), [((64, 1), 1), ((1, 96), 1), ((1, 4), 24), ((8, 1), 8)]
)
def test_noise_within_blocks_and_that_of_blocks_are_the_whole(
    shape: tuple[int, int], scale: int
) -> None:
    """Of rows, columns, outputs side by side, and bands; but for the level of whole frames."""
    rng = np.random.default_rng(7)
    axis = int(shape[0] == 1)
    dark = READ * rng.standard_normal((DARKS, *SHAPE))
    shared = ROWS * rng.standard_normal((DARKS, *shape)).repeat(scale, axis=1 + axis)
    frames = (dark + shared).astype(np.float32)
    sums = dark_pair_sums(frames, READ, 0.0).sum(axis=0)
    of_blocks = [
        shared_by_blocks(a - b, 0.0) for a, b in zip(frames[::2], frames[1::2], strict=True)
    ]
    lines = max(shape)
    expected = READ**2 + ROWS**2 * (1 - 1 / lines)
    error = ROWS**2 * np.sqrt(4 / (DARKS * lines))
    found = sums[2] / sums[0] + np.mean(of_blocks)
    assert found == pytest.approx(expected, abs=4 * error)


def test_blocks_of_white_noise_and_hits_share_nothing() -> None:
    rng = np.random.default_rng(8)
    difference = np.rint(rng.normal(0, 1.2, (256, 384))).astype(np.float32)
    difference[40:43, 50:60] += 900
    difference[rng.random(difference.shape) < 1e-3] = np.nan
    blocks = difference.size / 256
    assert abs(shared_by_blocks(difference, 1.0)) < 4 * 1.2**2 / 512 * np.sqrt(2 / blocks)


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
    sums, _ = flat_pair_sums(flats, levels, GAIN, READ, 0.0, noise, full if known else np.inf)
    dof, level, square = sums.sum(axis=0)[:3]
    off = GAIN * (square - dof * READ**2) / level - 1
    error = np.sqrt(2 / dof) * (1 + GAIN * READ**2 * dof / level)
    assert (abs(off) < 4 * error) == known


@pytest.mark.parametrize(("row", "column"), [(3.0, 6.0), (6.0, 1.5), (0.0, 6.0), (5.0, 5.0)])
def test_noise_of_rows_is_found_beside_that_of_columns(row: float, column: float) -> None:
    rng = np.random.default_rng(9)
    dark = READ * rng.standard_normal((DARKS, *SHAPE))
    dark += row * rng.standard_normal((DARKS, SHAPE[0], 1))
    dark += column * rng.standard_normal((DARKS, 1, SHAPE[1]))
    found = shared_by_lines(dark_pair_sums(dark.astype(np.float32), READ, 0.0))
    for line, size, lines in (("row", row, SHAPE[0]), ("column", column, SHAPE[1])):
        # The scatter of a few lines, and the smaller of two lags.
        error = np.hypot(found[line][1], size**2 * np.sqrt(4 / (DARKS * lines)))
        assert found[line][0] == pytest.approx(size**2, abs=4 * error)


@pytest.mark.parametrize("repeated", [0.0, 0.6, 0.5**0.5])
def test_noise_of_rows_is_whole_where_every_second_row_repeats_it(repeated: float) -> None:
    """The means of blocks then hold more of it than of rows that differ."""
    rng, row, rows, frames = np.random.default_rng(11), 5.0, 272, 160
    dark = READ * rng.standard_normal((frames, rows, 48))
    white = rng.standard_normal((frames, rows + 2))
    drawn = (1 - repeated**2) ** 0.5 * white[:, 2:] + repeated * white[:, :-2]
    dark += row * drawn[..., None]
    shared, error = shared_by_lines(dark_pair_sums(dark.astype(np.float32), READ, 0.0))["row"]
    # A row is as good as independent of two thirds of the others.
    error = np.hypot(error, row**2 * np.sqrt(2 * 1.5 / (frames / 2 * rows)))
    assert error < 0.015 * row**2
    assert shared == pytest.approx(row**2, abs=2 * error)


@pytest.mark.parametrize("column", [0.0, 2.0])
@pytest.mark.parametrize("period", [2.2, 2.6, 3.7, 7.3, 22.2, 90.0])
def test_noise_that_neighbouring_rows_share_is_none_of_columns(
    period: float, column: float
) -> None:
    """Mains hum hardly changes along a row."""
    rng, size = np.random.default_rng(13), 3.0
    dark = READ * rng.standard_normal((DARKS, 208, 176))
    phase = rng.uniform(0, 2 * np.pi, (DARKS, 1)) + 2 * np.pi / period * np.arange(208)
    dark += np.sqrt(2) * size * np.cos(phase)[..., None]
    dark += column * rng.standard_normal((DARKS, 1, 176))
    found = shared_by_lines(dark_pair_sums(dark.astype(np.float32), READ, 0.0))
    assert found["row"][0] > 5 * found["row"][1]
    # Block means take off waves that are longer than blocks.
    assert period > 16 or found["row"][0] == pytest.approx(size**2, rel=0.2)
    error = np.hypot(found["column"][1], column**2 * np.sqrt(4 / (DARKS * 176)))
    assert found["column"][0] == pytest.approx(column**2, abs=4 * error)


@pytest.mark.parametrize("axis", [1, 2])
def test_pixels_that_share_noise_two_apart_are_no_line(axis: int) -> None:
    """As of two outputs that read the columns in turn, and settle slowly."""
    rng = np.random.default_rng(12)
    noise = READ * rng.standard_normal((12, 514, 258))
    dark = np.roll(noise, 2, axis) * 0.1 + noise
    for shared, _ in shared_by_lines(dark_pair_sums(dark.astype(np.float32), READ, 0.0)).values():
        assert shared == 0
