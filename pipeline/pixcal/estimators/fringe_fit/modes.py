"""Least squares of the modes that are degenerate with the bench, from the sums of tiles.

Sums are made tile by tile and added in the order of the tiles, so that the result does not depend
on how the work was distributed.
"""

from dataclasses import dataclass

import numpy as np

from pixcal.estimators.fringe_fit import tile_sums
from pixcal.estimators.fringe_fit.gauge import FRINGE_MODES
from pixcal.estimators.fringe_fit.shapes import FringeShape
from pixcal.estimators.fringe_fit.tile_sums import N_LOCAL, POWERS, Carrier, TilePlane, TileSums
from pixcal.kernels.normal_matrix import inverse_normal, root_diagonal
from pixcal.model.arrays import F64

TILES_AT_ONCE = 256  # tiles whose modes are in memory at the same time


@dataclass(frozen=True)
class ModeBasis:
    """Modes of a set's phase map: modes of the fringes' shape, then of the gauge."""

    shape: FringeShape  # present shape of the fringes
    carrier: Carrier  # reference of the measured phases

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the modes."""
        return (*self.shape.names, *FRINGE_MODES)

    def _local(self, planes: list[TilePlane]) -> tuple[F64, F64]:
        """Modes (tile, mode, local) and phase (tile, local) relative to each tile's plane."""
        centres = np.array([p.centre for p in planes])
        n_poly, n_own = len(POWERS), len(self.shape.names)
        modes = np.zeros((len(planes), len(self.names), N_LOCAL))
        modes[:, :n_own, :n_poly] = tile_sums.expand(self.shape.modes, centres)
        modes[:, n_own:, n_poly:] = np.eye(len(FRINGE_MODES))
        phase = np.zeros((len(planes), N_LOCAL))
        phase[:, :n_poly] = tile_sums.expand(
            lambda y, x: self.shape.phase(y, x) - self.carrier.phase(y, x), centres
        )
        at = {p: n for n, p in enumerate(POWERS)}
        phase[:, at[0, 0]] -= [p.phase for p in planes]
        phase[:, at[1, 0]] -= [p.kx * tile_sums.SCALE_PX for p in planes]
        phase[:, at[0, 1]] -= [p.ky * tile_sums.SCALE_PX for p in planes]
        return modes, phase

    def sums(self, tiles: TileSums) -> tuple[F64, F64, float]:
        """Normal matrix, right sides (mode, 1 + batch), square of phases less the shape."""
        size = len(self.names)
        normal, rights = np.zeros((size, size)), np.zeros((size, tiles.right.shape[2]))
        square = 0.0
        # A limited number of tiles at a time, because their modes take much memory.
        for first in range(0, len(tiles.planes), TILES_AT_ONCE):
            part = slice(first, first + TILES_AT_ONCE)
            modes, phase = self._local(tiles.planes[part])
            right = tiles.right[part].copy()
            moved = np.einsum("tij,tj->ti", tiles.normal[part], phase)
            square += float((phase * (moved - 2 * right[:, :, 0])).sum())
            square += float(tiles.square[part].sum())
            right[:, :, 0] -= moved
            normal += np.einsum("tmi,tni->mn", modes @ tiles.normal[part], modes)
            rights += np.einsum("tmi,tib->mb", modes, right)
        return normal, rights, square

    def removed(self, planes: list[TilePlane], coefficients: F64) -> F64:
        """Phase to subtract from each tile, in its local modes: (tile, local, 1 + batch).

        ``coefficients``: (mode, 1 + batch) of the run relative to the shape, of batches to the run.
        """
        removed = np.empty((len(planes), N_LOCAL, coefficients.shape[1]))
        for first in range(0, len(planes), TILES_AT_ONCE):
            part = slice(first, first + TILES_AT_ONCE)
            modes, phase = self._local(planes[part])
            removed[part] = np.einsum("tmi,mb->tib", modes, coefficients)
            removed[part, :, 0] += phase
        return removed

    def solve(self, normal: F64, right: F64, spread: float) -> F64:
        """Coefficients (mode, n) of maps from their sums, with the shape's prior for the first map.

        ``spread``: variance of the map over that of its noise, as true offsets act as noise here.
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
        return inverse_normal(n, 1e-15)

    def _precision(self, spread: float) -> F64:
        known = self.shape.precision * spread
        return np.concatenate([known, np.zeros(len(FRINGE_MODES))])


def solve_modes(normal: F64, right: F64) -> F64:
    """Coefficients (mode, n) of minimum norm, for modes that are degenerate in the window."""
    scale = root_diagonal(normal)
    unit = normal / np.outer(scale, scale)
    return np.asarray(
        np.linalg.lstsq(unit, right / scale[:, None], rcond=1e-12)[0] / scale[:, None]
    )
