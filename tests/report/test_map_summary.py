"""Maps reduced to what a figure shows: plain NumPy on the whole map says the same."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.report.map_summary import (
    SAMPLE,
    ArraySource,
    RatioSource,
    bands,
    block_mean,
    block_side,
    detail,
    spectrum,
    summarise,
    summarise_flags,
)


def holed(shape: tuple[int, int], seed: int = 0) -> NDArray[np.float32]:
    rng = np.random.default_rng(seed)
    values = (7 + rng.normal(size=shape)).astype(np.float32)
    values[rng.random(shape) < 0.1] = np.nan
    return values


def slow_block_mean(values: NDArray[np.float32], side: int) -> NDArray[np.float64]:
    rows = range(0, values.shape[0], side)
    columns = range(0, values.shape[1], side)
    out = np.full((len(rows), len(columns)), np.nan)
    for i, y in enumerate(rows):
        for j, x in enumerate(columns):
            block = values[y : y + side, x : x + side]
            if np.isfinite(block).any():
                out[i, j] = block[np.isfinite(block)].mean(dtype=float)
    return out


@pytest.mark.parametrize("side", [1, 2, 5, 7, 200])
def test_block_means_leave_nan_out_and_keep_the_edges(side: int) -> None:
    values = holed((67, 131))
    values[10:15, 20:25] = np.nan
    np.testing.assert_allclose(
        block_mean(values, side), slow_block_mean(values, side), rtol=1e-6, equal_nan=True
    )


def test_a_block_without_a_good_pixel_is_nan_not_zero() -> None:
    values = np.ones((6, 6))
    values[:3, :3] = np.nan
    assert np.isnan(block_mean(values, 3)[0, 0])
    assert (block_mean(values, 3).ravel()[1:] == 1).all()


@pytest.mark.parametrize(
    ("shape", "side"), [((400, 400), 1), ((401, 3), 2), ((5456, 8320), 21), ((1, 1), 1)]
)
def test_blocks_are_as_small_as_the_figure_allows(shape: tuple[int, int], side: int) -> None:
    assert block_side(shape) == side


@pytest.mark.parametrize(("shape", "most"), [((67, 131), 400), ((67, 131), 13), ((389, 53), 30)])
def test_a_summary_read_by_bands_is_that_of_the_whole(shape: tuple[int, int], most: int) -> None:
    values = holed(shape)
    made = summarise(ArraySource(values), most)
    wide = values.astype(float)
    np.testing.assert_allclose(made.image, slow_block_mean(values, made.block), rtol=1e-6)
    for axis, profile in ((0, made.columns), (1, made.rows)):
        np.testing.assert_allclose(profile.mean, np.nanmean(wide, axis), rtol=1e-12)
        np.testing.assert_allclose(profile.scatter, np.nanstd(wide, axis), rtol=1e-9)
        assert (profile.count == np.isfinite(wide).sum(axis)).all()
    assert np.isfinite(wide).sum() == len(made.sample)
    assert made.mean == pytest.approx(np.nanmean(wide), rel=1e-12)
    assert made.std == pytest.approx(np.nanstd(wide), rel=1e-9)
    assert made.median == pytest.approx(np.nanmedian(values), rel=1e-6)


def test_small_differences_on_a_large_level_do_not_cancel() -> None:
    values = 30_000 + 1e-2 * np.random.default_rng(1).normal(size=(80, 90))
    assert summarise(ArraySource(values)).std == pytest.approx(values.std(), rel=1e-6)


def test_bands_cover_every_row_once_on_borders_of_blocks() -> None:
    values = np.arange(1000 * 3).reshape(1000, 3)
    read = list(bands(ArraySource(values), 21))
    assert all(y0 % 21 == 0 for y0, _ in read)
    np.testing.assert_array_equal(np.concatenate([v for _, v in read]), values)


def test_the_sample_of_a_large_map_is_bounded_and_visits_all_columns() -> None:
    ny, nx = 1500, 1400
    columns = np.broadcast_to(np.arange(nx, dtype=np.float32), (ny, nx))
    sample = summarise(ArraySource(columns)).sample
    assert SAMPLE / 3 < len(sample) <= SAMPLE
    assert len(np.unique(sample)) == nx
    assert np.bincount(sample.astype(int)).std() < 1


def test_a_map_without_good_pixels_is_no_error() -> None:
    made = summarise(ArraySource(np.full((9, 11), np.nan, np.float32)))
    assert len(made.sample) == 0
    assert np.isnan([made.mean, made.std, made.median, made.robust_std]).all()
    assert np.isnan(made.image).all()


def test_a_ratio_is_nan_where_there_is_no_light() -> None:
    below = np.array([[2.0, 0.0, -1.0, np.nan]], np.float32)
    ratio = RatioSource(ArraySource(np.ones_like(below)), ArraySource(below)).read((0, 1), (0, 4))
    np.testing.assert_array_equal(ratio, [[0.5, np.nan, np.nan, np.nan]])


@pytest.mark.parametrize("shape", [(67, 131), (300, 517)])
def test_white_noise_has_a_flat_spectrum_at_the_level_of_its_errors(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    sigma = 1e-3 * np.linspace(1, 2, shape[1]) * np.ones(shape)
    delta = sigma * rng.normal(size=shape)
    delta[rng.random(shape) < 0.2] = np.nan
    made = spectrum(ArraySource(delta), ArraySource(sigma))
    assert made is not None
    ring, power = made.radial()
    ratio = power[ring > 0.1] / made.white
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    assert abs(np.polyfit(ring[ring > 0.1], ratio, 1)[0]) < 0.5


def test_the_mean_power_is_the_variance() -> None:
    delta = np.random.default_rng(4).normal(0, 2.0, (128, 128))
    made = spectrum(ArraySource(delta), ArraySource(np.ones_like(delta)))
    assert made is not None
    assert made.power.mean() == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("shape", [(67, 131), (300, 517)])
def test_a_fringe_stands_at_its_frequency(shape: tuple[int, int]) -> None:
    rng = np.random.default_rng(5)
    fy, fx = 0.11, 0.23
    y, x = np.mgrid[: shape[0], : shape[1]]
    delta = np.sin(2 * np.pi * (fy * y + fx * x)) + 0.1 * rng.normal(size=shape)
    made = spectrum(ArraySource(delta), ArraySource(np.full(shape, 0.1)))
    assert made is not None
    rows, columns = made.frequencies
    i, j = np.unravel_index(made.power.argmax(), made.power.shape)
    found = np.array([rows[i], columns[j]]) * np.sign(columns[j])
    np.testing.assert_allclose(found, (fy, fx), atol=0.6 / min(made.power.shape))


def test_no_good_pixel_has_no_spectrum() -> None:
    nothing = ArraySource(np.full((20, 30), np.nan))
    assert spectrum(nothing, nothing) is None


def test_the_detail_is_the_middle_pixel_by_pixel() -> None:
    values = holed((501, 233))
    made = detail(ArraySource(values), ArraySource(-values))
    y0, x0 = made.start
    assert made.delta.block == 1
    for shown, whole in ((made.delta, values), (made.sigma, -values)):
        np.testing.assert_array_equal(shown.image, whole[y0 : y0 + 96, x0 : x0 + 96])
    assert abs(y0 + 48 - 250.5) <= 0.5
    assert abs(x0 + 48 - 116.5) <= 0.5


@pytest.mark.parametrize("most", [400, 13])
def test_flags_are_counted_and_shown(most: int) -> None:
    rng = np.random.default_rng(6)
    values = (rng.random((67, 131)) < 0.01).astype(np.uint8) * rng.integers(1, 128, (67, 131))
    values = values.astype(np.uint8)
    made = summarise_flags(ArraySource(values), most)
    assert made.masked == (values != 0).sum()
    for bit in range(8):
        assert made.counts[1 << bit] == (values >> bit & 1).sum()
    side = made.block
    for i, j in np.ndindex(made.image.shape):
        block = values[i * side : (i + 1) * side, j * side : (j + 1) * side]
        assert made.image[i, j] == np.bitwise_or.reduce(block, axis=None)
        assert made.share[i, j] == pytest.approx((block != 0).mean())
