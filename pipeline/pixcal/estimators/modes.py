"""Least squares of the modes that the data cannot tell from the bench, over tiles.

Sums of each tile are taken by themselves and added in the order of the tiles, so that the result
is the same however the work was shared out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringes import grid
from pixcal.estimators.gauge import MODES, fringe_modes
from pixcal.estimators.geometry import TilePlane

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class ModeBasis:
    """The modes of a set's phase map.

    Attributes
    ----------
    k : (float, float)
        Carrier (kx, ky), rad/px.
    reference : (float, float)
        Point (y, x) where the carrier's phase is zero.
    scale : float
        Length, px, that the linear modes are divided by.
    """

    k: tuple[float, float]
    reference: tuple[float, float]
    scale: float

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the modes, in the order of `on`."""
        return MODES

    def on(self, plane: TilePlane, shape: tuple[int, int]) -> F64:
        """The modes on a tile: (mode, y, x).

        Parameters
        ----------
        plane : TilePlane
            Smooth phase of the tile relative to the carrier.
        shape : (int, int)
            Of the tile.
        """
        y, x = grid(shape)
        y = y + plane.centre[0] - self.reference[0]
        x = x + plane.centre[1] - self.reference[1]
        psi = self.k[0] * x + self.k[1] * y + plane.on(shape)
        linear = [np.ones(shape), x / self.scale, y / self.scale]
        return np.stack(
            [
                np.broadcast_to(m, shape)
                for m in (*linear, *fringe_modes(psi, np.asarray(plane.ratio)))
            ]
        )


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


def solve_modes(normal: F64, right: F64) -> F64:
    """Coefficients (mode, n); modes that the window cannot tell apart share what they explain."""
    scale = np.sqrt(np.maximum(np.diag(normal), np.finfo(float).tiny))
    coefficients = np.linalg.lstsq(
        normal / np.outer(scale, scale), right / scale[:, None], rcond=1e-10
    )[0]
    return np.asarray(coefficients / scale[:, None])
