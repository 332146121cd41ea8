"""The compiled sums against plain NumPy, and what they leave out."""

import numpy as np
import pytest

from pixcal.kernels.bilinear import GOES_ON, N_SUMS, frame_sums, solve_pixels, sweep_batches


def case(seed=0, t=37, ny=5, nx=23, moving=True):
    rng = np.random.default_rng(seed)
    g = np.stack([1 + 0.1 * rng.normal(size=t), *rng.normal(size=(2, t))], axis=1)
    dk = 1e-3 * rng.normal(size=(t, 2)) * moving
    theta = np.stack([rng.uniform(5e3, 3e4, (ny, nx)), *rng.normal(0, 4e3, (2, ny, nx))])
    read = rng.uniform(100, 300, (ny, nx))
    shot = rng.uniform(0.9, 1.1, (ny, nx))
    codes = rng.integers(0, 60_000, (t, ny, nx)).astype(np.uint16)
    codes[3, 1, 2] = codes[5, 1, 2] = codes[7, 4, 20] = 65535
    return g, dk, theta, read, shot, codes


def turned(g, dk, y, x):
    z = (g[:, 1] + 1j * g[:, 2]) * np.exp(1j * (dk[:, 0] * x + dk[:, 1] * y))
    return np.stack([g[:, 0], z.real, z.imag], axis=1)


def expected(g, dk, theta, read, shot, codes, y0, x0, scale, offset):
    sums = np.zeros((N_SUMS, *theta.shape[1:]))
    for y, x in np.ndindex(theta.shape[1:]):
        local = turned(g, dk, y + y0, x + x0)
        model = local @ theta[:, y, x]
        ok = codes[:, y, x] != 65535
        w = ok / (shot[y, x] * np.maximum(model, 0) + read[y, x])
        r = scale * codes[:, y, x].astype(float) + offset - model
        normal = (local * w[:, None]).T @ local
        sums[:6, y, x] = normal[np.triu_indices(3)]
        sums[6:9, y, x] = local.T @ (w * r)
        sums[9, y, x] = (w * r * r).sum()
        sums[10, y, x] = ok.sum()
    return sums


def add_block(sums, codes, scale, offset, g, dk, y0, x0, *maps):
    """Add a block of no batch to sums (N_SUMS, y, x)."""
    n, (ny, nx) = len(codes), codes.shape[1:]
    part, total = np.zeros((2, ny, N_SUMS, nx))
    f, none = np.float32, np.zeros((0, ny, nx), np.float32)
    fixed = (m.astype(f) for m in maps)
    stops, closes = np.array([n]), np.array([GOES_ON])
    sweep_batches(
        codes,
        scale,
        offset,
        65535,
        g.astype(f),
        dk.astype(f),
        y0,
        x0,
        *fixed,
        stops,
        closes,
        part,
        total,
        none,
        none,
    )
    sums += np.moveaxis(part, 1, 0)


@pytest.mark.parametrize("moving", [False, True])
def test_a_sweep_is_the_weighted_sum_of_every_pixel(moving):
    g, dk, theta, read, shot, codes = case(moving=moving)
    sums = np.zeros((N_SUMS, 5, 23))
    add_block(sums, codes, 1.5, -200.0, g, dk, -2.0, -11.0, theta, read, shot)
    wanted = expected(g, dk, theta, read, shot, codes, -2.0, -11.0, 1.5, -200.0)
    scale = np.abs(wanted).max(axis=(1, 2), keepdims=True)
    np.testing.assert_allclose(sums / scale, wanted / scale, atol=2e-5)
    np.testing.assert_array_equal(sums[10], wanted[10])


@pytest.mark.long
def test_blocks_add_up():
    g, dk, *maps, codes = case(moving=True)
    whole, parts = np.zeros((2, N_SUMS, 5, 23))
    add_block(whole, codes, 1.0, 0.0, g, dk, -2.0, -11.0, *maps)
    for a, b in ((0, 5), (5, 18), (18, 37)):
        add_block(parts, codes[a:b], 1.0, 0.0, g[a:b], dk[a:b], -2.0, -11.0, *maps)
    np.testing.assert_allclose(parts, whole, rtol=1e-4, atol=1e-4 * np.abs(whole).max())


def test_solve_pixels_is_linear_algebra():
    g, dk, theta, read, shot, codes = case(moving=False)
    sums = expected(g, dk, theta, read, shot, codes, 0, 0, 1.0, 0.0)
    step, covariance, chi2 = solve_pixels(sums)
    for y, x in ((0, 0), (1, 2), (4, 20)):
        normal = np.zeros((3, 3))
        normal[np.triu_indices(3)] = sums[:6, y, x]
        normal = normal + np.triu(normal, 1).T
        solved = np.linalg.solve(normal, sums[6:9, y, x])
        np.testing.assert_allclose(step[:, y, x], solved, rtol=1e-8)
        np.testing.assert_allclose(
            covariance[:, y, x], np.linalg.inv(normal)[np.triu_indices(3)], rtol=1e-8
        )
        assert chi2[y, x] == pytest.approx(sums[9, y, x] - solved @ sums[6:9, y, x])


def test_a_phase_that_stands_still_is_not_solved():
    g, dk, theta, read, shot, codes = case(moving=False)
    g[:, 1:] = g[:1, 1:] * g[:, :1]
    g[:, :1] = 1
    g[:, 1:] = [0.3, 0.4]
    sums = expected(g, dk, theta, read, shot, codes, 0, 0, 1.0, 0.0)
    step, covariance, _ = solve_pixels(sums)
    assert np.isnan(step).all()
    assert np.isnan(covariance).all()


@pytest.mark.parametrize("far", [1.0, 400.0])
def test_frame_sums_give_each_frame_its_parameters(far):
    """Noise-free samples: one Gauss-Newton step from near the truth lands on it."""
    rng = np.random.default_rng(4)
    t, n = 11, 5000
    g = np.stack([1 + 0.1 * rng.normal(size=t), *rng.normal(size=(2, t))], axis=1)
    dk = 1e-3 * rng.normal(size=(t, 2))
    y, x = rng.uniform(-far, far, (2, n))
    theta = np.stack([np.full(n, 2e4), *rng.normal(0, 4e3, (2, n))])
    model = np.stack(
        [
            (turned(g, dk, b, a) * theta[:, i]).sum(axis=1)
            for i, (b, a) in enumerate(zip(y, x, strict=False))
        ]
    ).T
    f = np.float32
    start_g, start_dk = (g + 1e-5).astype(f), (dk + 1e-7 / far).astype(f)
    normal, right = np.zeros((t, 15)), np.zeros((t, 5))
    codes = np.rint((model + 20_000) * 0.5).astype(f)
    frame_sums(
        codes,
        2.0,
        -20_000.0,
        65535,
        start_g,
        start_dk,
        y.astype(f),
        x.astype(f),
        theta.astype(f),
        np.full(n, 256, f),
        np.ones(n, f),
        normal,
        right,
    )
    upper = np.triu_indices(5)
    for frame in range(t):
        matrix = np.zeros((5, 5))
        matrix[upper] = normal[frame]
        matrix = matrix + np.triu(matrix, 1).T
        step = np.linalg.solve(matrix, right[frame])
        sigma = np.sqrt(np.diag(np.linalg.inv(matrix)))
        got = np.concatenate([start_g[frame], start_dk[frame]]) + step
        # Rounding of the samples is the only noise: 0.6 e- where the weights expect some 100.
        assert (np.abs(got - np.concatenate([g[frame], dk[frame]])) < 0.1 * sigma).all()
