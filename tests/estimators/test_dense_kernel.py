"""A kernel with all its couplings: parts shrunk by their errors, and what maps add."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.linalg import block_diag

from pixcal.estimators.crosstalk.kernel import shrunk
from pixcal.estimators.crosstalk.links import PixelClasses, links
from pixcal.estimators.crosstalk.maps import Maps
from pixcal.estimators.maps.corrected import phase_change
from pixcal.kernels.crosstalk import Coupling, couple_fringes

STEPS = links((40, 40), 2)
ROWS = 4
ERROR = 4e-4


def shares_of(rng, size):
    """Strong couplings up and down that differ from row to row, weak ones, and none."""
    shares = np.zeros((len(STEPS), 2 * ROWS))
    shares[STEPS.index((1, 0))] = rng.choice([0.0, size], 2 * ROWS)
    shares[STEPS.index((0, 1))] = size / 4
    return shares.ravel()


def measured(rng, shares, error=ERROR):
    """Sums of a measurement of each share by itself."""
    normal = np.eye(len(shares)) / error**2
    return normal, normal @ (shares + error * rng.standard_normal(len(shares)))


def test_shares_are_found_within_their_errors_and_better_than_each_by_itself():
    rng = np.random.default_rng(1)
    found, expected = [], []
    for _ in range(20):
        shares = shares_of(rng, 0.025)
        values, covariance, _ = shrunk(*measured(rng, shares), STEPS, ROWS)
        found.append(values - shares)
        expected.append(np.diag(covariance))
    assert np.mean(np.square(found)) < 0.6 * ERROR**2
    # A share that is truly none has the error of one that may be.
    assert 0.5 < np.mean(np.square(found) / expected) < 1.2


def pattern_of(shares, slopes, true, error=1e-4):
    """Sums of the shares and a true pattern along x and y, as two sets of maps give them."""
    jacobian = block_diag(np.eye(ROWS), np.eye(ROWS))
    every = np.vstack([np.hstack(slopes), jacobian])
    data = np.hstack([shares @ slope for slope in slopes]) + true
    return every @ every.T / error**2, every @ data / error**2


def both(own, maps):
    """Sums of a measurement of the shares and of the maps."""
    free = np.zeros(2 * ROWS)
    normal = block_diag(own[0], np.diag(free)) + maps[0]
    return normal, np.concatenate([own[1], free]) + maps[1]


def test_the_pattern_of_maps_is_taken_where_the_noise_agrees_with_it():
    """Shares are known to 4e-4, their shift of the rows by the maps to 1e-4 px."""
    rng = np.random.default_rng(2)
    shares = shares_of(rng, 0.025)
    slopes = [rng.standard_normal((len(shares), ROWS)) for _ in range(2)]
    maps = pattern_of(shares, slopes, rng.normal(0, 1e-4, 2 * ROWS))
    own = measured(rng, shares)
    alone, *_ = shrunk(*own, STEPS, ROWS)
    joined, covariance, _ = shrunk(*both(own, maps), STEPS, ROWS, 2 * ROWS)
    left = [np.hstack([(v - shares) @ s for s in slopes]) for v in (alone, joined)]
    assert np.std(left[1]) < 0.2 * np.std(left[0])
    told = np.sqrt(np.mean([np.diag(s.T @ covariance @ s) for s in slopes]))
    assert np.std(left[1]) == pytest.approx(told, rel=0.6)


def test_a_pattern_that_no_kernel_explains_is_left_to_the_offsets():
    """True offsets may repeat with the rows: ten times what the errors of the shares allow."""
    rng = np.random.default_rng(3)
    shares = shares_of(rng, 0.025)
    slopes = [rng.standard_normal((len(shares), ROWS)) for _ in range(2)]
    true = rng.normal(0, 0.04, 2 * ROWS)
    own = measured(rng, shares)
    maps = pattern_of(shares, slopes, true)
    values, covariance, _ = shrunk(*both(own, maps), STEPS, ROWS, 2 * ROWS)
    pulls = (values - shares) / np.sqrt(np.diag(covariance))
    assert np.std(pulls) < 1.3


def test_maps_measure_what_remains_of_the_couplings():
    """Visibility and offsets of pixels without true offsets, read through other couplings."""
    k, shape = (0.08, 0.69), (60, 56)
    y, x = np.indices(shape, float)
    rng = np.random.default_rng(5)
    psi = k[0] * x + k[1] * y
    light = 1 + 2e-4 * rng.standard_normal(shape)
    theta = np.stack([light, np.sin(psi), np.cos(psi)])
    known = (Coupling(1, 0, 0.02, 4, 2), Coupling(-1, 0, 0.01, 4, 3))
    remain = [0.001, -0.0015]
    whole = [replace(c, share=c.share + r) for c, r in zip(known, remain, strict=True)]
    read, good = couple_fringes(theta, whole), np.ones(shape, bool)
    one = SimpleNamespace(
        theta=read, k=k, origin=(0, 0), good=good, shot_factor=good,
        delta=phase_change(theta, read) / np.hypot(*k), sigma=np.full(shape, 1e-4),
    )  # fmt: skip
    maps = Maps.of(SimpleNamespace(good=good, fringes={"one": one}), known)
    normal, right = maps.sums(known, PixelClasses(4, 1, (0, 0)))
    np.testing.assert_allclose(np.linalg.solve(normal[:2, :2], right[:2]), remain, atol=1e-4)
