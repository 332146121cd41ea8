"""Light of a star in square pixels, from the diffraction pattern of a telescope.

A circular aperture of diameter D with a central obscuration gives (Born & Wolf, Principles of
Optics, 8.6.2) the Airy pattern, per unit of collected light and per square pixel

    I(r) = pi (1 - e^2) / (4 q^2) [(J(z) - e^2 J(e z)) / (1 - e^2)]^2    J(z) = 2 J1(z) / z

with z = pi r / q, r in pixels, e the diameter of the obscuration over D, and q = lambda f / (D p)
the number of pixels (pitch p) per lambda / D. A pixel of uniform response receives the average of
that pattern over its square, a function of the distance of its centre from the star. This function
has no frequency above 1/q cycles per pixel, q = 2 being Nyquist's limit (paper, section 2), and is
stored as a cubic B-spline with negligible error (`KNOTS`).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import spline_filter
from scipy.special import j1

from pixcal.kernels import inner, kernel
from pixcal.model.arrays import F64

# knots of the spline per lambda / D: the table is accurate to 1e-6 of its peak (see the tests)
KNOTS = 24
# margin of the table around the window, px, for decentred stars and pixel offsets
MARGIN = 2.0


@dataclass(frozen=True)
class Psf:
    """Share of a star's light that a pixel receives, as a function of its place from the star."""

    coefficients: F64  # (n, n) of the cubic B-spline, (y, x); the central one is at the star
    step: float  # distance of knots, px

    @property
    def reach(self) -> float:
        """Farthest pixel from the star along x or y, px."""
        return float((self.coefficients.shape[0] // 2 - 2) * self.step)

    @property
    def peak(self) -> float:
        """Share of the light received by a pixel centred on the star."""
        return float(self.at(0.0, 0.0)[0])

    def at(self, x: ArrayLike, y: ArrayLike) -> F64:
        """Share of the light and its derivatives along x and y: (3, ...) of 1, 1/px, 1/px.

        ``x``, ``y``: centre of the pixel minus the star (px); beyond `reach`, values at the edge.
        """
        xs, ys = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        shares = _shares(self.coefficients, self.step, xs.ravel(), ys.ravel())
        return np.asarray(shares.reshape(3, *xs.shape))


def diffraction_psf(sampling: float, obscuration: float, half: int) -> Psf:
    """The pattern of a telescope, averaged over square pixels, up to ``half`` px from the star.

    ``sampling`` is q, pixels per lambda / D; ``obscuration`` the diameter of the central
    obscuration over that of the aperture, 0 to below 1.
    """
    step = sampling / KNOTS
    side = math.ceil((half + MARGIN) / step) + 3
    at = step * np.arange(side)
    # Gauss-Legendre nodes over a pixel: accurate, as it holds few periods of the pattern.
    nodes, weights = np.polynomial.legendre.leggauss(8 + math.ceil(2 / sampling))
    quadrant = np.zeros((side, side))
    for node_y, weight_y in zip(nodes / 2, weights / 2, strict=True):
        for node_x, weight_x in zip(nodes / 2, weights / 2, strict=True):
            radius = np.hypot((at + node_y)[:, None], (at + node_x)[None, :])
            quadrant += weight_y * weight_x * intensity(radius, sampling, obscuration)
    upper = np.concatenate([quadrant[:, :0:-1], quadrant], axis=1)
    whole = np.concatenate([upper[:0:-1], upper])
    return Psf(np.asarray(spline_filter(whole, order=3, mode="mirror")), step)


def intensity(radius: F64, sampling: float, obscuration: float) -> F64:
    """The pattern at radii (...) px, of unit total, 1/px²; see `diffraction_psf`."""
    z = np.pi * radius / sampling
    open_area = 1 - obscuration**2
    amplitude = (_jinc(z) - obscuration**2 * _jinc(obscuration * z)) / open_area
    return np.asarray(np.pi * open_area / (4 * sampling**2) * amplitude**2)


def _jinc(z: F64) -> F64:
    small = np.abs(z) < 1e-6
    away = np.where(small, 1.0, z)
    return np.where(small, 1.0, 2 * j1(away) / away)


@inner(inline="always")
def _spline(t: float) -> tuple[Any, Any]:
    """Weights of four knots around a place at t beyond the second, and their derivatives."""
    s = 1.0 - t
    weights = s**3 / 6, (3 * t * t * (t - 2) + 4) / 6, (3 * s * s * (s - 2) + 4) / 6, t**3 / 6
    return weights, (-s * s / 2, t * (1.5 * t - 2), -s * (1.5 * s - 2), t * t / 2)


@kernel()
def _shares(coefficients: F64, step: float, x: F64, y: F64) -> F64:
    n, out = coefficients.shape[0], np.zeros((3, x.size))
    for place in range(x.size):
        u = min(max(x[place] / step + n // 2, 1.0), n - 2.000001)
        v = min(max(y[place] / step + n // 2, 1.0), n - 2.000001)
        j, i = int(u), int(v)
        of_x, slope_x = _spline(u - j)
        of_y, slope_y = _spline(v - i)
        for k in range(4):
            value = along = 0.0
            for m in range(4):
                c = coefficients[i - 1 + k, j - 1 + m]
                value += of_x[m] * c
                along += slope_x[m] * c
            out[0, place] += of_y[k] * value
            out[1, place] += of_y[k] * along / step
            out[2, place] += slope_y[k] * value / step
    return out
