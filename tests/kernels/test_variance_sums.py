"""Sums over many small matrices, against NumPy."""

import numpy as np

from pixcal.kernels.variance_sums import trace_products


def test_the_sums_are_those_of_numpy() -> None:
    rng = np.random.default_rng(2)
    n, m = 23, 5
    weight = rng.standard_normal((n, 2, 2))
    weight = weight + np.swapaxes(weight, 1, 2)
    parts = rng.standard_normal((m, n, 2, 2))
    parts = parts + np.swapaxes(parts, 2, 3)
    parts[1, 3:], parts[4, :10] = 0.0, 0.0
    product = np.einsum("nab,inbc->inac", weight, parts)
    np.testing.assert_allclose(
        trace_products(weight, parts), np.einsum("inab,jnba->ij", product, product), rtol=1e-10
    )
