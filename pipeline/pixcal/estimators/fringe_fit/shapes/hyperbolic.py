"""Exact fringes: the difference of the paths from two fibre tips (paper, equation 3).

The phases of tiles, unwrapped, make the fit of the fibres' positions nearly linear (physics note,
section 4). Parameters that a small window cannot determine keep their nominal values within
`prior_errors`.
"""

from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np
from scipy.optimize import least_squares

from pixcal.estimators.fringe_fit.shapes import FringeShape, Start
from pixcal.kernels.optics import PARAMETERS, Geometry, fringe_vector, phase, phase_jacobian
from pixcal.model.arrays import F64

# the projection of the fibres' midpoint: the laboratory places it to less than 2 cm (paper, 5.2)
PRIOR_CENTRE_MM = 20.0
PRIOR_DISTANCE = 0.025  # the distance, as a share: 10 mm of 400 mm
PRIOR_BASELINE = 0.05  # length and direction of the baseline, as a share of its length
PRIOR_TILT = 0.02  # the baseline's tilt out of the detector's plane, as a share of its length


def prior_errors(nominal: Geometry) -> F64:
    """Errors (6,) of a bench's nominal geometry, 1 sigma, mm, in the order of `PARAMETERS`."""
    length = float(np.hypot(nominal.baseline_x, nominal.baseline_y))
    plane = [PRIOR_CENTRE_MM, PRIOR_CENTRE_MM, PRIOR_DISTANCE * nominal.distance]
    return np.array([*plane, PRIOR_BASELINE * length, PRIOR_BASELINE * length, PRIOR_TILT * length])


@dataclass(frozen=True)
class Hyperbolic(FringeShape):
    """Phase ``phase0 + 2 pi / lambda (|r - s_A| - |r - s_B|)``."""

    linear: ClassVar[bool] = False

    phase0: float
    geometry: Geometry  # present positions, from pixel (0, 0) of the window
    # (6,) nominal values of the geometry's parameters, mm, in the order of
    # `pixcal.kernels.optics.PARAMETERS`
    nominal: tuple[float, ...]
    # (6,) their prior errors, mm; coefficients are counted in these
    sigma: tuple[float, ...]
    reference: tuple[float, float]  # point (y, x) where the phase is `phase0`, px

    @classmethod
    def start(cls, start: Start) -> Self:
        """Fit to the phases and slopes of the tiles, with the priors."""
        nominal = start.nominal
        # The measured fringe vector gives the baseline over the distance at once.
        per_mm = nominal.wavenumber * nominal.pitch / nominal.distance
        first = nominal.vector()
        first[3:5] = np.array(start.k) / per_mm
        known = tuple(nominal.vector()), tuple(prior_errors(nominal))
        shape = cls(0.0, nominal.with_vector(first), *known, start.reference)
        return shape._fit_planes(start)

    def _fit_planes(self, start: Start) -> Self:
        planes = [p for p in start.planes if np.isfinite(p.sigma)]
        if not planes:
            return self
        ry, rx = start.reference
        y, x = np.array([p.centre for p in planes]).T
        values = np.array([p.phase for p in planes])
        values = values + start.k[0] * (x - rx) + start.k[1] * (y - ry)
        slopes = np.array([[start.k[0] + p.kx, start.k[1] + p.ky] for p in planes])
        # True offsets scatter the tiles' phases more than noise does: some 1e-3 rad, and the
        # slope over a tile of some 100 px accordingly.
        error = 1e-3 + np.array([p.sigma for p in planes])
        nominal, sigma = np.array(self.nominal), np.array(self.sigma)
        base = (self.geometry.vector() - nominal) / sigma

        def residual(c: F64) -> F64:
            geometry = self.geometry.with_vector(nominal + c[1:] * sigma)
            off = (c[0] + self._relative(geometry, y, x) - values) / error
            turned = (np.array(fringe_vector(x, y, geometry)) - slopes.T) / (error / 20)
            return np.concatenate([off, *turned, c[1:]])

        middle = int(np.argmin((y - ry) ** 2 + (x - rx) ** 2))
        offset = values[middle] - float(self._relative(self.geometry, y[middle], x[middle]))
        solution = least_squares(
            residual, np.concatenate([[offset], base]), x_scale="jac", xtol=1e-14, ftol=1e-14
        ).x
        return replace(
            self,
            phase0=float(solution[0]),
            geometry=self.geometry.with_vector(nominal + solution[1:] * sigma),
        )

    def _relative(self, geometry: Geometry, y: F64, x: F64) -> F64:
        ry, rx = self.reference
        return np.asarray(phase(x, y, geometry) - phase(rx, ry, geometry))

    @property
    def names(self) -> tuple[str, ...]:
        """Piston and the derivatives with respect to the fibres' positions."""
        return ("1", *(f"d psi / d {name}" for name in PARAMETERS))

    @property
    def precision(self) -> F64:
        """One for each parameter of the geometry (in units of its prior), zero for the piston."""
        return np.array([0.0] + [1.0] * len(PARAMETERS))

    def phase(self, y: F64, x: F64) -> F64:
        return np.asarray(self.phase0 + self._relative(self.geometry, y, x))

    def modes(self, y: F64, x: F64) -> F64:
        """Derivatives by the piston and by each parameter in units of its prior error."""
        ry, rx = self.reference
        y, x = np.broadcast_arrays(y, x)
        jacobian = phase_jacobian(x, y, self.geometry) - phase_jacobian(rx, ry, self.geometry)
        scaled = np.moveaxis(jacobian * np.array(self.sigma), -1, 0)
        return np.concatenate([np.ones((1, *y.shape)), scaled])

    @property
    def prior_offset(self) -> F64:
        """Present coefficients counted from the nominal values."""
        away = (self.geometry.vector() - np.array(self.nominal)) / np.array(self.sigma)
        return np.concatenate([[0.0], away])

    def moved(self, step: F64) -> Self:
        values = self.geometry.vector() + np.asarray(step[1:]) * np.array(self.sigma)
        return replace(
            self, phase0=self.phase0 + float(step[0]), geometry=self.geometry.with_vector(values)
        )

    def vector(self, y: float, x: float) -> tuple[float, float]:
        kx, ky = fringe_vector(x, y, self.geometry)
        return float(kx), float(ky)

    def facts(self, covariance: F64) -> dict[str, Any]:
        """Fibre positions (mm) and their errors, prior included."""
        sigma = np.sqrt(np.maximum(np.diag(covariance)[1:], 0)) * np.array(self.sigma)
        values = self.geometry.vector()
        facts: dict[str, Any] = {}
        for n, name in enumerate(PARAMETERS):
            facts[f"{name}_mm"] = float(values[n])
            facts[f"{name}_sigma_mm"] = float(sigma[n])
            facts[f"{name}_nominal_mm"] = float(self.nominal[n])
        return facts


SHAPE = Hyperbolic
