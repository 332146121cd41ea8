"""Optical path difference of two fibres on a detector, exact and paraxial.

Positions are ``r = (x p, y p, 0)``: pixel coordinates x (column) and y (row), offsets included,
times the pitch p. The origin is pixel (0, 0) of the grid of x and y; the geometry has the same
origin, in millimetres. With fibre A at minus half the baseline and fibre B at plus
half of it about their centre, the phase is ``psi = 2 pi / lambda (|r - s_A| - |r - s_B|)``, which
grows along the baseline: its paraxial gradient is ``K = 2 pi / lambda p b / D`` rad/px.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from pixcal.model.arrays import F64

# parameters of `phase_jacobian`, in its order; all in mm
PARAMETERS = ("centre_x", "centre_y", "distance", "baseline_x", "baseline_y", "baseline_z")


@dataclass(frozen=True)
class Geometry:
    """Two fibre tips in front of a detector; lengths in mm.

    The parameters are centre, separation and distance rather than the two points, because the data
    can distinguish them (physics note, section 4).
    """

    wavelength: float  # wavelength, pitch: laser wavelength and pixel pitch
    pitch: float
    # centre_x, centre_y: projection of the fibres' midpoint on the detector, from pixel (0, 0)
    centre_x: float
    centre_y: float
    distance: float  # from the midpoint to the detector plane
    # baseline_x, baseline_y, baseline_z: fibre B minus fibre A; z is the tilt of the baseline,
    # positive away from the detector
    baseline_x: float
    baseline_y: float
    baseline_z: float = 0.0

    @property
    def wavenumber(self) -> float:
        """2 pi / wavelength, in rad/mm."""
        return 2 * np.pi / self.wavelength

    def vector(self) -> F64:
        """The parameters (mm) in the order of `PARAMETERS`."""
        return np.array([getattr(self, name) for name in PARAMETERS])

    def with_vector(self, values: ArrayLike) -> "Geometry":
        """The same geometry with other parameters, given in the order of `PARAMETERS`."""
        numbers = np.asarray(values, float).tolist()
        return replace(self, **dict(zip(PARAMETERS, numbers, strict=True)))


def phase(x: ArrayLike, y: ArrayLike, geometry: Geometry) -> F64:
    """Exact fringe phase psi, rad, accurate to 1e-9 rad, at pixel coordinates.

    The plain difference of the two paths (paper, eq. 3) loses seven digits; computed is
    ``(s_A - s_B)·(s_A + s_B - 2 r) / (|r - s_A| + |r - s_B|)`` (physics note, section 1).
    """
    cx, cy, d, bx, by, bz = geometry.vector()
    qx, qy = np.asarray(x, float) * geometry.pitch - cx, np.asarray(y, float) * geometry.pitch - cy
    # If x is a row and y a column, these terms are computed on the sides only.
    paths: F64 = np.sqrt((qx + 0.5 * bx) ** 2 + (qy + 0.5 * by) ** 2 + (0.5 * bz - d) ** 2)
    paths += np.sqrt((qx - 0.5 * bx) ** 2 + (qy - 0.5 * by) ** 2 + (-0.5 * bz - d) ** 2)
    return np.asarray(geometry.wavenumber * 2.0 * (bx * qx + by * qy - bz * d) / paths)


def paraxial_vector(geometry: Geometry) -> tuple[float, float]:
    """Fringe vector (kx, ky) in rad/px of the straight-fringe limit (paper, eq. 4)."""
    scale = geometry.wavenumber * geometry.pitch / geometry.distance
    return scale * geometry.baseline_x, scale * geometry.baseline_y


def paraxial_phase(x: ArrayLike, y: ArrayLike, geometry: Geometry) -> F64:
    """Phase of straight fringes (paper, eq. 4), zero at the projection of the fibres' midpoint."""
    # As `phase`, but without the tilt of the baseline, as in the paper.
    kx, ky = paraxial_vector(geometry)
    cx, cy = geometry.centre_x / geometry.pitch, geometry.centre_y / geometry.pitch
    return np.asarray(kx * (np.asarray(x, float) - cx) + ky * (np.asarray(y, float) - cy))


def interfringe(k: tuple[float, float]) -> float:
    """Period (px) of fringes of vector (kx, ky), rad/px."""
    return float(2 * np.pi / np.hypot(*k))


def fringe_vector(x: ArrayLike, y: ArrayLike, geometry: Geometry) -> tuple[F64, F64]:
    """Local fringe vector: the exact gradient of `phase` with respect to x and y, in rad/px."""
    path = _Paths(x, y, geometry)
    scale = geometry.wavenumber * geometry.pitch
    kx, ky = (scale * path.quotient(2 * path.b[n], path.ua[n] + path.ub[n]) for n in (0, 1))
    return kx, ky


def phase_jacobian(x: ArrayLike, y: ArrayLike, geometry: Geometry) -> F64:
    """Derivative (..., 6), rad/mm, of `phase` by the geometry's `PARAMETERS`, in their order."""
    path = _Paths(x, y, geometry)
    of_centre = path.quotient(-2 * path.b, -(path.ua + path.ub))
    of_baseline = path.quotient(2 * path.q, (path.ua - path.ub) / 2)
    return np.moveaxis(geometry.wavenumber * np.concatenate([of_centre, of_baseline]), 0, -1)


class _Paths:
    """Optical path difference and its derivatives, free of cancellation.

    The quotient ``2 b·q / (|q + b/2| + |q - b/2|)``, q from the fibres' centre, and the unit
    vectors of both paths; vectors (3, ...), b (3, 1, ...).
    """

    def __init__(self, x: ArrayLike, y: ArrayLike, geometry: Geometry) -> None:
        xs, ys = np.broadcast_arrays(np.asarray(x, float), np.asarray(y, float))
        cx, cy, distance, *baseline = geometry.vector()
        self.b = np.reshape(baseline, (3,) + (1,) * xs.ndim)
        self.q = np.stack([xs * geometry.pitch - cx, ys * geometry.pitch - cy, xs * 0 - distance])
        to_a, to_b = self.q + self.b / 2, self.q - self.b / 2
        rho_a, rho_b = np.sqrt((to_a**2).sum(0)), np.sqrt((to_b**2).sum(0))
        self.ua, self.ub, self.sum = to_a / rho_a, to_b / rho_b, rho_a + rho_b
        self.opd = 2 * (self.b * self.q).sum(axis=0) / self.sum

    def quotient(self, numerator: F64, paths: F64) -> F64:
        """Derivative of the OPD from the derivatives of numerator and sum of the paths."""
        return np.asarray((numerator - self.opd * paths) / self.sum)


def gaussian_beam(x: ArrayLike, y: ArrayLike, centre: tuple[float, float], radius: float) -> F64:
    """Intensity of a Gaussian beam (1/e² radius) at x, y, relative to its peak; all in px."""
    # A product: if x is a row and y a column, exponentials are computed on the sides only.
    across = np.exp(-2 * ((np.asarray(x, float) - centre[0]) / radius) ** 2)
    along = np.exp(-2 * ((np.asarray(y, float) - centre[1]) / radius) ** 2)
    return np.asarray(along * across)
