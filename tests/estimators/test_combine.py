"""Two axes or more give both components."""

import numpy as np
import pytest

from pixcal.estimators.fringe_fit.combine import axes_span_plane, combine_parallel, combine_sets


def unit(*degrees):
    return [(np.cos(np.radians(d)), np.sin(np.radians(d))) for d in degrees]


@pytest.mark.parametrize("degrees", [(0, 90), (10, 65), (0, 45, 90), (0, 30, 60, 120)])
def test_noise_free_projections_give_the_offsets_back(degrees):
    rng = np.random.default_rng(0)
    truth = rng.normal(size=(2, 7, 5))
    axes = unit(*degrees)
    delta = np.stack([a * truth[0] + b * truth[1] for a, b in axes])
    sigma = rng.uniform(0.5, 2.0, delta.shape)
    xy, _, chi2 = combine_sets(axes, delta, sigma)
    np.testing.assert_allclose(xy, truth, atol=1e-12)
    np.testing.assert_allclose(chi2, 0, atol=1e-20)


def test_errors_and_chi2_are_honest():
    rng = np.random.default_rng(1)
    axes = unit(0, 50, 100, 140)
    sigma = rng.uniform(0.5, 2.0, (4, 1)) * np.ones((4, 20_000))
    xy, sigma_xy, chi2 = combine_sets(axes, sigma * rng.normal(size=sigma.shape), sigma)
    np.testing.assert_allclose((xy / sigma_xy).std(axis=1), 1.0, atol=0.02)
    assert chi2.mean() == pytest.approx(2.0, abs=0.05)


def test_a_missing_set_is_replaced_or_leaves_nan():
    axes = unit(0, 90, 45)
    delta = np.zeros((3, 2))
    delta[0, 0] = delta[0, 1] = delta[1, 1] = np.nan
    xy, _, _ = combine_sets(axes, delta, np.ones((3, 2)))
    assert np.isfinite(xy[:, 0]).all()
    assert np.isnan(xy[:, 1]).all()


def test_parallel_sets_are_averaged_with_their_sign():
    axes = [(1.0, 0.0), (-1.0, 1e-9)]
    assert not axes_span_plane(axes)
    mean, error, _ = combine_parallel(axes, np.array([[1.0], [-3.0]]), np.array([[1.0], [1.0]]))
    assert mean[0] == pytest.approx(2.0)
    assert error[0] == pytest.approx(np.sqrt(0.5))


def test_axes_that_span():
    assert axes_span_plane(unit(0, 90))
    assert axes_span_plane(unit(0, 30))
    assert not axes_span_plane(unit(0, 3, 180))
    assert not axes_span_plane(unit(20))


def test_sets_of_very_unequal_errors_still_give_both():
    """Whether two axes give both components does not depend on how well each is measured."""
    delta, sigma = np.array([[1.0], [2.0]]), np.array([[1e-5], [1e-2]])
    xy, sigma_xy, _ = combine_sets(unit(0, 90), delta, sigma)
    np.testing.assert_allclose(xy, delta, atol=1e-12)
    np.testing.assert_allclose(sigma_xy, sigma)
    assert np.isnan(combine_sets(unit(0, 4), delta, np.ones((2, 1)))[0]).all()
