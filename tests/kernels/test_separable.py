"""Sums of terms with a shape each: found again, with errors as large as their scatter."""

import numpy as np
import pytest

from pixcal.kernels.separable import fit_terms
from pixcal.model.arrays import F64

TIME = np.arange(60.0)
GRID = np.log(np.geomspace(1, 60, 12))


def decay(log_decay: float) -> F64:
    return np.asarray(np.exp(-TIME / np.exp(log_decay)))


@pytest.mark.parametrize("decays", [(7.0,), (60.0,), (3.0, 25.0)])
def test_terms_are_found_within_errors_as_large_as_their_scatter(decays: tuple[float, ...]) -> None:
    rng, shapes = np.random.default_rng(1), np.log(decays)
    sizes = np.array([4.0, -2.0])[: len(decays)]
    plain = np.sum([size * decay(shape) for size, shape in zip(sizes, shapes, strict=True)], axis=0)
    noise = 0.01
    fits = [
        fit_terms(decay, plain + noise * rng.standard_normal(len(TIME)), GRID, len(decays))
        for _ in range(60)
    ]
    of_sizes, of_shapes = fits[0].errors(noise**2)
    off = np.array([[*(f.sizes - sizes), *(f.shapes - shapes)] for f in fits])
    pulls = off / [*of_sizes, *of_shapes]
    # A decay at the end of the grid cannot exceed it.
    if decays[-1] < 60:
        assert np.abs(pulls.mean(axis=0)).max() < 4 / np.sqrt(len(fits))
        np.testing.assert_allclose(pulls.std(axis=0), 1, atol=0.35)
    else:
        assert np.abs(pulls).max() < 5
    left = np.mean([fit.left for fit in fits]) / noise**2
    assert left == pytest.approx(len(TIME) - 2 * len(decays), rel=0.1)


def test_one_trial_alone_is_a_linear_fit() -> None:
    fit = fit_terms(decay, 3 * decay(1.0), np.array([1.0]))
    assert fit.sizes == pytest.approx([3.0])
    assert fit.shapes == pytest.approx([1.0])
    assert fit.left == pytest.approx(0.0, abs=1e-20)
