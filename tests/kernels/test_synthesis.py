"""Shot noise: exact in distribution; samples: the closed forms."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import stats

from pixcal.kernels import synthesis
from pixcal.kernels.synthesis import EXACT_BELOW, Stream, generator, pixel_key

SHAPE = (130, 211)


def filled(value: float, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    return np.full(shape, value, np.float32)


def charge(mean: np.ndarray, w: np.ndarray, shot: bool = True, well: float = np.inf) -> np.ndarray:
    out = np.empty_like(mean)
    synthesis.collect(mean, np.zeros_like(mean), w, shot, well, out)
    return out


def test_a_key_always_gives_the_same_numbers_and_no_other_key_does() -> None:
    keys = [(1, Stream.NOISE, 0, 1), (2, Stream.NOISE, 0, 1), (1, Stream.PHASE, 0, 1)]
    keys += [(1, Stream.NOISE, 1, 0), (1, Stream.NOISE, 0), (1, Stream.NOISE, 0, 1, 0)]
    first = [generator(*key).random(4).tolist() for key in keys]
    assert first == [generator(*key).random(4).tolist() for key in keys]
    assert len({tuple(numbers) for numbers in first}) == len(keys)


def test_pixels_of_each_purpose_have_a_key_of_their_own() -> None:
    keys = [(1, Stream.NOISE, 0, 1), (2, Stream.NOISE, 0, 1), (1, Stream.EFFECT, 0, 1)]
    keys += [(1, Stream.NOISE, 1, 0), (1, Stream.NOISE, 0), (1 << 40, Stream.NOISE, 0, 1)]
    found = [pixel_key(*key) for key in keys]
    assert found == [pixel_key(*key) for key in keys]
    assert len(set(found)) == len(keys)
    assert all(0 <= word < 1 << 32 for key in found for word in key)


def test_normals_are_those_of_numpy() -> None:
    out = np.empty((17, 31), np.float32)
    synthesis.fill_normal(generator(5, Stream.NOISE, 1), out)
    expected = generator(5, Stream.NOISE, 1).standard_normal((17, 31))
    assert np.array_equal(out, expected.astype(np.float32))


@pytest.mark.parametrize("mean", [0.01, 0.1, 1.0, 3.7, 11.0, 15.99])
def test_faint_charge_is_the_exact_poisson_quantile(mean: float) -> None:
    w = np.linspace(-5, 5.5, 4001)
    expected = stats.poisson.isf(stats.norm.sf(w), mean)
    found = [synthesis.poisson_quantile(mean, x) for x in w]
    # At a step of the quantile the last digit decides.
    assert np.count_nonzero(found != expected) == 0


@pytest.mark.parametrize(
    "mean", [0.1, 0.5, 2.0, 9.0, 15.9, 16.0, 21.5, 50.0, 300.0, 4e3, 2.5e4, 1e5]
)
def test_charge_has_the_moments_and_the_distribution_of_poisson(mean: float) -> None:
    # Equal steps of probability instead of random numbers: no luck involved.
    n = 1 << 20
    probability = (np.arange(n) + 0.5) / n
    w = stats.norm.ppf(probability).astype(np.float32).reshape(1, -1)
    level = np.float32(mean)
    found = charge(filled(level, w.shape), w).astype(np.float64)
    assert np.array_equal(found, np.floor(found))
    level = float(level)
    assert found.mean() == pytest.approx(level, rel=2e-5)
    assert found.var() == pytest.approx(level, rel=2e-4)
    skewness = ((found - found.mean()) ** 3).mean() / found.std() ** 3
    assert skewness == pytest.approx(1 / np.sqrt(level), rel=2e-3, abs=2e-4)
    values, counts = np.unique(found, return_counts=True)
    error = np.abs(np.cumsum(counts) / n - stats.poisson.cdf(values, level)).max()
    assert error < 2e-5 + 2 / n


def test_no_light_no_charge_and_more_light_more_charge() -> None:
    w = generator(1, Stream.NOISE).standard_normal(SHAPE).astype(np.float32)
    assert not charge(filled(0), w).any()
    assert not charge(filled(-3), w).any()
    levels = [0.3, 5.0, EXACT_BELOW - 0.01, EXACT_BELOW, 40.0, 900.0]
    charges = [charge(filled(level), w) for level in levels]
    for less, more in pairwise(charges):
        assert (more >= less).all()


def test_mixed_levels_are_each_their_own() -> None:
    w = generator(2, Stream.NOISE).standard_normal(SHAPE).astype(np.float32)
    levels = np.array([0.0, 0.7, 12.0, 60.0, 3e4], np.float32)
    chosen = generator(3, Stream.NOISE).integers(0, levels.size, SHAPE)
    found = charge(levels[chosen], w)
    for n, level in enumerate(levels):
        assert np.array_equal(found[chosen == n], charge(filled(level), w)[chosen == n])


def test_charge_stops_at_the_full_well() -> None:
    w = generator(4, Stream.NOISE).standard_normal(SHAPE).astype(np.float32)
    free = charge(filled(1000), w)
    assert np.array_equal(charge(filled(1000), w, well=1010), np.minimum(free, 1010))
    assert np.array_equal(charge(filled(1000.25), w, shot=False), filled(1000.25))
    assert np.array_equal(charge(filled(1000.25), w, shot=False, well=7), filled(7))


def test_light_is_the_model() -> None:
    rng = generator(6, Stream.NOISE)
    iota, alpha, psi = rng.uniform(1e4, 4e4, SHAPE), rng.uniform(1e4, 2e4, SHAPE), rng.random(SHAPE)
    y, x = np.arange(SHAPE[0])[:, None], np.arange(SHAPE[1])
    phi, kx, ky = 2.1, 3e-3, -2e-3
    out = filled(np.nan)
    synthesis.illuminate(
        iota.astype(np.float32),
        (alpha * np.sin(psi)).astype(np.float32),
        (alpha * np.cos(psi)).astype(np.float32),
        1.03,
        0.97,
        synthesis.turns(kx * x),
        synthesis.turns(phi + ky * y[:, 0]),
        out,
    )
    expected = 1.03 * iota + 0.97 * alpha * np.sin(psi + phi + kx * x + ky * y)
    assert np.allclose(out, expected, rtol=0, atol=4e4 * 5e-7)


def test_samples_are_rounded_and_clipped() -> None:
    rng = generator(8, Stream.NOISE)
    electrons = np.floor(rng.uniform(0, 600, SHAPE)).astype(np.float32)
    bias = rng.uniform(-30, 90, SHAPE).astype(np.float32)
    noise = rng.standard_normal(SHAPE).astype(np.float32)
    out = np.zeros(SHAPE, np.uint16)
    adu = np.empty_like(electrons)
    read = rng.uniform(3, 7, SHAPE).astype(np.float32)
    gain = rng.uniform(2, 3, SHAPE).astype(np.float32)
    synthesis.amplify(electrons, bias, noise, read, 1 / gain, adu)
    synthesis.convert(adu, 1, 0, 200, out)
    exact = (electrons + read * noise.astype(np.float64)) / gain + bias
    assert np.abs(out - np.clip(exact, 0, 200)).max() <= 0.5 + 1e-4
    assert out.max() == 200
    assert out.min() == 0
    assert (out[exact > 200] == 200).all()
    assert (out[exact < 0] == 0).all()
    synthesis.convert(adu, 16, 0, 192, out)
    assert np.abs(out - np.clip(exact, 0, 192)).max() <= 8 + 1e-4
    assert set(np.unique(out)) == set(range(0, 193, 16))
    synthesis.convert(adu, 16, 32, 192, out)
    assert set(np.unique(out)) == set(range(32, 193, 16))


def test_waves_are_sums_of_cosines_on_any_rows() -> None:
    rng = generator(9, Stream.NOISE)
    (fy, fx, phase), size = rng.uniform(-0.5, 0.5, (3, 5)), rng.uniform(1, 4, 5).astype(np.float32)
    y, x = np.arange(37), np.arange(53)
    down = size * synthesis.turns(2 * np.pi * (y[:, None] * fy + phase))
    along = synthesis.turns(2 * np.pi * fx[:, None] * x)
    whole, parts = np.ones((2, 37, 53), np.float32)
    synthesis.add_waves(down, along, whole)
    turn = np.multiply.outer(y, fy)[:, None] + np.multiply.outer(x, fx) + phase
    np.testing.assert_allclose(whole, 1 + np.cos(2 * np.pi * turn) @ size, atol=1e-4)
    for rows in (slice(11), slice(11, 37)):
        synthesis.add_waves(down[:, rows], along, parts[rows])
    np.testing.assert_array_equal(parts, whole)
