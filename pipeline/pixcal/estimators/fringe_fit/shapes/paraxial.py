"""Straight fringes: one fringe vector for the whole window (paper, equation 4)."""

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from pixcal.estimators.fringe_fit.shapes import FringeShape, Start
from pixcal.model.arrays import F64


@dataclass(frozen=True)
class Paraxial(FringeShape):
    """Phase ``phase0 + kx (x - x_ref) + ky (y - y_ref)``."""

    phase0: float
    kx: float
    ky: float
    reference: tuple[float, float]
    scale: float

    @classmethod
    def start(cls, start: Start) -> Self:
        """The carrier itself: the fit is linear from there."""
        return cls(0.0, *start.k, start.reference, start.scale)

    @property
    def names(self) -> tuple[str, ...]:
        return ("1", "x", "y")

    def phase(self, y: F64, x: F64) -> F64:
        ry, rx = self.reference
        return np.asarray(self.phase0 + self.kx * (x - rx) + self.ky * (y - ry))

    def modes(self, y: F64, x: F64) -> F64:
        """1, x and y, the last two on the scale of the window."""
        ry, rx = self.reference
        y, x = np.broadcast_arrays(y, x)
        return np.stack([np.ones(y.shape), (x - rx) / self.scale, (y - ry) / self.scale])

    def moved(self, step: F64) -> Self:
        return replace(
            self,
            phase0=self.phase0 + float(step[0]),
            kx=self.kx + float(step[1]) / self.scale,
            ky=self.ky + float(step[2]) / self.scale,
        )

    def vector(self, y: float, x: float) -> tuple[float, float]:
        return self.kx, self.ky

    def facts(self, covariance: F64) -> dict[str, Any]:
        sigma = np.sqrt(np.maximum(np.diag(covariance), 0)) / self.scale
        return {
            "kx_rad_per_px": self.kx,
            "ky_rad_per_px": self.ky,
            "kx_sigma": float(sigma[1]),
            "ky_sigma": float(sigma[2]),
        }


SHAPE = Paraxial
