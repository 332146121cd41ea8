"""Contrast and light of two Gaussian beams, computed here from their intensities."""

import numpy as np
import pytest
from scipy.special import logsumexp

from pixcal.estimators.maps.structure import smooth_surface
from pixcal.estimators.maps.two_beams import contrast_surface, light_surface
from pixcal.model.arrays import F64

SHAPE = (97, 150)
Y, X = np.mgrid[: SHAPE[0], : SHAPE[1]] / SHAPE[1]
GAMMA, NOISE = 0.9, 1e-3
EVERYWHERE = np.ones(SHAPE, bool)


def log_beams(*beams: tuple[float, float, float, float]) -> F64:
    """Logarithms (beam, y, x) of intensities: centre x and y, radius (in widths), and power."""
    return np.stack(
        [
            np.log(power) - 2 * ((X - x) ** 2 + (Y - y) ** 2) / radius**2
            for x, y, radius, power in beams
        ]
    )


def maps(logs: F64, seed: int, stray: F64 | float = 0.0) -> tuple[F64, F64, F64]:
    """Maps (3, y, x) of a set with noise, and the true light and contrast."""
    light = np.exp(logsumexp(logs, axis=0))
    alpha = 2 * GAMMA * np.exp(logs.mean(axis=0))
    light = light * (1 + stray)
    noise = 1 + NOISE * np.random.default_rng(seed).standard_normal((2, *SHAPE))
    angle = 2 * np.pi * X * SHAPE[1] / 7.3
    wave = alpha * noise[1] * np.stack([np.sin(angle), np.cos(angle)])
    return np.concatenate([(light * noise[0])[None], wave]), light, alpha / light


UNEQUAL = [
    [(1.3, 0.5, 1.9, 1.0), (0.0, 0.4, 1.6, 1.0)],
    [(0.6, 0.4, 1.1, 2.0), (0.4, 0.2, 1.3, 1.0)],
    [(0.5, 0.3, 0.8, 1.0), (0.5, 0.3, 1.6, 1.5)],
]


@pytest.mark.parametrize("beams", UNEQUAL)
def test_beams_of_unequal_radii_are_found(beams: list[tuple[float, float, float, float]]) -> None:
    theta, light, contrast = maps(log_beams(*beams), 1)
    theta[:, 30:33, 40:60] *= np.array([3.0, 1.0, 1.0])[:, None, None]  # outliers
    good = EVERYWHERE.copy()
    good[:, 70] = False
    theta[:, :, 70] = np.nan
    found = contrast_surface(theta, good)
    noise = NOISE * np.sqrt(2 / good.sum())
    # Seven numbers are fitted; at the edges their noise is several times the mean one.
    assert np.abs(found / contrast - 1).max() < 30 * noise
    alike = np.exp(smooth_surface(np.log(contrast), EVERYWHERE, 2))
    assert np.abs(alike / contrast - 1).max() > 100 * noise
    np.testing.assert_allclose(light_surface(theta[0], found, good), light, rtol=60 * noise)


def test_equal_beams_have_a_quadratic_logarithm() -> None:
    theta, _, contrast = maps(log_beams((0.4, 0.3, 2.5, 1.0), (0.6, 0.3, 2.5, 0.8)), 2)
    found = contrast_surface(theta, EVERYWHERE)
    np.testing.assert_allclose(found, contrast, rtol=10 * NOISE / np.sqrt(found.size / 6))
    terms = smooth_surface(np.log(found), EVERYWHERE, 2)
    np.testing.assert_allclose(np.log(found), terms, atol=1e-12)


@pytest.mark.parametrize("size", [0.01, 0.1])
def test_stray_light_is_not_taken_for_unequal_beams(size: float) -> None:
    """What two beams do not explain stays to be seen: the surface is the usual one."""
    bump = size * np.exp(-((X - 0.6) ** 2 + (Y - 0.2) ** 2) / (2 * 0.15**2))
    theta, _, _ = maps(log_beams((0.4, 0.3, 2.5, 1.0), (0.6, 0.3, 2.5, 0.8)), 3, bump)
    found = np.log(contrast_surface(theta, EVERYWHERE))
    np.testing.assert_allclose(found, smooth_surface(found, EVERYWHERE, 2), atol=1e-12)


def test_few_pixels_have_a_quadratic_logarithm() -> None:
    theta, _, contrast = maps(log_beams(*UNEQUAL[1]), 4)
    found = contrast_surface(theta[:, :4, :5], EVERYWHERE[:4, :5])
    np.testing.assert_allclose(found, contrast[:4, :5], rtol=5 * NOISE)
