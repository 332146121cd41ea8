"""The kernels of still fringes against plain NumPy, also where phases and frames are odd."""

import numpy as np
import pytest

from pixcal.kernels.fringe_sums import close_fringes, fringe_block, turn_table

RHO, VISIBILITY, LEVEL, SIZE = 0.01, 0.9, 2e4, 1024
FILL = 65535
SCALE, OFFSET = 1.5, -300.0


def frames(n, rng):
    """Rows (t, 5) of frames: (B, A, cos phi, sin phi, f)."""
    phi = rng.uniform(0, 2 * np.pi, n)
    b = 1 + 0.05 * rng.standard_normal(n)
    return np.column_stack([b, b, np.cos(phi), np.sin(phi), 1 / b]).astype(np.float32)


def design(rows):
    b, a, c, s, _ = rows.astype(float).T
    return np.stack([b, a * c, a * s], axis=1)


def weights(rows, psi):
    s, c = VISIBILITY * np.sin(psi), VISIBILITY * np.cos(psi)
    return rows[:, 4].astype(float) / (1 + RHO + s * rows[:, 2] + c * rows[:, 3])


def normal_over_a_turn(rows):
    g, at = design(rows), np.triu_indices(3)
    turn = 2 * np.pi * np.arange(SIZE) / SIZE
    return np.stack(
        [((g * weights(rows, psi)[:, None]).T @ g)[at] for psi in turn], axis=1
    )  # fmt: skip


def closed(rows, codes, place):
    """Sums of pixels (t, p) and their batch: turn, sigma, the run's sums."""
    n = codes.shape[1]
    psi = 2 * np.pi * place
    level = np.full(n, LEVEL, np.float32)
    s, c = ((VISIBILITY * f(psi)).astype(np.float32) for f in (np.sin, np.cos))
    part, missing, total = np.zeros((4, n)), np.zeros((7, n)), np.zeros((4, n))
    filled = fringe_block(
        codes, SCALE, OFFSET, FILL, rows, RHO, level, s, c, part, missing
    )  # fmt: skip
    turn, sigma = np.empty(n, np.float32), np.empty(n, np.float32)
    normal = normal_over_a_turn(rows)
    close_fringes(
        normal, turn_table(normal), place.astype(np.float32), level, VISIBILITY, part, missing,
        filled, level, total, turn, sigma,
    )  # fmt: skip
    assert not part.any()
    return turn, sigma, total


def solved(rows, codes, psi):
    """The same for one pixel, by NumPy."""
    keep = codes != FILL
    rows, data = rows[keep], SCALE * codes[keep].astype(float) + OFFSET
    g, w = design(rows), weights(rows, psi)
    normal = (g * w[:, None]).T @ g
    theta = np.linalg.solve(normal, (g * w[:, None]).T @ data)
    phasor = theta[2] + 1j * theta[1]
    gradient = np.array([0.0, theta[2], -theta[1]]) / abs(phasor) ** 2
    turn = np.angle(phasor * np.exp(-1j * psi))
    return turn, np.sqrt(LEVEL * gradient @ np.linalg.solve(normal, gradient))


def codes_of(rows, truth, rng):
    """Codes (t, p) of pixels with those phases."""
    s, c = VISIBILITY * np.sin(truth), VISIBILITY * np.cos(truth)
    model = design(rows) @ (LEVEL * np.stack([np.ones_like(truth), s, c]))
    noisy = rng.normal(model, np.sqrt(np.maximum(model, 0) + RHO * LEVEL))
    return np.rint((noisy - OFFSET) / SCALE).astype(np.uint16)


@pytest.mark.parametrize("off", [0.0, 0.15, 0.6, 2.5])
def test_a_batch_is_the_weighted_least_squares_of_its_samples(off):
    """Also where samples are lost, and where the pixel is far from its start model."""
    rng = np.random.default_rng(3)
    rows, place = frames(77, rng), rng.uniform(0, 1, 53)
    psi = 2 * np.pi * place
    codes = codes_of(rows, psi + off, rng)
    codes[[3, 40, 41], 7] = codes[76, 9] = FILL
    turn, sigma, _ = closed(rows, codes, place)
    for n in range(len(place)):
        wanted, error = solved(rows, codes[:, n], psi[n])
        assert abs(np.angle(np.exp(1j * (turn[n] - wanted)))) < 0.02 * error
        assert sigma[n] == pytest.approx(error, rel=2e-3)


def test_a_whole_turn_is_none():
    """A phase a hair below zero is 1.0 of a turn in single precision; nothing lies behind it."""
    rng = np.random.default_rng(4)
    rows = frames(77, rng)
    codes = np.repeat(codes_of(rows, np.zeros(1), rng), 2, axis=1)
    place = np.array([0.0, 1.0])
    normal = normal_over_a_turn(rows)
    behind = np.full((SIZE + 9, 9), np.nan, np.float32)
    behind[: SIZE + 1] = turn_table(normal)
    part, missing = np.zeros((4, 2)), np.zeros((7, 2))
    level = np.full(2, LEVEL, np.float32)
    s, c = np.zeros(2, np.float32), np.full(2, VISIBILITY, np.float32)
    fringe_block(codes, SCALE, OFFSET, FILL, rows, RHO, level, s, c, part, missing)
    turn, sigma = np.empty(2, np.float32), np.empty(2, np.float32)
    close_fringes(
        normal, behind[: SIZE + 1], place.astype(np.float32), level, VISIBILITY, part, missing,
        False, np.ones(2, np.float32), np.zeros((4, 2)), turn, sigma,
    )  # fmt: skip
    assert np.isfinite(turn).all()
    assert turn[1] == pytest.approx(turn[0], rel=1e-5)
    assert sigma[1] == pytest.approx(sigma[0], rel=1e-5)


@pytest.mark.parametrize("n", [1, 2])
def test_of_too_few_frames_nothing_is_known(n):
    rng = np.random.default_rng(5)
    rows, place = frames(n, rng), np.array([0.3])
    turn, sigma, _ = closed(rows, codes_of(rows, 2 * np.pi * place, rng), place)
    assert np.isnan([turn, sigma]).all()
