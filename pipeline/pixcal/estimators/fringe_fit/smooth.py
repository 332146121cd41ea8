"""A smooth surface of any shape: what the map holds at large scales, whatever its cause."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.fringe_fit.fringes import monomials
from pixcal.estimators.fringe_fit.models import FringeShape, Start
from pixcal.estimators.fringe_fit.tile_sums import DEGREE, POWERS
from pixcal.model.arrays import F64


@dataclass(frozen=True)
class Polynomial(FringeShape):
    """Carrier plus a polynomial of `DEGREE`, without physics, by which other shapes are judged."""

    coefficients: tuple[float, ...]
    k: tuple[float, float]
    reference: tuple[float, float]
    scale: float

    @classmethod
    def start(cls, start: Start) -> Self:
        """The carrier alone."""
        return cls((0.0,) * len(POWERS), start.k, start.reference, start.scale)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"x^{i} y^{j}" for i, j in POWERS)

    def phase(self, y: F64, x: F64) -> F64:
        ry, rx = self.reference
        carrier = self.k[0] * (x - rx) + self.k[1] * (y - ry)
        return np.asarray(carrier + np.tensordot(self.coefficients, self.modes(y, x), 1))

    def modes(self, y: F64, x: F64) -> F64:
        """The powers, on the scale of the window."""
        ry, rx = self.reference
        return monomials((y - ry) / self.scale, (x - rx) / self.scale, DEGREE)

    def moved(self, step: F64) -> Self:
        moved = tuple(float(a + b) for a, b in zip(self.coefficients, step, strict=True))
        return replace(self, coefficients=moved)

    def vector(self, y: float, x: float) -> tuple[float, float]:
        return self.k
