"""Waves of one length that two maps share: found in noise, at their scale, and none in none."""

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.estimators.maps.map_fit import polynomial, without
from pixcal.estimators.maps.ring_power import (
    NARROW,
    Ring,
    _of_long_waves,
    _of_short_waves,
    ring_power,
)

F64 = NDArray[np.float64]
SHAPE = (61, 67)
WAVES = 12


def waves(rng: np.random.Generator, scale: float, shape: tuple[int, int] = SHAPE) -> F64:
    """Of unit variance, of directions evenly apart, so that none beats with another for long."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    angle = np.pi * (np.arange(WAVES) + rng.random()) / WAVES
    phase = 2 * np.pi * rng.random(WAVES)
    every = [
        np.cos((np.cos(a) * x + np.sin(a) * y) / scale + p)
        for a, p in zip(angle, phase, strict=True)
    ]
    return np.asarray(np.sum(every, axis=0) * np.sqrt(2 / WAVES))


def shared(one: F64, other: F64) -> Ring:
    free = polynomial(one.shape, 2).reshape(6, -1).T
    a, b = (np.fft.fft2(without(m.reshape(-1, 1), free).reshape(m.shape)) for m in (one, other))
    return ring_power((a * np.conj(b)).real / one.size**2)


@pytest.mark.parametrize("scale", [2.3, 4.0, 5.5])
@pytest.mark.parametrize("noise", [0.0, 3.0])
def test_waves_are_found_with_their_scale(scale: float, noise: float) -> None:
    rng = np.random.default_rng(int(10 * scale))
    pattern = waves(rng, scale)
    found = shared(*(pattern + noise * rng.standard_normal(SHAPE) for _ in range(2)))
    assert abs(found.variance - 1) < 4 * found.error
    assert found.variance > 5 * found.noise
    assert abs(found.scale - scale) < 4 * found.scale_error < 0.5 * scale


def test_noise_that_is_not_shared_is_no_wave() -> None:
    rng = np.random.default_rng(3)
    found = [shared(*rng.standard_normal((2, *SHAPE))) for _ in range(60)]
    beyond = [f.variance / f.noise for f in found]
    # The best of some twenty scales: somewhat above nothing, hardly ever by much.
    assert -0.5 < np.mean(beyond) < 1.5
    assert max(beyond) < 4


def test_what_single_pixels_share_is_no_wave() -> None:
    rng = np.random.default_rng(4)
    pixels = rng.standard_normal(SHAPE)
    found = [shared(*(pixels + rng.standard_normal(SHAPE) for _ in range(2))) for _ in range(20)]
    assert np.mean([f.variance for f in found]) < 0.2


def test_a_larger_pattern_is_as_many_times_as_large() -> None:
    rng = np.random.default_rng(5)
    pattern, noise = waves(rng, 3.0), rng.standard_normal((2, *SHAPE))
    one, three = (shared(*(scale * (pattern + noise))) for scale in (1.0, 3.0))
    assert three.variance == pytest.approx(9 * one.variance)
    assert three.noise == pytest.approx(9 * one.noise)
    assert three.error == pytest.approx(9 * one.error)
    assert three.scale == pytest.approx(one.scale)


def test_nothing_at_all_is_nothing() -> None:
    found = ring_power(np.zeros(SHAPE))
    assert found.variance == 0
    assert np.isinf(found.scale_error)


@pytest.mark.parametrize("shape", [(61, 67), (40, 128)])
def test_templates_of_short_and_long_waves_agree_where_they_meet(shape: tuple[int, int]) -> None:
    scale = min(shape) / NARROW
    short, long = _of_short_waves(shape, scale), _of_long_waves(shape, scale)
    assert short.sum() == pytest.approx(1)
    assert 0.9 < long.sum() < 1
    assert abs(short - long).sum() < 0.4
    assert np.corrcoef(short.ravel(), long.ravel())[0, 1] > 0.95
