"""The local fit, against scipy.signal's."""

import numpy as np
import pytest
from scipy.signal import savgol_coeffs, savgol_filter

from pixcal.kernels.local_fit import local_fit, middle_weights


@pytest.mark.parametrize(("half", "order"), [(4, 3), (12, 3), (3, 2)])
def test_it_is_the_filter_of_savitzky_and_golay(half: int, order: int) -> None:
    values = np.random.default_rng(half).poisson(200.0, 300).astype(float)
    expected = savgol_filter(values, 2 * half + 1, order)
    np.testing.assert_allclose(local_fit(values, half, order), expected, rtol=1e-12)
    expected = savgol_coeffs(2 * half + 1, order)
    np.testing.assert_allclose(middle_weights(half, order), expected, rtol=0, atol=1e-14)


def test_a_polynomial_of_its_order_stays_as_it_is() -> None:
    values = np.polyval([1e-3, -0.2, 3.0, 7.0], np.arange(60.0))
    np.testing.assert_allclose(local_fit(values, 5, 3), values, rtol=1e-9, atol=1e-9)
