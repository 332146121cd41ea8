"""Least squares of the modes that the data cannot tell from the bench, over tiles.

Sums of each tile are taken by themselves and added in the order of the tiles, so that the result
is the same however the work was shared out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringes import grid
from pixcal.estimators.gauge import FRINGE_MODES, fringe_modes
from pixcal.estimators.geometry import TilePlane
from pixcal.estimators.models import FringeShape

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class ModeBasis:
    """The modes of a set's phase map: those of the fringes' shape, then those of the gauge.

    Attributes
    ----------
    shape : FringeShape
        Present shape of the fringes.
    k : (float, float)
        Carrier (kx, ky), rad/px, that measured phases are relative to.
    reference : (float, float)
        Point (y, x) where the carrier's phase is zero.
    """

    shape: FringeShape
    k: tuple[float, float]
    reference: tuple[float, float]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the modes, in the order of `on`."""
        return (*self.shape.names, *FRINGE_MODES)

    def on(self, plane: TilePlane, size: tuple[int, int]) -> tuple[F64, F64]:
        """The modes (mode, y, x) on a tile, and the shape's phase relative to the carrier (y, x).

        Parameters
        ----------
        plane : TilePlane
            Smooth phase of the tile relative to the carrier.
        size : (int, int)
            Of the tile.
        """
        y, x = grid(size)
        y, x = y + plane.centre[0], x + plane.centre[1]
        carrier = self.k[0] * (x - self.reference[1]) + self.k[1] * (y - self.reference[0])
        gauge = fringe_modes(carrier + plane.on(size), np.asarray(plane.ratio))
        modes = np.concatenate([self.shape.modes(y, x), np.stack(gauge)])
        return modes, self.shape.phase(y, x) - carrier

    def solve(self, normal: F64, right: F64, spread: float) -> F64:
        """Coefficients (mode, n) of maps from their sums, with what the shape knows beforehand.

        Parameters
        ----------
        normal : (mode, mode) float64
        right : (mode, n) float64
            The first map is the whole run's; the prior's offset acts on it alone, the others are
            differences from it.
        spread : float
            Variance of the map over that of its noise: true offsets act as noise here.
        """
        precision = self._precision(spread)
        offset = np.zeros(len(precision))
        offset[: len(self.shape.names)] = self.shape.prior_offset
        right = right.copy()
        right[:, 0] -= precision * offset
        return solve_modes(normal + np.diag(precision), right)

    def covariance(self, normal: F64, spread: float) -> F64:
        """Covariance of the coefficients."""
        n = normal / spread + np.diag(self._precision(1.0))
        scale = _scales(n)
        return np.asarray(np.linalg.pinv(n / np.outer(scale, scale)) / np.outer(scale, scale))

    def _precision(self, spread: float) -> F64:
        known = self.shape.precision * spread
        return np.concatenate([known, np.zeros(len(FRINGE_MODES))])


def mode_sums(modes: F64, weight: F64, maps: F64) -> tuple[F64, F64]:
    """Normal matrix (mode, mode) and right-hand sides (mode, n) of maps (n, y, x) on a tile.

    Parameters
    ----------
    modes : (mode, y, x) float64
    weight : (y, x) float64
        Zero where a pixel must not count.
    maps : (n, y, x) float64
        Finite wherever ``weight`` is not zero.
    """
    flat = modes.reshape(len(modes), -1)
    weighted = flat * weight.ravel()
    values = np.where(weight.ravel() > 0, maps.reshape(len(maps), -1), 0.0)
    return weighted @ flat.T, weighted @ values.T


def _scales(normal: F64) -> F64:
    """Size of each mode; 1 for one that is zero all over the window (y on a single row)."""
    size = np.sqrt(np.maximum(np.diag(normal), 0.0))
    return np.where(size > 0, size, 1.0)


def solve_modes(normal: F64, right: F64) -> F64:
    """Coefficients (mode, n); modes that the window cannot tell apart share what they explain."""
    scale = _scales(normal)
    unit = normal / np.outer(scale, scale)
    return np.asarray(
        np.linalg.lstsq(unit, right / scale[:, None], rcond=1e-12)[0] / scale[:, None]
    )
