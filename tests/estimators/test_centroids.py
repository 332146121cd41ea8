"""The fit of stars: exact without noise, at the bound with it, wrong as the weights predict."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.integrate import quad
from scipy.special import jv

from pixcal.estimators.star_centroids import Star
from pixcal.kernels.psf import diffraction_psf

F64 = NDArray[np.float64]


def star(sampling: float = 2.53, obscuration: float = 0.0, **changes: float) -> Star:
    half = int(changes.pop("half", max(2, int(np.ceil(4 * sampling)))))
    settings = {"electrons": 1e7, "background": 3.0, "read_variance": 2000.0} | changes
    return Star(diffraction_psf(sampling, obscuration, half), half, **settings)


def scene(
    of: Star, n: int, offset: float, masked: float = 0.0
) -> tuple[F64, F64, NDArray[np.bool_]]:
    """Places, offsets, and good pixels."""
    rng = np.random.default_rng(5)
    place = rng.uniform(-0.5, 0.5, (n, 2))
    offsets = rng.normal(0, offset, (n, 2, of.side, of.side))
    return place, offsets, rng.random((n, of.side, of.side)) >= masked


@pytest.mark.parametrize(
    ("sampling", "masked"), [(2.53, 0.0), (2.53, 0.05), (0.6, 0.0), (2.0, 0.0), (6.0, 0.1)]
)
def test_where_pixels_are_known_the_fit_is_exact(sampling: float, masked: float) -> None:
    of = star(sampling)
    place, offsets, good = scene(of, 30, 2e-2, masked)
    found = of.fit(of.expected(place, offsets), offsets, good)
    np.testing.assert_allclose(found[:, :2], place, atol=1e-8)
    np.testing.assert_allclose(found[:, 2], of.electrons, rtol=1e-7)
    np.testing.assert_allclose(found[:, 3], of.background, atol=1e-2)


def test_masked_pixels_have_no_part() -> None:
    of = star()
    place, offsets, good = scene(of, 20, 5e-3, 0.03)
    data = of.expected(place, offsets)
    other = np.where(good, data, -1e9)
    np.testing.assert_array_equal(of.fit(data, offsets, good), of.fit(other, offsets, good))


@pytest.mark.parametrize("sampling", [0.6, 2.53])
def test_a_shift_of_all_pixels_shifts_the_star_back(sampling: float) -> None:
    of = star(sampling)
    place, offsets, good = scene(of, 10, 0.0)
    moved = offsets + np.array([0.021, -0.034])[:, None, None]
    found = of.fit(of.expected(place, moved), offsets, good)
    np.testing.assert_allclose(found[:, :2] - place, [[-0.021, 0.034]] * 10, atol=1e-8)


@pytest.mark.parametrize("sampling", [0.6, 2.53])
def test_the_weights_predict_the_error_to_first_order(sampling: float) -> None:
    of = star(sampling)
    place, offsets, good = scene(of, 25, 1e-2, 0.03)
    weights = np.stack([of.weights(p, g) for p, g in zip(place, good, strict=True)])
    np.testing.assert_allclose(
        weights.sum(axis=(3, 4)), np.broadcast_to(-np.eye(2), (25, 2, 2)), atol=1e-9
    )
    rests = []
    for scale in (1.0, 0.5):
        predicted = np.einsum("nacyx,ncyx->na", weights, scale * offsets)
        data = of.expected(place, scale * offsets)
        error = of.fit(data, np.zeros_like(offsets), good)[:, :2] - place
        rests.append(np.sqrt(np.mean((error - predicted) ** 2)))
        assert rests[-1] < 0.1 * np.std(error)
    # What is left is of second order.
    assert rests[0] / rests[1] == pytest.approx(4, rel=0.25)


@pytest.mark.parametrize("obscuration", [0.0, 0.3])
def test_the_bound_of_photon_noise_is_the_closed_form(obscuration: float) -> None:
    """lambda / (pi D sqrt(N (1 + e²))) for small pixels, less what the window leaves out."""
    sampling, half, electrons = 40.0, 200, 1e6
    of = star(sampling, obscuration, half=half, electrons=electrons, background=0, read_variance=0)

    def slope(z: float) -> float:
        """Of the amplitude 2 (J1(z) - e J1(e z)) / z / (1 - e²), along the radius."""
        away = jv(2, z) - obscuration**2 * jv(2, obscuration * z)
        return float(-2 * away / z / (1 - obscuration**2))

    def share(radius: float) -> float:
        """Of the information, inside a circle."""
        top = np.pi * radius / sampling
        inside = quad(lambda z: slope(z) ** 2 * z, 1e-6, top, limit=500)[0]
        # Over the whole plane the integral is (1 + e²) / (1 - e²), which makes the closed form.
        return float(inside * (1 - obscuration**2) / (1 + obscuration**2))

    closed = sampling / (np.pi * np.sqrt(electrons * (1 + obscuration**2)))
    low, high = share(half), share(np.sqrt(2) * (half + 1))
    assert 0.85 < low < high < 1
    bound = of.bound(np.zeros(2))
    assert bound[0] == pytest.approx(bound[1])
    assert closed / np.sqrt(high) < bound[0] < 1.015 * closed / np.sqrt(low)


def test_the_bound_grows_with_the_pixels() -> None:
    """In units of lambda / D: pixels too large for Nyquist lose most of the position."""
    bounds = []
    for sampling in (6.0, 2.5, 2.0, 1.0, 0.5):
        of = star(sampling, electrons=1e6, background=0, read_variance=0)
        bounds.append(float(np.mean(of.bound())) / sampling * np.pi * 1e3)
    assert bounds == sorted(bounds)
    assert 1.0 < bounds[0] < 1.15
    assert bounds[1] < 1.35
    assert bounds[-1] > 2


@pytest.mark.quick(1)
@pytest.mark.parametrize(("electrons", "read_variance"), [(1e7, 0.0), (1e6, 500.0), (3e4, 256.0)])
def test_noise_scatters_the_fits_by_the_bound(electrons: float, read_variance: float) -> None:
    of = star(electrons=electrons, background=20.0, read_variance=read_variance)
    n = 1500
    place, offsets, good = scene(of, n, 5e-3)
    rng = np.random.default_rng(8)
    mean = of.expected(place, offsets)
    data = rng.poisson(mean) + rng.normal(0, np.sqrt(read_variance), mean.shape)
    error = of.fit(data, offsets, good)[:, :2] - place
    assert np.all(np.isfinite(error))
    ratio = np.sqrt(np.mean(error**2, axis=0)) / of.bound()
    np.testing.assert_allclose(ratio, 1, atol=4 / np.sqrt(2 * n))
    assert np.all(np.abs(error.mean(axis=0)) < 4 * of.bound() / np.sqrt(n))


def test_a_window_without_a_star_gives_nothing() -> None:
    of = star()
    data = np.zeros((3, of.side, of.side))
    data[2] = np.nan
    good = np.ones(data.shape, bool)
    good[0] = False
    found = of.fit(data, np.zeros((3, 2, of.side, of.side)), good)
    assert np.all(np.isnan(found[[0, 2]]))
    assert not np.any(np.abs(found[1, 2:]) > 1)
