"""Weighted sums of a tile's pixels: the whole run's and the present batch's."""

import numpy as np

from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.tile import Coding, Tile
from pixcal.estimators.fringe_fit.tile_fit import accumulate
from pixcal.kernels.bilinear import N_SUMS, close_batch, solve_pixels
from pixcal.model.arrays import F32, F64, U16


class PixelSums:
    """Sums that grow block by block, about a start model (3, y, x)."""

    def __init__(self, tile: Tile, coding: Coding, frames: FrameParameters, model: F32) -> None:
        self.tile, self.coding, self.frames, self.model = tile, coding, frames, model
        self.total: F64 = np.zeros((N_SUMS, *tile.shape))
        self.part: F64 = np.zeros((N_SUMS, *tile.shape))

    def add(self, codes: U16, at: slice) -> None:
        """Add the codes (t, y, x) of the frames ``at``."""
        part = FrameParameters(self.frames.g[at], self.frames.dk[at], self.frames.reference)
        accumulate(self.tile, [codes], self.coding, part, self.model, self.part)

    def close(self) -> tuple[F32, F32]:
        """End the batch: its phase relative to the start model and the error, each (y, x), rad.

        Its sums go to the run's.
        """
        turn, sigma = np.empty((2, *self.tile.shape), np.float32)
        part, total = (a.reshape(N_SUMS, -1) for a in (self.part, self.total))
        close_batch(part, total, self.model.reshape(3, -1), turn.ravel(), sigma.ravel())
        return turn, sigma

    def finish(self) -> tuple[F64, F64, F64, F64]:
        """End the run: theta (3, y, x); phase errors, chi-square and samples, each (y, x)."""
        self.total += self.part
        step, covariance, chi2 = solve_pixels(self.total)
        theta = self.model + step
        return theta, phase_sigma(theta, covariance), chi2, self.total[10]


def phase_sigma(theta: F64, covariance: F64) -> F64:
    """Error of the phase (rad) from the covariance (6, ...) of theta (3, ...)."""
    _, s, c = theta
    _, _, _, v11, v12, v22 = covariance
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = (c * c * v11 - 2 * c * s * v12 + s * s * v22) / (s * s + c * c) ** 2
        return np.asarray(np.sqrt(variance))
