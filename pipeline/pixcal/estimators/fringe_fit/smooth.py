"""A smooth surface of any shape: what the map holds at large scales, whatever its cause."""

from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from pixcal.estimators.fringe_fit.models import F64, Start

DEGREE = 5


@dataclass(frozen=True)
class Polynomial:
    """Carrier plus a polynomial of `DEGREE`: the yardstick by which other shapes are judged.

    It has no physics and is no model of the fringes; see `models.FringeShape`
    for its methods.
    """

    linear: ClassVar[bool] = True

    coefficients: tuple[float, ...]
    k: tuple[float, float]
    reference: tuple[float, float]
    scale: float

    @classmethod
    def start(cls, start: Start) -> Self:
        """The carrier alone."""
        return cls((0.0,) * len(_powers()), start.k, start.reference, start.scale)

    @property
    def names(self) -> tuple[str, ...]:
        """Powers of x and y."""
        return tuple(f"x^{i} y^{j}" for i, j in _powers())

    @property
    def precision(self) -> F64:
        """Nothing is known beforehand."""
        return np.zeros(len(self.coefficients))

    @property
    def prior_offset(self) -> F64:
        """Of no weight."""
        return np.zeros(len(self.coefficients))

    def phase(self, y: F64, x: F64) -> F64:
        """Phase (rad) at pixel coordinates."""
        ry, rx = self.reference
        carrier = self.k[0] * (x - rx) + self.k[1] * (y - ry)
        return np.asarray(carrier + np.tensordot(self.coefficients, self.modes(y, x), 1))

    def modes(self, y: F64, x: F64) -> F64:
        """The powers, on the scale of the window."""
        ry, rx = self.reference
        # Columns and rows are small: their powers cost nothing, the products all.
        xs = [np.asarray((x - rx) / self.scale) ** n for n in range(DEGREE + 1)]
        ys = [np.asarray((y - ry) / self.scale) ** n for n in range(DEGREE + 1)]
        return np.stack([xs[i] * ys[j] for i, j in _powers()])

    def moved(self, step: F64) -> Self:
        """The surface after a step."""
        moved = tuple(float(a + b) for a, b in zip(self.coefficients, step, strict=True))
        return type(self)(moved, self.k, self.reference, self.scale)

    def vector(self, y: float, x: float) -> tuple[float, float]:
        """The carrier's."""
        return self.k

    def facts(self, covariance: F64) -> dict[str, Any]:
        """None: it is never a result."""
        return {}


def _powers() -> list[tuple[int, int]]:
    return [(n - j, j) for n in range(DEGREE + 1) for j in range(n + 1)]
