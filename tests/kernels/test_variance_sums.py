"""Sums over many small matrices, against NumPy."""

import numpy as np

from pixcal.kernels.variance_sums import gram, sandwich, trace_products


def test_the_sums_are_those_of_numpy() -> None:
    rng = np.random.default_rng(2)
    n, m, p = 23, 5, 7
    weight = rng.standard_normal((n, 2, 2))
    weight = weight + np.swapaxes(weight, 1, 2)
    parts = rng.standard_normal((m, n, 2, 2))
    parts = parts + np.swapaxes(parts, 2, 3)
    parts[1, 3:], parts[4, :10] = 0.0, 0.0
    left, right = rng.standard_normal((n, 2, p)), rng.standard_normal((n, 2, 3))
    middle = rng.standard_normal((p, p))
    product = np.einsum("nab,inbc->inac", weight, parts)
    np.testing.assert_allclose(
        trace_products(weight, parts), np.einsum("inab,jnba->ij", product, product), rtol=1e-10
    )
    np.testing.assert_allclose(gram(left, right), np.einsum("nap,naq->pq", left, right))
    np.testing.assert_allclose(
        sandwich(left, middle), np.einsum("nap,pq,nbq->nab", left, middle, left), rtol=1e-10
    )
