"""Inverses of normal matrices: exact where all is determined, zero along what is not."""

import numpy as np
import pytest

from pixcal.kernels.normal_matrix import inverse_normal, symmetric


def test_units_of_the_parameters_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    design = rng.normal(size=(2, 40, 5)) * np.logspace(-9, 9, 5)
    normal = np.swapaxes(design, 1, 2) @ design
    identity = normal @ inverse_normal(normal)
    scale = np.logspace(-9, 9, 5)
    np.testing.assert_allclose(
        identity * scale[None, :] / scale[:, None], [np.eye(5)] * 2, atol=1e-9
    )


def test_an_undetermined_parameter_gets_zero() -> None:
    normal = np.diag([4.0, 0.0, 1e-20])
    np.testing.assert_allclose(inverse_normal(normal), np.diag([0.25, 0.0, 1e20]))


@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_a_symmetric_matrix_comes_back_from_its_upper_triangle(n: int) -> None:
    half = np.random.default_rng(n).standard_normal((3, n, n))
    matrix = half + half.swapaxes(1, 2)
    rows, columns = np.triu_indices(n)
    np.testing.assert_array_equal(symmetric(matrix[:, rows, columns]), matrix)
