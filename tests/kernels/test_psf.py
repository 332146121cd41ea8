"""The star's pattern: closed forms, Fourier's way to the same numbers, and its limits."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import j0, j1

from pixcal.kernels.psf import diffraction_psf, intensity

F64 = NDArray[np.float64]
CASES = [(2.53, 0.0), (2.53, 0.33), (2.0, 0.0), (0.6, 0.0), (7.0, 0.1)]


def half_of(sampling: float) -> int:
    return max(2, int(np.ceil(4 * sampling)))


def by_fourier(x: F64, y: F64, sampling: float) -> F64:
    """Through the transfer function: that of a circle times the pixel's, on a polar grid."""
    nodes, weights = np.polynomial.legendre.leggauss(120)
    nu = (nodes + 1) / 2
    transfer = 2 / np.pi * (np.arccos(nu) - nu * np.sqrt(1 - nu**2))
    angle = np.arange(256) * 2 * np.pi / 256
    u, v = (nu[:, None] * f(angle) / sampling for f in (np.cos, np.sin))
    ring = transfer * nu * weights / 2 / sampling**2 * 2 * np.pi / 256
    pixel = np.sinc(u) * np.sinc(v) * ring[:, None]
    return np.array(
        [np.sum(pixel * np.cos(2 * np.pi * (u * a + v * b))) for a, b in zip(x, y, strict=True)]
    )


@pytest.mark.parametrize("sampling", [0.6, 2.0, 2.53, 7.0])
def test_fourier_gives_the_same(sampling: float) -> None:
    psf = diffraction_psf(sampling, 0.0, half_of(sampling))
    rng = np.random.default_rng(1)
    x, y = rng.uniform(-2.5 * sampling, 2.5 * sampling, (2, 60))
    found = psf.at(x, y)[0]
    assert np.abs(found - by_fourier(x, y, sampling)).max() < 3e-6 * psf.peak


@pytest.mark.parametrize(("sampling", "obscuration"), CASES)
def test_the_slope_is_the_light_that_enters_less_that_which_leaves(
    sampling: float, obscuration: float
) -> None:
    """A pixel that moves gains a column of the pattern at one side, loses one at the other."""
    half = half_of(sampling)
    psf = diffraction_psf(sampling, obscuration, half)
    rng = np.random.default_rng(2)
    x, y = rng.uniform(-half, half, (2, 500))
    nodes, weights = np.polynomial.legendre.leggauss(60)

    def column(at: F64, along: F64) -> F64:
        radius = np.hypot(at[:, None], along[:, None] + nodes / 2)
        return np.asarray(intensity(radius, sampling, obscuration) @ weights / 2)

    _, along_x, along_y = psf.at(x, y)
    slope_x = column(x + 0.5, y) - column(x - 0.5, y)
    slope_y = column(y + 0.5, x) - column(y - 0.5, x)
    assert np.abs(along_x - slope_x).max() < 1e-4 * np.abs(slope_x).max()
    assert np.abs(along_y - slope_y).max() < 1e-4 * np.abs(slope_y).max()


@pytest.mark.parametrize(("sampling", "obscuration"), CASES)
def test_the_same_on_all_sides(sampling: float, obscuration: float) -> None:
    psf = diffraction_psf(sampling, obscuration, half_of(sampling))
    x, y = np.random.default_rng(3).uniform(0, 2 * sampling, (2, 100))
    value, along_x, along_y = psf.at(x, y)
    np.testing.assert_allclose(psf.at(-x, y)[0], value, atol=1e-12)
    np.testing.assert_allclose(psf.at(y, x)[0], value, atol=1e-12)
    np.testing.assert_allclose(psf.at(-x, y)[1], -along_x, atol=1e-10)
    np.testing.assert_allclose(psf.at(y, x)[1], along_y, atol=1e-10)


@pytest.mark.parametrize("place", [(0.0, 0.0), (0.31, -0.47), (0.5, 0.5)])
@pytest.mark.parametrize("sampling", [0.6, 2.53])
def test_the_light_in_the_window_is_that_of_the_airy_pattern(
    sampling: float, place: tuple[float, float]
) -> None:
    """Between those of the circles in and about the window (Rayleigh: 1 - J0² - J1²)."""
    half = half_of(sampling)
    at = np.arange(-half, half + 1)
    psf = diffraction_psf(sampling, 0.0, half)
    total = psf.at(at[None, :] - place[0], at[:, None] - place[1])[0].sum()
    inner, outer = half + 0.5 - max(map(abs, place)), np.sqrt(2) * (half + 0.5) + 0.5
    low, high = (
        1 - j0(np.pi * r / sampling) ** 2 - j1(np.pi * r / sampling) ** 2 for r in (inner, outer)
    )
    assert low < total < high
    assert high - low < 0.04


def test_small_pixels_see_the_pattern_itself() -> None:
    sampling = 30.0
    psf = diffraction_psf(sampling, 0.2, 40)
    r = np.linspace(0, 40, 50)
    pattern = intensity(r, sampling, 0.2)
    assert np.abs(psf.at(r, np.zeros_like(r))[0] - pattern).max() < 2e-3 * psf.peak
    assert intensity(np.zeros(1), sampling, 0.0)[0] == pytest.approx(np.pi / 4 / sampling**2)


def test_large_pixels_see_one_spot() -> None:
    psf = diffraction_psf(0.4, 0.0, 3)
    assert psf.peak > 0.8
    # On the border of two pixels each has half.
    assert psf.at(0.5, 0.0)[0] == pytest.approx(psf.at(-0.5, 0.0)[0])
    assert psf.at(0.5, 0.0)[0] == pytest.approx(psf.peak / 2, rel=0.06)


def test_the_obscuration_sharpens_and_dims() -> None:
    open_aperture, ring = diffraction_psf(2.5, 0.0, 10), diffraction_psf(2.5, 0.4, 10)
    assert ring.peak < open_aperture.peak
    r = np.linspace(0, 3.2, 200)
    dark = [np.argmin(p.at(r, np.zeros_like(r))[0]) for p in (open_aperture, ring)]
    assert dark[1] < dark[0]


def test_beyond_the_table_the_edge_holds() -> None:
    psf = diffraction_psf(2.0, 0.0, 5)
    assert psf.reach >= 7
    value, *_ = psf.at([1e3, -1e3, 0.0], [0.0, 2e3, 7.0])
    assert np.all(np.isfinite(value))
    assert np.all(value < 1e-2 * psf.peak)
