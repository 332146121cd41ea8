"""Two-way projections: a turn is weighted least squares of every frame, then of every pixel."""

import numpy as np

from pixcal.kernels.two_way import turn


def test_a_turn_is_least_squares_of_frames_and_the_sums_for_pixels() -> None:
    rng = np.random.default_rng(2)
    t, n, j, k = 13, 57, 3, 2
    table = rng.standard_normal((t, n)).astype(np.float32)
    weight = rng.uniform(0.2, 2, (t, n)).astype(np.float32)
    weight[4, 7] = 0
    place = rng.standard_normal((j, n)).astype(np.float32)
    time = rng.standard_normal((k, t)).astype(np.float32)
    share = rng.standard_normal((k, n)).astype(np.float32)
    inverse = np.stack([np.linalg.inv((place * w) @ place.T) for w in weight.astype(float)])
    rest, right = table.copy(), np.empty((k, n), np.float32)
    turn(rest, weight, place, inverse, time, share, right)
    expected = table - time.T @ share
    for row, w in zip(expected, weight, strict=True):
        root = np.sqrt(w)
        row -= np.linalg.lstsq((place * root).T, row * root, rcond=None)[0] @ place
    np.testing.assert_allclose(rest, expected, atol=2e-5)
    np.testing.assert_allclose(right, time @ (weight * expected), atol=1e-4)
