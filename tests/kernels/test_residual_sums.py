"""Sums over products of residuals: as written out in numpy."""

import numpy as np
import pytest

from pixcal.kernels.residual_sums import residual_sums

STEPS = np.array([(0, 0), (0, 1), (1, 0), (1, -1), (2, 0)])
TAKEN = np.array([0.01, 0.02, 0.0, -0.01, 0.03])
LIMIT = 3.0


def test_they_are_those_of_the_definition() -> None:
    rng = np.random.default_rng(7)
    t, y, x = 5, 11, 13
    model = rng.uniform(-50, 900, (t, y, x))
    factor, read = rng.uniform(0.9, 1.1, (y, x)), rng.uniform(80, 120, (y, x))
    good = rng.random((y, x)) < 0.9
    of_time, of_pixels = rng.random((t, 2)), rng.uniform(1, 5, (2, y, x))
    shot = np.maximum(model, 0) * factor
    variance = shot + read
    rest = np.sqrt(variance) * rng.standard_normal((t, y, x))
    rest[rng.random((t, y, x)) < 0.05] = np.nan
    used = good & (np.abs(np.nan_to_num(rest, nan=1e9)) <= LIMIT * np.sqrt(variance))
    assert (good & ~used).any()
    left = 1 - np.einsum("tk,kyx->tyx", of_time, of_pixels) / variance
    size = rest / np.sqrt(variance * left)
    single = [a.astype(np.float32) for a in (rest, model, factor, read)]
    fitted = [a.astype(np.float32) for a in (of_time, of_pixels)]
    found = residual_sums(*single, good, *fitted, TAKEN, STEPS, LIMIT)
    for (dy, dx), lost, sums in zip(STEPS, TAKEN, found, strict=True):
        one = (slice(None), slice(0, y - dy), slice(max(0, -dx), x - max(0, dx)))
        two = (slice(None), slice(dy, y), slice(max(0, dx), x - max(0, -dx)))
        both = used[one] & used[two]
        root = np.sqrt(variance[one] * variance[two])[both]
        first = ((shot[one] + shot[two])[both]) / 2 / root
        still = np.broadcast_to(read, rest.shape)
        second = ((still[one] + still[two])[both]) / 2 / root
        product = size[one][both] * size[two][both] + lost
        wanted = [
            both.sum(),
            first @ first,
            first @ second,
            second @ second,
            first @ product,
            second @ product,
            product @ product,
        ]
        assert sums == pytest.approx(wanted, rel=1e-4, abs=1e-3)
