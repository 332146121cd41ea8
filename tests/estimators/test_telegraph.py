"""Likelihoods of a mixture, against SciPy."""

import numpy as np
from scipy.special import logsumexp

from pixcal.estimators.telegraph import _Mixture


def test_the_likelihood_is_that_of_all_classes_even_where_numbers_underflow() -> None:
    rng = np.random.default_rng(3)
    logarithms = 30 * rng.standard_normal((40, 9))
    logarithms[7, 8] = 2000.0
    weight = rng.random(9)
    weight[8] = 0.0
    found = _Mixture.of(logarithms).log_likelihood(weight)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(found, logsumexp(logarithms, b=weight, axis=1), rtol=1e-12)
