"""Shapes of the fringes over the window, one file each; found by `fringe_models`.

Offsets are measured relative to a shape: a phase with a few parameters, whose derivatives are modes
that the offsets cannot contain. A new one is a file with a subclass of `FringeShape` and a
module-level ``SHAPE`` naming it.
"""

import importlib
import pkgutil
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar, Self

import numpy as np

from pixcal.estimators.fringe_fit.fringes import monomials
from pixcal.estimators.fringe_fit.tile_sums import DEGREE, POWERS
from pixcal.kernels.optics import Geometry
from pixcal.model.arrays import F64


@dataclass(frozen=True)
class Start:
    """Input of a new shape."""

    k: tuple[float, float]  # measured fringe vector (kx, ky) at the reference, rad/px
    reference: tuple[float, float]  # point (y, x), px
    scale: float  # half the window's size, px
    # unwrapped `geometry.TilePlane` of every tile, relative to the carrier `k . (r - reference)`
    planes: Sequence[Any]
    nominal: Geometry  # of the bench, the fibres' centre before the reference


class FringeShape(ABC):
    """A shape with its present parameters."""

    # whether the phase is linear in the coefficients, so that one step is all
    linear: ClassVar[bool] = True

    @classmethod
    @abstractmethod
    def start(cls, start: Start) -> Self:
        """Parameters near enough for Gauss-Newton steps to converge."""

    @property
    @abstractmethod
    def names(self) -> tuple[str, ...]:
        """Names of the modes."""

    @property
    def precision(self) -> F64:
        """Prior: 1 / variance of the coefficient of each mode, zero without a prior."""
        return np.zeros(len(self.names))

    @property
    def prior_offset(self) -> F64:
        """Present coefficients, relative to the prior."""
        return np.zeros(len(self.names))

    @abstractmethod
    def phase(self, y: F64, x: F64) -> F64:
        """Phase (rad) at pixel coordinates that broadcast."""

    @abstractmethod
    def modes(self, y: F64, x: F64) -> F64:
        """Derivatives (mode, y, x) of the phase with respect to the coefficients."""

    @abstractmethod
    def moved(self, step: F64) -> Self:
        """The shape after a step of the coefficients."""

    @abstractmethod
    def vector(self, y: float, x: float) -> tuple[float, float]:
        """Local fringe vector (kx, ky), rad/px."""

    def axis(self, y: float, x: float) -> tuple[float, float]:
        """Unit vector (x, y) along which offsets are measured at a point."""
        kx, ky = self.vector(y, x)
        k = float(np.hypot(kx, ky))
        return kx / k, ky / k

    def facts(self, covariance: F64) -> dict[str, Any]:
        """Parameters with 1-sigma errors (from (mode, mode)) in natural units, for ``fit.json``."""
        return {}


def fringe_models() -> dict[str, type[FringeShape]]:
    """All shapes, by name."""
    shapes = {}
    for module in pkgutil.iter_modules(__path__):
        shape = getattr(importlib.import_module(f"{__name__}.{module.name}"), "SHAPE", None)
        if shape is not None:
            shapes[module.name] = shape
    return shapes


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
