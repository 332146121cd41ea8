"""Stars on a detector whose pixels are not where they seem: their centroids are put right."""

import numpy as np
import pytest
from scipy.integrate import dblquad

from pixcal.estimators.star_centroids import correct_centroids, correction_map, gaussian_star

SHAPE = (60, 70)


def offsets_of(rng, rms):
    return rms * rng.standard_normal((2, *SHAPE)) + np.array([2e-3, -1e-3])[:, None, None]


def observed(star, true, offsets):
    """Centroids by a fit that takes the pixels for a perfect grid."""
    middle = np.rint(true).astype(int)
    window = np.stack(
        [
            offsets[:, y - star.half : y + star.half + 1, x - star.half : x + star.half + 1]
            for x, y in middle
        ]
    )
    data = star.expected(true - middle, window)
    found = star.fit(data, np.zeros_like(window), np.ones_like(data, bool))
    return middle + found[:, :2]


@pytest.mark.parametrize("fwhm", [1.2, 2.5, 5.0])
@pytest.mark.parametrize("electrons", [None, 1e6])
def test_a_star_is_put_where_it_is(fwhm, electrons):
    """To first order in the offsets: what is left is their square."""
    rng = np.random.default_rng(7)
    offsets = offsets_of(rng, 2e-3)
    star = gaussian_star(fwhm, electrons, read_noise=10.0)
    true = rng.uniform(20, 40, (40, 2))
    measured = observed(star, true, offsets)
    found = correct_centroids(measured, offsets, np.full_like(offsets, 1e-4), star)
    before, after = (np.sqrt(np.mean((v - true) ** 2)) for v in (measured, found.place))
    assert before > 1e-3
    assert after < 0.02 * before
    # A map that is good to 1e-4 px leaves that, times the norm of the weights.
    assert np.all((found.error > 1e-5) & (found.error < 1e-4))


def test_a_shift_of_all_pixels_is_added():
    """The sign of the interface: a positive offset means a response at larger x."""
    offsets = np.zeros((2, *SHAPE)) + np.array([0.01, -0.02])[:, None, None]
    star = gaussian_star(2.0, None, 0.0)
    place = np.random.default_rng(1).uniform(15, 45, (20, 2))
    found = correct_centroids(place, offsets, offsets * 0, star)
    np.testing.assert_allclose(found.place - place, [[0.01, -0.02]] * 20, atol=1e-9)


def test_in_the_middle_of_pixels_the_map_says_the_same():
    rng = np.random.default_rng(3)
    offsets, star = offsets_of(rng, 3e-3), gaussian_star(2.3, None, 0.0)
    whole = correction_map(offsets, star)
    place = rng.integers(15, 45, (30, 2)).astype(float)
    found = correct_centroids(place, offsets, np.zeros_like(offsets), star)
    x, y = place.astype(int).T
    np.testing.assert_allclose((found.place - place).T, whole[:, y, x], atol=2e-8)
    np.testing.assert_array_equal(correction_map(offsets, None), offsets.astype(np.float32))


def test_pixels_hold_the_gaussian_averaged_over_their_squares():
    star = gaussian_star(1.5, None, 0.0)
    sigma = 1.5 / np.sqrt(8 * np.log(2))
    for x, y in ((0.0, 0.0), (0.3, -0.7), (2.0, 1.1)):
        expected = dblquad(
            lambda v, u: np.exp(-(u**2 + v**2) / (2 * sigma**2)) / (2 * np.pi * sigma**2),
            x - 0.5,
            x + 0.5,
            y - 0.5,
            y + 0.5,
        )[0]
        assert star.psf.at(x, y)[0] == pytest.approx(expected, abs=1e-5 * star.psf.peak)


def test_stars_of_which_too_little_is_known_are_left_out():
    offsets = np.zeros((2, *SHAPE))
    offsets[:, 29:32, 30] = np.nan
    star = gaussian_star(2.0, None, 0.0)
    place = np.array([[30.5, 30.0], [50, 30], [-40, 30], [0, 0], [np.nan, 3], [1e30, 3]])
    found = correct_centroids(place, offsets, np.zeros_like(offsets), star).place
    np.testing.assert_array_equal(np.isfinite(found[:, 0]), [False, True, *4 * [False]])
