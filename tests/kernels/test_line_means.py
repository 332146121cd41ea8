"""Means of lines are taken off without a trace in white noise."""

import numpy as np
import pytest

from pixcal.kernels.line_means import REACH, without_line_means
from pixcal.model.arrays import F32


def correlation(noise: F32, dy: int, dx: int) -> float:
    ny, nx = noise.shape[1:]
    return float((noise[:, : ny - dy, : nx - dx] * noise[:, dy:, dx:]).mean())


@pytest.mark.parametrize("lines", [0.0, 2.0])
def test_white_noise_stays_white_whatever_lines_share(lines: float) -> None:
    rng, shape = np.random.default_rng(1), (400, 40, 53)
    noise = rng.standard_normal(shape) + lines * rng.standard_normal((*shape[:2], 1))
    noise += lines * rng.standard_normal((shape[0], 1, shape[2]))
    found = without_line_means(noise.astype(np.float32), np.ones(shape[1:], np.bool_))
    error = 1 / np.sqrt(noise.size)
    assert correlation(found, 0, 0) == pytest.approx(1, abs=2e-3 + 4 * error)
    for step in ((0, 1), (1, 0), (2, 0), (0, REACH), (1, 1)):
        assert correlation(found, *step) == pytest.approx(0, abs=2e-3 + 4 * error)


def test_pixels_that_are_not_used_change_nothing() -> None:
    rng, shape = np.random.default_rng(2), (3, 30, 31)
    noise, used = rng.standard_normal(shape).astype(np.float32), rng.random(shape[1:]) < 0.9
    other = np.where(used, noise, np.float32(1e3))
    assert np.array_equal(without_line_means(noise, used), without_line_means(other, used))
