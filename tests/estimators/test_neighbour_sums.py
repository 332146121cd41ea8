"""Sums over products of neighbours: as written out in numpy."""

import numpy as np
import pytest

from pixcal.estimators.detector.neighbours import NoiseBlock, pair_sums

T, Y, X, MARGIN = 3, 11, 14, 2


@pytest.mark.parametrize("step", [(0, 1), (1, 0), (1, 1), (1, -1), (2, 3)])
def test_they_are_those_of_the_definition(step: tuple[int, int]) -> None:
    rng = np.random.default_rng(3)
    residual = rng.standard_normal((T, Y, X))
    residual[rng.random((T, Y, X)) < 0.2] = 0
    variance, charge, *shared = rng.uniform(1, 2, (4, T, Y, X))
    root, of_place = rng.standard_normal((T, 2, 2)), rng.standard_normal((2, Y, X))
    covariance = root @ root.swapaxes(1, 2)
    given = [a.astype(np.float32) for a in (residual, variance, charge, *shared)]
    noise = NoiseBlock(
        *given[:3], covariance.astype(np.float32), of_place.astype(np.float32), kept=1.0
    )
    found, right = pair_sums(noise, (given[3], given[4]), step, MARGIN)

    normal, expected = np.zeros((4, 4)), np.zeros(4)
    for t in range(T):
        for y in range(MARGIN, Y - MARGIN):
            for x in range(MARGIN, X - MARGIN):
                v, u = y + step[0], x + step[1]
                if not (v < Y - MARGIN and MARGIN <= u < X - MARGIN):
                    continue
                product = residual[t, y, x] * residual[t, v, u]
                weight = (product != 0) / (variance[t, y, x] * variance[t, v, u])
                product += of_place[:, y, x] @ covariance[t] @ of_place[:, v, u]
                terms = np.array(
                    [1, charge[t, y, x] + charge[t, v, u], shared[0][t, y, x], shared[1][t, y, x]]
                )
                normal += weight * np.outer(terms, terms)
                expected += weight * product * terms
    np.testing.assert_allclose(found, normal, rtol=1e-5)
    np.testing.assert_allclose(right, expected, rtol=1e-4, atol=1e-4)
