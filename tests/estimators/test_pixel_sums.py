"""Sums of a tile's pixels: their errors, samples without weight, batches."""

import numpy as np
import pytest

from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.tile_fit import Coding, PixelSums, Tile, start_model

CODING = Coding(1.5, -300.0, 65535)


def frames_of(bench):
    b, a, phi, dk = bench.scan("vertical")
    g = np.stack([b, a * np.cos(phi), a * np.sin(phi)], axis=1)
    return FrameParameters(g, dk, ((bench.shape[0] - 1) / 2, (bench.shape[1] - 1) / 2))


def case(bench):
    rng = np.random.default_rng(8)
    electrons, _ = bench.electrons("vertical")
    noisy = rng.poisson(electrons) + rng.normal(0, bench.read_noise, electrons.shape)
    codes = np.rint((noisy + 300) / 1.5).astype(np.uint16)
    one = np.ones(bench.shape, np.float32)
    read = one * np.float32(bench.read_noise**2 + 1.5**2 / 12)
    tile = Tile((0, bench.shape[0]), (0, bench.shape[1]), read, one, one > 0)
    frames = frames_of(bench)
    model, _ = start_model(tile, [codes], CODING, frames, (2 * np.pi / 5, 0.0))
    return tile, codes, frames, model


def total(sums, codes):
    for start in range(0, len(codes), 64):
        sums.add(codes[start : start + 64])
    return sums.finish()


def test_samples_without_weight_leave_no_trace(make_bench):
    """Marked samples might as well not have been taken."""
    bench = make_bench(shape=(9, 21), frames=131, laser_noise=0.05)
    tile, codes, frames, model = case(bench)
    codes[[3, 40, 41, 130], 4, 7] = 65535
    theta, sigma, chi2, count = total(PixelSums(tile, CODING, frames, model), codes)
    kept = np.setdiff1d(np.arange(131), [3, 40, 41, 130])
    fewer = FrameParameters(frames.g[kept], frames.dk[kept], frames.reference)
    other = total(PixelSums(tile, CODING, fewer, model), codes[kept])
    np.testing.assert_allclose(theta[:, 4, 7], other[0][:, 4, 7], rtol=3e-5)
    assert sigma[4, 7] == pytest.approx(other[1][4, 7], rel=1e-4)
    assert chi2[4, 7] == pytest.approx(other[2][4, 7], rel=1e-3)
    assert count[4, 7] == 127
    assert (np.delete(count.ravel(), 4 * 21 + 7) == 131).all()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"laser_noise": 0.2, "visibility": 0.8},
        {"visibility_noise": 0.025, "laser_noise": 0.02},
        {"vector_noise": 1e-2},
        {"level": 1000.0},
    ],
)
def test_errors_are_those_that_are_said(make_bench, options):
    bench = make_bench(frames=150, **options)
    tile, codes, frames, model = case(bench)
    theta, sigma, chi2, _ = total(PixelSums(tile, CODING, frames, model), codes)
    error = np.angle((theta[2] + 1j * theta[1]) * np.exp(-1j * bench.psi("vertical")))
    assert (error / sigma).std() == pytest.approx(1.0, abs=0.04)
    assert np.median(chi2) / 147 == pytest.approx(1.0, abs=0.04)


def test_a_batch_is_what_a_run_of_its_frames_is(make_bench):
    bench = make_bench(shape=(11, 23), frames=100)
    tile, codes, frames, model = case(bench)
    # Also far from the start model.
    model[1:, 3, 5] *= -1
    model[1:, 4, 6] = model[2:0:-1, 4, 6]
    batches = [(0, 40), (40, 40), (42, 97)]
    sums = PixelSums(tile, CODING, frames, model, batches)
    whole_run, alone = (PixelSums(tile, CODING, frames, model) for _ in range(2))
    alone.add(codes[:40])
    theta, own, _, _ = alone.finish()
    whole = np.angle((theta[2] + 1j * theta[1]) * (model[2] - 1j * model[1]))
    for part in np.split(codes, [40, 42, 64, 97]):
        whole_run.add(part)
    np.testing.assert_allclose(total(sums, codes)[0], whole_run.finish()[0], rtol=1e-9)
    np.testing.assert_allclose(np.angle(np.exp(1j * (sums.turn[0] - whole))), 0, atol=2e-7)
    np.testing.assert_allclose(sums.sigma[0], own, rtol=1e-6)
    assert np.isnan([sums.turn[1], sums.sigma[1]]).all()
    assert np.isfinite([sums.turn[2], sums.sigma[2]]).all()
