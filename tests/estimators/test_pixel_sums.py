"""Sums whose normal matrices come from the frames, against sums taken sample by sample."""

import numpy as np
import pytest

from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.harmonics import PhaseWeights, moments, normal_matrices
from pixcal.estimators.fringe_fit.pixel_sums import FringeSums, SampleSums, pixel_sums
from pixcal.estimators.fringe_fit.tile import Coding, Tile
from pixcal.estimators.fringe_fit.tile_fit import start_model

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
    model, smooth = start_model(tile, [codes], CODING, frames, (2 * np.pi / 5, 0.0))
    return tile, codes, frames, model, smooth


def total(sums, codes):
    for start in range(0, len(codes), 64):
        sums.add(codes[start : start + 64], slice(start, min(start + 64, len(codes))))
    return sums.finish()


@pytest.mark.parametrize(("visibility", "rho"), [(0.5, 0.02), (0.95, 0.01), (1.0, 0.005)])
def test_normal_matrices_are_the_sums_over_frames(visibility, rho):
    rng = np.random.default_rng(0)
    phi = rng.uniform(0, 2 * np.pi, 83)
    b = 1 + 0.1 * rng.normal(size=83)
    g = np.stack([b, b * np.cos(phi), b * np.sin(phi)], axis=1)
    psi = rng.uniform(-np.pi, np.pi, (3, 5))
    weights = PhaseWeights.of(visibility, rho)
    for power, error in ((1, 8e-5), (2, 2e-4)):
        got = normal_matrices(moments(g), weights.series(power), psi)
        for at in np.ndindex(psi.shape):
            w = (1 + rho + visibility * np.sin(psi[at] + phi)) ** -power / b
            wanted = ((g * w[:, None]).T @ g)[np.triu_indices(3)]
            np.testing.assert_allclose(
                got[(slice(None), *at)], wanted, atol=error * np.abs(wanted).max()
            )


def test_samples_without_weight_leave_no_trace(make_bench):
    """Marked samples might as well not have been taken."""
    bench = make_bench(shape=(9, 21), frames=131, laser_noise=0.05)
    tile, codes, frames, model, smooth = case(bench)
    codes[[3, 40, 41, 130], 4, 7] = 65535
    theta, sigma, chi2, count = total(FringeSums(tile, CODING, frames, model, smooth.map), codes)
    kept = np.setdiff1d(np.arange(131), [3, 40, 41, 130])
    fewer = FrameParameters(frames.g[kept], frames.dk[kept], frames.reference)
    other = total(FringeSums(tile, CODING, fewer, model, smooth.map), codes[kept])
    np.testing.assert_allclose(theta[:, 4, 7], other[0][:, 4, 7], rtol=3e-5)
    assert sigma[4, 7] == pytest.approx(other[1][4, 7], rel=1e-4)
    assert chi2[4, 7] == pytest.approx(other[2][4, 7], rel=1e-3)
    assert count[4, 7] == 127
    assert (np.delete(count.ravel(), 4 * 21 + 7) == 131).all()


@pytest.mark.parametrize(
    ("options", "loss"),
    [
        ({}, 1.002),
        ({"laser_noise": 0.2, "visibility": 0.8}, 1.002),
        ({"visibility_noise": 0.025, "laser_noise": 0.02}, 1.008),
        ({"level": 1000.0}, 1.002),
    ],
)
def test_nothing_that_matters_is_lost(make_bench, options, loss):
    bench = make_bench(frames=150, **options)
    tile, codes, frames, model, smooth = case(bench)
    fast = pixel_sums(tile, CODING, frames, model, smooth.map)
    assert isinstance(fast, FringeSums)
    errors = []
    for sums in (fast, SampleSums(tile, CODING, frames, model)):
        theta, sigma, chi2, _ = total(sums, codes)
        error = np.angle((theta[2] + 1j * theta[1]) * np.exp(-1j * bench.psi("vertical")))
        assert (error / sigma).std() == pytest.approx(1.0, abs=0.04)
        assert np.median(chi2) / 147 == pytest.approx(1.0, abs=0.04)
        errors.append(error.std())
    assert errors[0] / errors[1] < loss


@pytest.mark.parametrize("options", [{"vector_noise": 1e-2}, {"visibility_noise": 0.05}])
def test_unsteady_fringes_are_summed_sample_by_sample(make_bench, options):
    bench = make_bench(shape=(20, 30), frames=60, **options)
    tile, _, frames, model, smooth = case(bench)
    assert isinstance(pixel_sums(tile, CODING, frames, model, smooth.map), SampleSums)


def test_batches_close_to_the_same_in_both(make_bench):
    bench = make_bench(shape=(11, 23), frames=100)
    tile, codes, frames, model, smooth = case(bench)
    results = []
    for sums in (
        FringeSums(tile, CODING, frames, model, smooth.map),
        SampleSums(tile, CODING, frames, model),
    ):
        sums.add(codes[:40], slice(0, 40))
        results.append(sums.close())
    (a, sigma_a), (b, sigma_b) = results
    assert (np.angle(np.exp(1j * (a - b))) / sigma_b).std() < 0.05
    np.testing.assert_allclose(sigma_a / sigma_b, 1.0, atol=0.02)
