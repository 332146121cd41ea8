"""Sums over the pixels of rows, against NumPy."""

from functools import partial

import numpy as np

from pixcal.kernels.normal_matrix import symmetric
from pixcal.kernels.sample_sums import row_sums


def test_the_sums_are_those_of_numpy() -> None:
    rng = np.random.default_rng(5)
    rest, light, weight = rng.standard_normal((3, 11, 7, 13)).astype(np.float32)
    weight = np.abs(weight)
    g, theta = (rng.standard_normal(s).astype(np.float32) for s in ((11, 3), (3, 7, 13)))
    y, x = (np.arange(n, dtype=np.float32) - np.float32((n - 1) / 2) for n in (7, 13))
    inner, of_rest, across, own = row_sums(rest, weight, light, g, theta, y, x)
    slope = g[:, 1, None, None] * theta[2] - g[:, 2, None, None] * theta[1]
    frames = [np.broadcast_to(m, rest.shape) for m in theta]
    modes = np.stack([*frames, slope * x, slope * y[:, None]])
    close = partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-4)
    close(symmetric(inner), np.einsum("mtyx,ntyx,tyx->tmn", modes, modes, weight))
    close(of_rest, np.einsum("mtyx,tyx,tyx->tm", modes, weight, rest))
    close(across, np.einsum("mtyx,tyx,tyx->tym", modes, weight, light))
    both = np.stack([light * light, light * rest], axis=-1)
    close(own, np.einsum("tyxn,tyx->yn", both, weight))
