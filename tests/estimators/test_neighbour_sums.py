"""Sums over products of neighbours: as written out in numpy."""

import numpy as np
import pytest

from pixcal.estimators.crosstalk.boundaries import pair_sums
from pixcal.estimators.crosstalk.residuals import Residuals

T, Y, X, MARGIN = 3, 11, 14, 2


@pytest.mark.parametrize("steady", [False, True])
@pytest.mark.parametrize("step", [(0, 1), (1, 0), (1, 1), (1, -1), (2, 3)])
def test_they_are_those_of_the_definition(step: tuple[int, int], steady: bool) -> None:
    rng = np.random.default_rng(3)
    charges = 1 if steady else T
    frame = np.array([0, 1, 2, 0, 2]) * (not steady)  # the last two are modes
    weight = rng.uniform(1, 2, (T, Y, X)) * (rng.random((T, Y, X)) > 0.2)
    e = rng.standard_normal((len(frame), Y, X))
    charge, *shared = rng.uniform(1, 2, (3, charges, Y, X))
    given = [a.astype(np.float32) for a in (e, charge, weight, *shared)]
    found, right = pair_sums(Residuals(*given[:3], frame), (given[3], given[4]), step, MARGIN)

    normal, expected = np.zeros((4, 4)), np.zeros(4)
    for row, t in enumerate(frame):
        for y in range(MARGIN, Y - MARGIN):
            for x in range(MARGIN, X - MARGIN):
                v, u = y + step[0], x + step[1]
                if not (v < Y - MARGIN and MARGIN <= u < X - MARGIN):
                    continue
                terms = np.array(
                    [1, charge[t, y, x] + charge[t, v, u], shared[0][t, y, x], shared[1][t, y, x]]
                )
                expected += e[row, y, x] * e[row, v, u] * terms
                if row < T:
                    normal += weight[row, y, x] * weight[row, v, u] * np.outer(terms, terms)
    np.testing.assert_allclose(found, normal, rtol=1e-5)
    np.testing.assert_allclose(right, expected, rtol=1e-4, atol=1e-4)
