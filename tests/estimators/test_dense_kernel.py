"""A kernel with all its couplings: parts shrunk by their errors, and what maps add."""

import numpy as np
import pytest
from scipy.linalg import block_diag

from pixcal.estimators.crosstalk.dense import ShareShrinkage
from pixcal.estimators.crosstalk.information import _third_pixels
from pixcal.estimators.crosstalk.links import PixelClasses, links
from pixcal.estimators.crosstalk.pattern import response_slopes
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
        values, covariance, _ = ShareShrinkage.of(STEPS, ROWS).solve(*measured(rng, shares), None)
        found.append(values - shares)
        expected.append(np.diag(covariance))
    assert np.mean(np.square(found)) < 0.6 * ERROR**2
    # A share that is truly none has the error of one that may be.
    assert 0.5 < np.mean(np.square(found) / expected) < 1.2


def pattern_of(shares, slopes, true, error=1e-4):
    """Sums of the shares and a true pattern along x and y, as two sets of maps give them."""
    jacobian = block_diag(np.eye(ROWS), np.eye(ROWS))
    both = np.vstack([np.hstack(slopes), jacobian])
    data = np.hstack([shares @ slope for slope in slopes]) + true
    return both @ both.T / error**2, both @ data / error**2


def test_the_pattern_of_maps_is_taken_where_the_noise_agrees_with_it():
    """Shares are known to 4e-4, their shift of the rows by the maps to 1e-4 px."""
    rng = np.random.default_rng(2)
    shares = shares_of(rng, 0.025)
    slopes = [rng.standard_normal((len(shares), ROWS)) for _ in range(2)]
    maps = pattern_of(shares, slopes, rng.normal(0, 1e-4, 2 * ROWS))
    own = measured(rng, shares)
    alone, *_ = ShareShrinkage.of(STEPS, ROWS).solve(*own, None)
    joined, covariance, size = ShareShrinkage.of(STEPS, ROWS).solve(*own, maps)
    left = [np.hstack([(v - shares) @ s for s in slopes]) for v in (alone, joined)]
    assert np.std(left[1]) < 0.2 * np.std(left[0])
    told = np.sqrt(np.mean([np.diag(s.T @ covariance @ s) for s in slopes]))
    assert np.std(left[1]) == pytest.approx(told, rel=0.6)
    assert size < 5e-4


def test_a_pattern_that_no_kernel_explains_is_left_to_the_offsets():
    """True offsets may repeat with the rows: ten times what the errors of the shares allow."""
    rng = np.random.default_rng(3)
    shares = shares_of(rng, 0.025)
    slopes = [rng.standard_normal((len(shares), ROWS)) for _ in range(2)]
    true = rng.normal(0, 0.04, 2 * ROWS)
    own = measured(rng, shares)
    values, covariance, size = ShareShrinkage.of(STEPS, ROWS).solve(
        *own, pattern_of(shares, slopes, true)
    )
    assert size == pytest.approx(np.std(true), rel=0.4)
    pulls = (values - shares) / np.sqrt(np.diag(covariance))
    assert np.std(pulls) < 1.3


def test_slopes_are_those_of_maps_that_are_coupled():
    k, shape = (0.08, 0.69), (40, 36)
    y, x = np.indices(shape, float)
    psi = k[0] * x + k[1] * y
    theta = np.stack([np.full(shape, 1.0), np.sin(psi), np.cos(psi)])
    classes = PixelClasses(4, 1, (0, 0))
    one = [Coupling(1, 0, 0.02, 4, 2), Coupling(-2, 1, 0.01, 4, 3)]

    def log_response(couplings):
        read = couple_fringes(theta, couplings)
        z = (read[2] + 1j * read[1]) * np.exp(-1j * psi)
        return np.log(z / read[0])[16:20, 18]

    slopes = response_slopes(k, one, classes)
    for n, c in enumerate(one):
        step = 1e-6
        moved = [*one[:n], Coupling(c.dy, c.dx, c.share + step, 4, c.row), *one[n + 1 :]]
        expected = (log_response(moved) - log_response(one)) / step
        np.testing.assert_allclose(slopes[n], expected, atol=1e-4)


def test_third_pixels_are_those_of_the_couplings_matrix() -> None:
    """Of sources that repeat every two rows and three columns, in a piece that begins at (1, 2)."""
    rng = np.random.default_rng(4)
    steps = (0, 1), (1, 0), (-1, 0), (1, 1), (0, -2)
    couplings = [
        Coupling(dy, dx, float(rng.uniform(0.002, 0.02)), 2, row, 3, column)
        for dy, dx in steps
        for row in range(2)
        for column in range(3)
    ] + [Coupling(0, -1, 0.01)]
    shape, first = (11, 13), (1, 2)
    given = np.zeros((shape[0] * shape[1],) * 2)  # (receiver, source)
    number = np.arange(shape[0] * shape[1]).reshape(shape)
    for c in couplings:
        here, there = c.places(shape, first)
        given[number[there].ravel(), number[here].ravel()] += c.share
    both = given @ given.T
    third = _third_pixels(couplings, shape, first)
    inner = np.ones(shape, bool)
    inner[:4] = inner[-4:] = inner[:, :4] = inner[:, -4:] = False
    for step, found in third.items():
        y, x = np.nonzero(inner)
        expected = both[number[y, x], number[y + step[0], x + step[1]]]
        np.testing.assert_allclose(found[inner], expected, atol=1e-12)
    assert {(0, 1), (2, 0), (1, -1), (0, 3)} <= set(third)
