"""Terms fitted to maps: errors hold for true offsets that are white, and in fields of a mask."""

import numpy as np
import pytest

from pixcal.estimators.maps.map_fit import MapPart, fit_maps, polynomial
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.arrays import F64

SIZE = 96
GOOD = np.ones((SIZE, SIZE), bool)
CURVATURE = polynomial((SIZE, SIZE), 2)[3:5]


def offsets(rng: np.random.Generator, field: int) -> F64:
    """White; and where there are fields, moved alike within each by as much."""
    delta = rng.normal(0, 1, (SIZE, SIZE))
    if field:
        start = rng.integers(0, field, 2)
        rows, columns = (np.arange(SIZE) + n for n in start)
        steps = rng.normal(0, 1, (SIZE // field + 2,) * 2)
        delta += steps[rows // field][:, columns // field]
    return delta


@pytest.mark.quick(1)
@pytest.mark.parametrize("field", [0, 25, 40])
def test_curvature_by_chance_is_not_significant(field: int) -> None:
    """Few fields tell little of how they scatter: the errors may be low by half."""
    rng = np.random.default_rng(8)
    free = polynomial(GOOD.shape, 1)
    sigmas = []
    for _ in range(60):
        parts = [MapPart.of(CURVATURE, offsets(rng, field), free, GOOD) for _ in range(2)]
        sigmas.append(sigmas_of_chi2(fit_maps(parts).gain, 2))
    assert np.mean(sigmas) < (2.0 if field else 0.5)
    assert max(sigmas) < (6.0 if field else 4.0)


def test_curvature_is_found_with_its_error() -> None:
    rng, truth, pulls = np.random.default_rng(9), np.array([0.2, -0.1]), []
    for _ in range(40):
        data = offsets(rng, 0) + np.tensordot(truth, CURVATURE, 1)
        found = fit_maps([MapPart.of(CURVATURE, data, polynomial(GOOD.shape, 1), GOOD)])
        pulls.append((found.values - truth) / np.sqrt(np.diag(found.covariance)))
    assert 0.7 < np.std(pulls) < 1.2


def test_pixels_that_stand_out_do_not_count() -> None:
    rng, truth = np.random.default_rng(10), np.array([0.2, -0.1])
    data = offsets(rng, 0) + np.tensordot(truth, CURVATURE, 1)
    wild = data.copy()
    wild[3, 90], wild[70, 8] = 1e4, -7e3
    free = polynomial(GOOD.shape, 1)
    without = GOOD.copy()
    without[3, 90] = without[70, 8] = False
    part, expected = (
        MapPart.of(CURVATURE, one, free, good) for one, good in ((wild, GOOD), (data, without))
    )
    assert np.abs(part.data).max() < 6
    np.testing.assert_allclose(fit_maps([part]).values, fit_maps([expected]).values, rtol=1e-6)
