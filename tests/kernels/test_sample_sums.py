"""Sums over samples, against NumPy on copies of them."""

import numpy as np
import pytest

from pixcal.kernels.sample_sums import (
    clipped_residuals,
    count_beyond,
    count_remainders,
    frame_means,
    level_sums,
    neighbour_products,
    pixel_moments,
    products_by_level,
)

SHAPE = (13, 19, 23)


def some_frames() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals with outliers and gaps, their variance, and the good pixels."""
    rng = np.random.default_rng(11)
    variance = rng.uniform(1, 9, SHAPE).astype(np.float32)
    rest = (rng.standard_normal(SHAPE) * np.sqrt(variance)).astype(np.float32)
    rest.flat[::97] *= 9
    rest.flat[::89] = np.nan
    good = rng.random(SHAPE[1:]) > 0.1
    variance[:, ~good] = np.nan
    return rest, variance, good


def test_outliers_and_gaps_are_zero_and_counted() -> None:
    rng = np.random.default_rng(10)
    rest, _, good = some_frames()
    model = rng.uniform(-5, 40, SHAPE).astype(np.float32)
    shot, read = rng.uniform(0.8, 1.2, (2, *SHAPE[1:])).astype(np.float32)
    rest *= np.float32(4)
    samples = rest + model
    rest = samples - model
    variance = shot * np.maximum(model, 0) + read
    size = rest / np.sqrt(variance)
    use = good & (np.abs(size) < 8)
    assert np.any(good & (np.abs(size) > 8))
    limits = np.array([2.0, 5.0, 9.0])
    calm, kept, noise, beyond = clipped_residuals(samples, model, shot, read, good, 8.0, limits)
    np.testing.assert_allclose(calm, np.where(use, size, 0), rtol=1e-5)
    np.testing.assert_array_equal(kept, np.where(use, rest, 0))
    np.testing.assert_allclose(noise, variance[:, good].mean(axis=1), rtol=1e-5)
    np.testing.assert_array_equal(beyond[0], [(size[:, good] < -n).sum() for n in limits])
    np.testing.assert_array_equal(beyond[1], [(size[:, good] > n).sum() for n in limits])
    assert beyond[:, -1].min() > 0


def test_codes_are_counted_by_their_remainders() -> None:
    codes = np.random.default_rng(14).integers(0, 1 << 16, SHAPE).astype(np.uint16)
    good = some_frames()[2]
    expected = np.bincount(codes[:, good].ravel() % 16, minlength=16)
    np.testing.assert_array_equal(count_remainders(codes, good, 16), expected)
    signed = (codes.astype(int) - 40_000).astype(np.int32)
    expected = np.bincount(signed[:, good].ravel() % 16, minlength=16)
    np.testing.assert_array_equal(count_remainders(signed, good, 16), expected)


def test_outliers_are_counted_on_either_side() -> None:
    rest, variance, good = some_frames()
    size = (rest / np.sqrt(variance))[:, good]
    limits = np.array([2.0, 5.0, 9.0])
    below, above = count_beyond(rest, variance, good, limits)
    assert above[-1] > 0
    np.testing.assert_array_equal(below, [(size < -n).sum() for n in limits])
    np.testing.assert_array_equal(above, [(size > n).sum() for n in limits])


def test_sums_by_level_are_those_of_a_histogram() -> None:
    rng = np.random.default_rng(12)
    level, values, squared = rng.standard_normal((3, *SHAPE)).astype(np.float32)
    good = rng.random(SHAPE[1:]) > 0.2
    sums = np.zeros((4, 3))
    level_sums(level, good, -1.0, 0.5, values, squared, sums)
    # The first and the last bin take what is beyond them.
    edges = [-np.inf, -0.5, 0.0, 0.5, np.inf]
    own, weights = level[:, good], (1.0, values[:, good], squared[:, good] ** 2)
    for n, weight in enumerate(weights):
        each = np.broadcast_to(weight, own.shape).astype(float)
        np.testing.assert_allclose(sums[:, n], np.histogram(own, edges, weights=each)[0], 1e-5)


def test_moments_and_means_are_those_of_numpy() -> None:
    rest, _, good = some_frames()
    values = np.nan_to_num(rest)
    second, fourth = pixel_moments(values)
    np.testing.assert_allclose(second, (values.astype(float) ** 2).mean(axis=0))
    np.testing.assert_allclose(fourth, (values.astype(float) ** 4).mean(axis=0))
    values[:, ~good] = np.nan
    np.testing.assert_allclose(frame_means(values, good), values[:, good].mean(axis=1, dtype=float))


@pytest.mark.parametrize("every", [1, 3])
def test_neighbours_are_rows_down_and_columns_to_either_side(every: int) -> None:
    rng = np.random.default_rng(13)
    values = rng.standard_normal(SHAPE).astype(np.float32)
    steps = np.array([(0, 1), (1, 0), (2, 3), (1, -2)])
    pairs = rng.random((len(steps), *SHAPE[1:])).astype(np.float32)
    found = neighbour_products(values, pairs, steps, every)
    for own, weight, (dy, dx) in zip(found, pairs, steps, strict=True):
        moved = np.roll(values, (-dy, -dx), axis=(1, 2))
        rows, columns = SHAPE[1] - dy, SHAPE[2] - abs(dx)
        first = max(0, -dx)
        product = (values * moved)[::every, :rows, first : first + columns]
        expected = (product * weight[:rows, :columns]).sum(axis=(0, 2), dtype=float)
        np.testing.assert_allclose(own[:rows], expected, atol=1e-4)
        assert not own[rows:].any()


def test_neighbours_above_and_below_a_level_are_those_of_samples_set_to_zero() -> None:
    rng = np.random.default_rng(15)
    values, level = rng.standard_normal((2, *SHAPE)).astype(np.float32)
    steps = np.array([(0, 1), (1, 0), (1, -2)])
    pairs = rng.random((len(steps), *SHAPE[1:])).astype(np.float32)
    found = products_by_level(values, level, np.float32(0.2), pairs, steps, 2)
    for own, part in zip(found, (level > 0.2, level <= 0.2), strict=True):
        expected = neighbour_products(np.where(part, values, np.float32(0)), pairs, steps, 2)
        np.testing.assert_allclose(own, expected, rtol=1e-6)
