"""The robust combination: plain statistics where nothing is wrong, and little harm where it is."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.stats import kurtosis, median_abs_deviation

from pixcal.kernels.medians import median, robust_sigma
from pixcal.kernels.robust import (
    Combination,
    clipped_variance_factor,
    median_and_deviation,
    median_around,
)

F32 = NDArray[np.float32]


def noise(shape: tuple[int, ...], sigma: float = 5.0, seed: int = 0) -> F32:
    return np.random.default_rng(seed).normal(0, sigma, shape).astype(np.float32)


def combine(
    frames: F32, *, clip: float = 4.0, lamp: bool = False, quantum: float = 0.0, batch: int = 64
) -> Combination:
    combination = Combination(clip=clip, lamp=lamp, quantum=quantum)
    for first in range(0, len(frames), batch):
        combination.update(frames[first : first + batch])
    return combination


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8, 13, 63, 64])
def test_median_and_deviation_are_those_of_numpy(n: int) -> None:
    frames = 500 + noise((n, 7, 19))
    middle, deviation = median_and_deviation(frames)
    np.testing.assert_allclose(middle, np.median(frames, axis=0), rtol=1e-6)
    np.testing.assert_allclose(
        deviation, np.median(np.abs(frames - middle), axis=0), rtol=1e-5, atol=1e-4
    )


def test_missing_samples_do_not_count_in_the_median() -> None:
    frames = noise((9, 5, 6))
    frames[np.random.default_rng(1).random(frames.shape) < 0.3] = np.nan
    frames[:, 2, 3] = np.nan
    middle, deviation = median_and_deviation(frames)
    assert np.isnan(middle[2, 3])
    assert np.isnan(deviation[2, 3])
    good = np.isfinite(frames).any(axis=0)
    np.testing.assert_allclose(middle[good], np.nanmedian(frames[:, good], axis=0), rtol=1e-6)
    off = np.nanmedian(np.abs(frames - middle)[:, good], axis=0)
    np.testing.assert_allclose(deviation[good], off, rtol=1e-5, atol=1e-6)


def test_without_outliers_it_is_the_plain_mean_variance_and_kurtosis() -> None:
    # Frames that sum to nothing over the pixels' median: no common part to take out.
    frames = 1000 + noise((29, 31, 37))
    frames -= np.median(frames - 1000, axis=(1, 2), keepdims=True)
    found = combine(frames, clip=100).result()
    np.testing.assert_allclose(found.mean, frames.mean(axis=0, dtype=float), atol=1e-3)
    np.testing.assert_allclose(found.variance, frames.var(axis=0, ddof=1, dtype=float), rtol=1e-2)
    np.testing.assert_allclose(found.excess_kurtosis, kurtosis(frames, axis=0), atol=0.05)
    assert (found.kept == 29).all()


@pytest.mark.parametrize("batch", [64, 13, 1])
def test_the_result_does_not_depend_on_the_batches_after_the_first(batch: int) -> None:
    frames = 300 + noise((64 + 39, 11, 13))
    whole = combine(frames).result()
    parts = Combination(clip=4, lamp=False, quantum=0)
    parts.update(frames[:64])
    for first in range(64, len(frames), batch):
        parts.update(frames[first : first + batch])
    found = parts.result()
    np.testing.assert_array_equal(found.mean, whole.mean)
    np.testing.assert_array_equal(found.variance, whole.variance)


@pytest.mark.parametrize("n", [2, 3, 4, 5, 16, 100])
def test_a_particle_costs_no_more_than_the_sample_that_it_hits(n: int) -> None:
    sigma = 5.0
    clean = 500 + noise((n, 32, 32), sigma)
    hit = clean.copy()
    rng = np.random.default_rng(3)
    y, x = np.divmod(rng.choice(32 * 32, 300, replace=False), 32)
    t = rng.integers(0, n, 300)
    hit[t, y, x] += rng.uniform(50, 5e4, 300).astype(np.float32)
    shift = (combine(hit).result().mean - combine(clean).result().mean)[y, x]
    # Without one of n samples the mean moves by sigma / sqrt(n (n - 1)).
    assert np.sqrt(np.mean(shift**2)) < 1.15 * sigma / np.sqrt(n * (n - 1))


@pytest.mark.parametrize("clip", [4.0, 5.0])
def test_the_variance_is_corrected_for_the_clipping(clip: float) -> None:
    frames = 500 + noise((160, 64, 64))
    found = combine(frames, clip=clip).result()
    plain = frames.var(axis=0, ddof=1, dtype=float).mean()
    assert found.variance.mean() == pytest.approx(plain, rel=1.5e-3)
    assert found.mean.mean() == pytest.approx(frames.mean(dtype=float), abs=5e-3)


def test_the_clipping_factor_is_that_of_a_cut_gaussian() -> None:
    z = np.random.default_rng(2).normal(size=2_000_000)
    for clip in (1.5, 2.5):
        assert clipped_variance_factor(clip) == pytest.approx(z[np.abs(z) < clip].var(), rel=3e-3)
    assert clipped_variance_factor(9) == pytest.approx(1, abs=1e-12)


def test_a_drift_of_all_pixels_is_no_noise_and_no_outlier() -> None:
    drift = np.linspace(0, 300, 200, dtype=np.float32)
    frames = 500 + noise((200, 40, 40)) + drift[:, None, None]
    found = combine(frames).result()
    assert (found.kept / found.seen).mean() > 0.999
    assert found.mean.mean() == pytest.approx(frames.mean(dtype=float), abs=0.02)
    assert found.variance.mean() == pytest.approx(25, rel=0.01)


def test_the_power_of_a_lamp_is_no_noise_and_no_outlier() -> None:
    rng = np.random.default_rng(4)
    response = rng.normal(1, 0.02, (48, 48))
    power = rng.uniform(0.7, 1.3, 150)
    expected = 20_000 * power[:, None, None] * response
    frames = rng.poisson(expected).astype(np.float32)
    found = combine(frames, lamp=True).result()
    assert (found.kept / found.seen).mean() > 0.999
    plain = expected.mean(axis=0)
    np.testing.assert_allclose(found.mean, plain, rtol=5 * np.sqrt(1 / 20_000 / 150))
    # Photon noise of frames made equally bright: mean power times the mean of its inverse.
    usual = 20_000 * power.mean() ** 2 * np.mean(1 / power)
    assert found.variance.mean() == pytest.approx(usual, rel=0.02)


def test_noise_below_the_step_of_the_samples_is_kept() -> None:
    frames = np.round(500.2 + noise((300, 20, 20), 0.35)).astype(np.float32)
    found = combine(frames, quantum=1.0).result()
    assert (found.kept / found.seen).mean() > 0.995
    assert found.mean.mean() == pytest.approx(frames.mean(dtype=float), abs=0.005)


def test_constant_samples_are_all_kept() -> None:
    found = combine(np.full((70, 5, 5), 1234.5, np.float32), lamp=True).result()
    assert (found.kept == 70).all()
    np.testing.assert_allclose(found.mean, 1234.5)
    np.testing.assert_allclose(found.variance, 0, atol=1e-3)


def test_samples_that_are_missing_are_neither_seen_nor_kept() -> None:
    frames = 100 + noise((20, 6, 6))
    frames[3] = np.nan
    frames[:, 1, 1] = np.nan
    found = combine(frames).result()
    assert np.isnan(found.mean[1, 1])
    assert found.seen[1, 1] == 0
    assert (np.delete(found.seen, 7) == 19).all()
    assert np.isfinite(np.delete(found.mean, 7)).all()


def test_noise_with_two_levels_has_a_flat_top() -> None:
    rng = np.random.default_rng(5)
    frames = 500 + noise((600, 16, 16))
    frames[:, 4, 9] += np.where(rng.random(600) < 0.5, 0, 25).astype(np.float32)
    shape = combine(frames).result().excess_kurtosis
    assert shape[4, 9] < -1
    assert np.abs(np.delete(shape, 4 * 16 + 9)).max() < 1


def test_a_single_frame_is_its_own_mean_without_a_variance() -> None:
    frame = 100 + noise((1, 4, 4))
    found = combine(frame).result()
    np.testing.assert_allclose(found.mean, frame[0])
    assert np.isnan(found.variance).all()


def test_no_frames_have_no_result() -> None:
    with pytest.raises(ValueError, match="no frames"):
        Combination(clip=4, lamp=False, quantum=0).result()


def test_medians_around_pixels_are_those_of_scipy() -> None:
    values = np.random.default_rng(16).standard_normal((17, 23)).astype(np.float32)
    expected = median_filter(values, 5, mode="reflect")
    np.testing.assert_array_equal(median_around(values, 5), expected)


@pytest.mark.parametrize("count", [1, 2, 4096, 4097, 50_000, 50_001])
@pytest.mark.parametrize("kind", ["normal", "codes", "zeros", "sorted", "periodic"])
def test_medians_are_exact(count: int, kind: str) -> None:
    """Also where the sample that narrows the search tells nothing of the rest."""
    values = np.random.default_rng(count).standard_normal(count)
    values = {
        "normal": values,
        "codes": np.rint(3 * values),
        "zeros": np.where(values > 0.5, values, 0.0),
        "sorted": np.sort(values),
        "periodic": np.where(np.arange(count) % (int(count ** (1 / 3)) | 1) == 0, 9.0, values),
    }[kind]
    expected = np.median(values)
    for kept in (values, values.astype(np.float32)):
        exact = expected if kept.dtype == values.dtype else np.median(kept)
        assert median(kept.copy()) == exact


@pytest.mark.parametrize("count", [1, 6, 1001])
def test_robust_sigma_is_that_of_scipy_about_zero(count: int) -> None:
    values = np.random.default_rng(count).standard_normal(count)
    expected = median_abs_deviation(values, center=lambda v, axis: 0.0, scale="normal")
    assert robust_sigma(values) == pytest.approx(expected, rel=1e-9)
    assert robust_sigma(np.append(values, np.nan)) == robust_sigma(values)
    assert np.isnan(robust_sigma(np.full(count, np.nan)))
