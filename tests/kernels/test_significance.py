"""Significances: under chance they are standard normals."""

import numpy as np
import pytest
from scipy import stats

from pixcal.kernels.significance import (
    root_with_error,
    sigmas_of_best,
    sigmas_of_chi2,
    sigmas_of_count,
    sigmas_of_t,
)

RNG = np.random.default_rng(4)


@pytest.mark.parametrize("dof", [1, 2, 7])
def test_of_chi2_chance_is_normal(dof: int) -> None:
    drawn = [sigmas_of_chi2(v, dof) for v in RNG.chisquare(dof, 3000)]
    assert stats.kstest(drawn, "norm").pvalue > 1e-3


def test_of_chi2_far_tails_join() -> None:
    assert sigmas_of_chi2(25.0, 1) == pytest.approx(stats.norm.isf(stats.norm.sf(5) * 2))
    below, above = sigmas_of_chi2(999.9, 3), sigmas_of_chi2(1000.1, 3)
    assert above == pytest.approx(below, rel=2e-3)
    assert sigmas_of_chi2(1e8, 2) == pytest.approx(1e4, rel=1e-3)


def test_of_the_best_of_some_chance_is_normal() -> None:
    drawn = [sigmas_of_best(*row) for row in RNG.standard_normal((3000, 3))]
    assert stats.kstest(drawn, "norm").pvalue > 1e-3
    assert sigmas_of_best(2.0) == pytest.approx(2.0)
    assert sigmas_of_best(300.0, 1.0) == pytest.approx(300, abs=0.01)


def test_of_counts() -> None:
    drawn = [sigmas_of_count(int(n), 400.0) for n in RNG.poisson(400, 3000)]
    assert stats.kstest(drawn, "norm").pvalue > 1e-4
    assert sigmas_of_count(0, 1e-4) == pytest.approx(0, abs=1e-3)
    assert sigmas_of_count(1, 1e-3) < 4 < sigmas_of_count(2, 1e-3)
    assert np.isfinite(sigmas_of_count(5000, 1e-6))


@pytest.mark.parametrize("true", [0.0, 0.5, 3.0, 300.0])
def test_root_of_a_variance_lies_within_its_error_two_times_in_three(true: float) -> None:
    """Near zero more often: the interval has a longer side."""
    root, error = root_with_error(true + RNG.standard_normal(20_000), 1.0)
    within = float(np.mean(np.abs(root - np.sqrt(true)) <= error))
    assert 0.68 - 0.01 < within < 0.95
    if true > 100:
        assert within == pytest.approx(0.683, abs=0.015)
        assert error.mean() == pytest.approx(1 / (2 * np.sqrt(true)), rel=0.01)


def test_error_of_a_root_downwards_may_differ() -> None:
    root, error = root_with_error(9.0, 7.0, 8.0)
    assert (root, error) == (3.0, 2.0)
    assert root_with_error(9.0, 16.0, 5.0)[1] == pytest.approx(2.0)
    assert root_with_error(-1.0, 4.0) == (0.0, 2.0)


@pytest.mark.parametrize("dof", [4, 7, 30])
def test_student_agrees_with_scipy_within_two_per_cent(dof: int) -> None:
    for t in (0.5, 3.0, 12.0, 20.0):
        exact = stats.norm.isf(stats.t.sf(t, dof))
        assert sigmas_of_t(t, dof) == pytest.approx(exact, rel=0.02)
        assert sigmas_of_t(-t, dof) == -sigmas_of_t(t, dof)
