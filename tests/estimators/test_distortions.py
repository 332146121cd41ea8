"""What the fit leaves: nothing of what it can follow, all of what it cannot, once and for all."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.distortions import (
    Distortion,
    Freedom,
    distortion_sums,
    fit_distortions,
)
from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.kernels.boundaries import boundary_shifts, moved_charge

F32 = NDArray[np.float32]
RNG = np.random.default_rng(31)
T, NY, NX = 90, 23, 31


@pytest.fixture(scope="module")
def fringes() -> FringeEvidence:
    """A set with a fit that is the truth, and noise of its own variance."""
    y, x = grid((NY, NX))
    phi = 2 * np.pi * RNG.random(T)
    k = (1.3, 0.2)
    psi = k[0] * x + k[1] * y
    iota = 20_000 * (1 + 0.02 * RNG.standard_normal((NY, NX)))
    theta = np.stack([iota, 0.95 * iota * np.sin(psi), 0.95 * iota * np.cos(psi)])
    level = 1 + 0.02 * RNG.standard_normal(T)
    g = np.stack([level, level * np.cos(phi), level * np.sin(phi)], axis=1)
    model = np.einsum("ti,iyx->tyx", g, theta)
    variance = model + 256
    electrons = (model + np.sqrt(variance) * RNG.standard_normal(model.shape)).astype(np.float32)
    electrons[5, 3:9, 4] = np.nan
    good = np.ones((NY, NX), bool)
    good[11, 13] = False
    unknown = np.zeros((T, 5)), np.zeros((T, 5, 5))
    return FringeEvidence(
        "set",
        (6.0, 0.0),
        k,
        (0, 0),
        (NY, NX),
        np.arange(T),
        0.14 * np.arange(T),
        0.02,
        electrons,
        electrons,
        g,
        np.zeros((T, 2)),
        *unknown,
        theta,
        np.ones((NY, NX)),
        np.zeros((NY, NX)),
        good,
        np.full((NY, NX), 256.0),
        np.ones((NY, NX)),
    )


def test_nothing_is_left_of_what_the_fit_can_follow(fringes: FringeEvidence) -> None:
    y, x = grid((NY, NX))
    frames = 0.01 * RNG.standard_normal((T, 3))
    pixels = 50 * RNG.standard_normal((3, NY, NX))
    turn = 1e-3 * (RNG.standard_normal((T, 1, 1)) * x + RNG.standard_normal((T, 1, 1)) * y)
    slope = fringes.g[:, 1, None, None] * fringes.theta[2]
    slope = slope - fringes.g[:, 2, None, None] * fringes.theta[1]
    for change in (
        np.einsum("ti,iyx->tyx", frames, fringes.theta),
        np.einsum("ti,iyx->tyx", fringes.g, pixels),
        turn * slope,
    ):
        freedom = Freedom(fringes)
        before = freedom.of_good(change.astype(np.float32))
        assert np.abs(freedom.left_over(before)).max() < 0.02 * np.abs(before).max()
        assert freedom.left_over(before).std() < 1e-2 * before.std()


def test_what_is_left_stays_and_noise_loses_the_free_parameters(fringes: FringeEvidence) -> None:
    freedom = Freedom(fringes)
    noise = freedom.left_over(freedom.of_good(fringes.residual))
    again = freedom.left_over(noise)
    assert np.abs(again - noise).max() < 0.02 * noise.std()
    chi2 = float((freedom.weight * noise**2).sum())
    samples = int(np.count_nonzero(freedom.weight))
    n = freedom.weight.shape[1]
    dof = samples - 3 * n - 5 * T + 9
    assert chi2 == pytest.approx(dof, abs=4 * np.sqrt(2 * dof))


def test_harmonics_are_left_unless_pixels_may_have_them(fringes: FringeEvidence) -> None:
    third = np.cos(3 * fringes.phi)[:, None, None] * RNG.standard_normal((NY, NX))
    for harmonics in (1, 2, 3):
        freedom = Freedom(fringes, harmonics)
        before = freedom.of_good(third.astype(np.float32))
        left = freedom.left_over(before).std() / before.std()
        assert left < 0.02 if harmonics == 3 else left > 0.8


def test_a_margin_and_bad_pixels_are_left_out(fringes: FringeEvidence) -> None:
    freedom = Freedom(fringes, margin=2)
    assert freedom.good.sum() == (NY - 4) * (NX - 4) - 1
    assert not freedom.good[:2].any()
    lost = ~np.isfinite(freedom.of_good(fringes.electrons))
    assert lost.sum() == 6
    assert not freedom.weight[lost].any()


def test_the_size_of_a_distortion_is_found_with_its_error(fringes: FringeEvidence) -> None:
    truth, pulls = np.array([-0.02, 0.01]), []

    def distortion(_: FringeEvidence, signal: F32, sizes: NDArray[np.float64]) -> F32:
        u = signal / np.float32(5e4)
        return (sizes[0] * u + sizes[1] * u * u).astype(np.float32) * signal

    for _ in range(12):
        noise = RNG.standard_normal((T, NY, NX))
        sizes, covariance, agreement = fit_distortions(
            [bent(fringes, distortion, truth, noise)], distortion, 2
        )
        assert not agreement.rejected
        pulls.append((sizes - truth) / np.sqrt(np.diag(covariance)))
    assert np.abs(pulls).max() < 4
    assert 0.5 < np.std(pulls) < 1.6
    known = np.array([-0.02, 0.0]), np.array([1e12, 0.0])
    quiet = bent(fringes, distortion, truth, np.zeros(()))
    sizes, covariance, _ = fit_distortions([quiet], distortion, 2, prior=known)
    assert covariance[0, 0] == pytest.approx(1e-12, rel=0.01)
    assert sizes[1] == pytest.approx(0.01, rel=0.02)


def test_sets_of_which_one_denies_the_size_disagree(fringes: FringeEvidence) -> None:
    def distortion(_: FringeEvidence, signal: F32, sizes: NDArray[np.float64]) -> F32:
        slope = signal * signal / np.float32(5e4)
        return np.float32(sizes[0]) * slope

    for second, rejected in ((-0.02, False), (0.0, True), (-0.015, False)):
        sets = [
            bent(fringes, distortion, np.array([size]), RNG.standard_normal((T, NY, NX)))
            for size in (-0.02, second)
        ]
        assert fit_distortions(sets, distortion, 1)[2].rejected == rejected


def test_charge_moves_from_the_light_before_it_moved(fringes: FringeEvidence) -> None:
    """From the fitted fringes, which lost contrast by it, 3 % more would have to move."""
    truth = np.array([0.0, 1.0, 0.0])

    def distortion(_: FringeEvidence, signal: F32, sizes: NDArray[np.float64]) -> F32:
        shifts = [boundary_shifts(falloff) for falloff in (0.35, 0.5, 0.7)]
        return moved_charge(signal, 1e-6 * np.tensordot(sizes, shifts, 1))

    whole = replace(fringes, good=np.ones_like(fringes.good))
    normal, right = distortion_sums(
        [bent(whole, distortion, truth, np.zeros(()))], distortion, 3, 0
    )
    assert right[1] / normal[1, 1] == pytest.approx(1, rel=2e-3)


def bent(
    fringes: FringeEvidence, distortion: Distortion, truth: NDArray[Any], noise: NDArray[Any]
) -> FringeEvidence:
    """The set with a distortion, fitted as the pipeline would: its absorbed part in the maps."""
    signal = fringes.model
    changed = signal + distortion(fringes, signal, truth)
    electrons = (changed + np.sqrt(fringes.variance) * noise).astype(np.float32)
    weighted = fringes.g.T / fringes.variance.reshape(T, -1).T[:, None]  # (n, 3, t)
    normal, right = weighted @ fringes.g, weighted @ changed.reshape(T, -1).T[..., None]
    theta = np.linalg.solve(normal, right)[..., 0].T
    return replace(fringes, electrons=electrons, theta=theta.reshape(3, NY, NX))
