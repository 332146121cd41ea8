"""The sweep of a tile: blocks, batches, the bound."""

import numpy as np
import pytest

from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.sweep import (
    SetSweep,
    frames_to_prime,
    phase_bound,
    plan_batches,
    sweep_tile,
)
from pixcal.estimators.fringe_fit.tile_fit import Coding, Tile

CODING = Coding(1.0, -300.0, 65535)


def true_frames(bench, name="vertical"):
    b, a, phi, dk = bench.scan(name)
    ny, nx = bench.shape
    g = np.stack([b, a * np.cos(phi), a * np.sin(phi)], axis=1)
    return FrameParameters(g, dk, (ny / 2, nx / 2))


def sweep(bench, codes, cuts, batch=20):
    full = np.ones(bench.shape, np.float32)
    ny, nx = bench.shape
    tile = Tile((0, ny), (0, nx), full * 256, full, full > 0)
    frames = true_frames(bench)
    blocks = np.split(codes, cuts)
    batches = plan_batches(np.arange(len(codes)) * 0.14, batch)
    k = (2 * np.pi / 5, 0.0)
    common = SetSweep(CODING, frames, k, batches, frames_to_prime(frames, 64))
    return sweep_tile(tile, blocks, common)


@pytest.fixture(scope="module")
def case(make_bench):
    bench = make_bench(shape=(23, 37), frames=197, laser_noise=0.02)
    bench.bias = np.full(bench.shape, 300.0)
    return bench, bench.read_out(bench.electrons("vertical")[0])


def test_how_time_is_cut_into_blocks_does_not_matter(case):
    bench, codes = case
    one = sweep(bench, codes, [64, 128, 192])
    # The start model is made of the first 64 frames or more in both.
    other = sweep(bench, codes, [64, 77, 140])
    for name in ("iota", "alpha", "phase", "sigma", "chi2"):
        a, b = getattr(one, name), getattr(other, name)
        np.testing.assert_allclose(a, b, rtol=2e-5, atol=2e-5 * np.abs(a).mean())
    np.testing.assert_array_equal(one.count, np.float32(197))


def test_phases_and_levels_are_the_truth_within_their_errors(case):
    bench, codes = case
    maps = sweep(bench, codes, [64, 128, 192])
    _y, x = np.mgrid[: bench.shape[0], : bench.shape[1]]
    carrier = 2 * np.pi / 5 * (x - bench.shape[1] / 2)
    error = np.angle(np.exp(1j * (maps.phase + carrier - bench.psi("vertical"))))
    assert (error / maps.sigma).std() == pytest.approx(1.0, abs=0.08)
    assert abs((error / maps.sigma).mean()) < 0.15
    level = bench.level * bench.illumination()
    np.testing.assert_allclose(maps.iota / level, 1.0, atol=5 * 1.5 / np.sqrt(197 * 25_000))
    assert np.median(maps.chi2) == pytest.approx(1.0, abs=0.02)


def test_batches_are_fits_of_their_own_frames(case):
    """A batch's phase is that of a sweep of its frames alone."""
    bench, codes = case
    maps = sweep(bench, codes, [64, 128, 192], batch=60)
    assert maps.batch_phase.shape == (3, *bench.shape)
    frames = true_frames(bench)
    alone = FrameParameters(frames.g[60:120], frames.dk[60:120], frames.reference)
    full = np.ones(bench.shape, np.float32)
    tile = Tile((0, 23), (0, 37), full * 256, full, full > 0)
    k = (2 * np.pi / 5, 0.0)
    common = SetSweep(CODING, alone, k, plan_batches(np.arange(60) * 0.14, 60), prime=60)
    only = sweep_tile(tile, [codes[60:120]], common)
    difference = np.angle(np.exp(1j * (maps.phase + maps.batch_phase[1] - only.phase)))
    # Weights come from other start models: the same to a small part of the error.
    assert (difference / only.sigma).std() < 0.05


def test_the_bound_is_the_benchs_own(case):
    bench, codes = case
    maps = sweep(bench, codes, [64, 128])
    k = bench.wave_number("vertical")
    assert np.sqrt((maps.bound**2).mean()) / k == pytest.approx(
        bench.bound("vertical", 7), rel=0.02
    )
    assert np.median(maps.sigma) == pytest.approx(np.median(maps.bound), rel=0.01)


def test_the_bound_in_closed_form():
    """Equal noise, uniform phases: variance of the phase is 2 sigma² / (T alpha²)."""
    t = 400
    phi = np.arange(t) * 2 * np.pi / t
    g = np.stack([np.ones(t), np.cos(phi), np.sin(phi)], axis=1)
    one = np.ones((1, 1), np.float32)
    tile = Tile((0, 1), (0, 1), one * 400, one * 0, one > 0)
    theta = np.array([1e4, 3e3, 4e3]).reshape(3, 1, 1)
    bound = phase_bound(tile, theta, FrameParameters(g, np.zeros((t, 2)), (0.0, 0.0)))
    np.testing.assert_allclose(bound, np.sqrt(2 * 400 / t) / 5e3)


def test_a_slow_scan_primes_for_longer():
    t = 1000
    for turns, expected in ((200.0, 64), (2.0, 1000)):
        phi = np.linspace(0, 2 * np.pi * turns, t)
        g = np.stack([np.ones(t), np.cos(phi), np.sin(phi)], axis=1)
        prime = frames_to_prime(FrameParameters(g, np.zeros((t, 2)), (0, 0)), 64)
        assert prime == expected if turns > 100 else 64 < prime <= expected
