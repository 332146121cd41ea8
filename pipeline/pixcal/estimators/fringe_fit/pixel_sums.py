"""Weighted sums of a tile's pixels: the whole run's and the present batch's.

Two ways to the same estimate. Where fringe vector and visibility are steady, weights depend on the
phase alone and the normal matrices come from the frames (`harmonics`): three sums
a sample. Where one of them moves too much, every sum is taken sample by sample.
"""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.fringes import FrameParameters
from pixcal.estimators.fringe_fit.harmonics import (
    PhaseWeights,
    normal_matrices,
    normal_table,
)
from pixcal.estimators.fringe_fit.tile import Coding, Tile
from pixcal.estimators.fringe_fit.tile_fit import accumulate
from pixcal.kernels.bilinear import N_SUMS, solve_pixels
from pixcal.kernels.fringe_sums import close_fringes, fringe_block, turn_table

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

# motion of the phase between a tile's centre and its corner (rad, rms) that may be left out: far
# below the noise of a sample, some 1e-2 rad
STILL = 3e-4
# phases tabulated for the normal matrices of a batch, whose error is larger than the run's
BATCH_TABLE = 1024
# scatter of the visibility that the weights may leave out: it costs 0.5 % of the error at most
# (measured: 0.7 to 1.3 % at 0.05)
STEADY = 0.03


class PixelSums(Protocol):
    """Sums that grow block by block."""

    def add(self, codes: NDArray[np.uint16], at: slice) -> None:
        """Add the codes (t, y, x) of the frames ``at``."""

    def close(self) -> tuple[F32, F32]:
        """End the batch: its phase relative to the start model and the error, each (y, x), rad.

        Its sums go to the run's.
        """

    def finish(self) -> tuple[F64, F64, F64, F64]:
        """End the run: theta (3, y, x); phase errors, chi-square and samples, each (y, x)."""


def pixel_sums(
    tile: Tile, coding: Coding, frames: FrameParameters, model: F32, smooth: C128
) -> PixelSums:
    """The faster sums that the motion of the fringes allows.

    Parameters
    ----------
    tile, coding, frames
        As in `pixcal.estimators.fringe_fit.tile_fit.accumulate`.
    model : (3, y, x) float32
        Start model.
    smooth : (y, x) complex128
        Smooth phasor alpha exp(i psi) / iota of the start model.
    """
    reach = np.hypot(*tile.shape) / 2
    motion = np.sqrt((frames.dk**2).sum(axis=1).mean()) * reach
    visibility = frames.A / np.maximum(frames.B, 1e-30)
    if motion < STILL and visibility.std() < STEADY * visibility.mean() and frames.B.min() > 0.01:
        return FringeSums(tile, coding, frames, model, smooth)
    return SampleSums(tile, coding, frames, model)


class SampleSums:
    """Every sum taken sample by sample, with the weights of the full noise model."""

    def __init__(self, tile: Tile, coding: Coding, frames: FrameParameters, model: F32) -> None:
        self.tile, self.coding, self.frames, self.model = tile, coding, frames, model
        self.total: F64 = np.zeros((N_SUMS, *tile.shape))
        self.part: F64 = np.zeros((N_SUMS, *tile.shape))

    def add(self, codes: NDArray[np.uint16], at: slice) -> None:
        """As in `PixelSums`."""
        part = FrameParameters(self.frames.g[at], self.frames.dk[at], self.frames.reference)
        accumulate(self.tile, [codes], self.coding, part, self.model, self.part)

    def close(self) -> tuple[F32, F32]:
        """As in `PixelSums`."""
        step, covariance, _ = solve_pixels(self.part)
        self.total += self.part
        self.part[:] = 0
        theta = self.model + step
        turn = np.angle((theta[2] + 1j * theta[1]) * (self.model[2] - 1j * self.model[1]))
        return turn.astype(np.float32), phase_sigma(theta, covariance).astype(np.float32)

    def finish(self) -> tuple[F64, F64, F64, F64]:
        """As in `PixelSums`."""
        self.total += self.part
        step, covariance, chi2 = solve_pixels(self.total)
        theta = self.model + step
        return theta, phase_sigma(theta, covariance), chi2, self.total[10]


class FringeSums:
    """Three sums a sample; the normal matrices from the frames."""

    def __init__(
        self, tile: Tile, coding: Coding, frames: FrameParameters, model: F32, smooth: C128
    ) -> None:
        self.coding, self.shape = coding, tile.shape
        self.moments = frames.moments_at(*tile.centre)
        level = np.maximum(model[0], 1e-6).ravel()
        scale = tile.shot.ravel() * level
        good = tile.good.ravel()
        ratio = tile.read.ravel() / scale
        visibility = np.maximum(np.abs(smooth).ravel(), 1e-30)
        typical = (float(np.median(v[good])) if good.any() else 1.0 for v in (visibility, ratio))
        self.weights = PhaseWeights.of(*typical)
        self.series = self.weights.series(1)
        self.excess = ratio - self.weights.rho
        # Variance of a sample over the weights' own, the mean over phases.
        self.spread = (scale * (1 + self.excess * self.series[0].real)).astype(np.float32)
        self.level, self.scale = level, scale
        self.psi = np.angle(smooth).ravel().astype(np.float32)
        self.place = np.remainder(self.psi / np.float32(2 * np.pi), np.float32(1))
        # One visibility for the tile, so that the normal matrix depends on the phase alone.
        unit = smooth.ravel() * (self.weights.visibility / visibility)
        self.s, self.c = unit.imag.astype(np.float32), unit.real.astype(np.float32)
        self.at: list[slice] = []
        self.parts: list[slice] = []
        n = level.size
        self.part, self.lost, self.any_lost = np.zeros((4, n)), np.zeros((7, n)), False
        self.total, self.total_lost = np.zeros((4, n)), np.zeros((7, n))

    def add(self, codes: NDArray[np.uint16], at: slice) -> None:
        """As in `PixelSums`."""
        flat = codes.reshape(len(codes), -1)
        for first in range(0, len(codes), 64):
            now = slice(at.start + first, min(at.start + first + 64, at.stop))
            self.any_lost |= fringe_block(
                flat[first : first + 64], self.coding.scale, self.coding.offset, self.coding.fill,
                self.moments.rows[now], self.weights.rho, self.level, self.s, self.c,
                self.part, self.lost,
            )  # fmt: skip
        self.at.append(at)

    def _end_part(self) -> slice | None:
        """Frames since the last cut, which follow one another; they are the run's from now on."""
        if not self.at:
            return None
        part = slice(self.at[0].start, self.at[-1].stop)
        self.at = []
        self.parts.append(part)
        return part

    def close(self) -> tuple[F32, F32]:
        """As in `PixelSums`."""
        if (part := self._end_part()) is None:
            nothing = np.full(self.shape, np.nan, np.float32)
            return nothing, nothing
        turn, sigma = (np.empty(self.level.size, np.float32) for _ in range(2))
        normal = normal_table(self.moments.sums(part), self.series, BATCH_TABLE)
        close_fringes(
            normal, turn_table(normal), self.place, self.level, self.weights.visibility, self.part,
            self.lost, self.any_lost, self.spread, self.total, turn, sigma,
        )  # fmt: skip
        if self.any_lost:
            self.total_lost += self.lost
            self.lost[:], self.any_lost = 0, False
        return turn.reshape(self.shape), sigma.reshape(self.shape)

    def finish(self) -> tuple[F64, F64, F64, F64]:
        """As in `PixelSums`."""
        self._end_part()
        self.total += self.part
        self.total_lost += self.lost
        psi = self.psi.astype(float)
        frame_sums = np.sum([self.moments.sums(part) for part in self.parts], axis=0)
        normal = normal_matrices(frame_sums, self.series, psi) - self.total_lost[:6]
        count = len(self.moments.rows) - self.total_lost[6]
        step, inverse, square = solve_pixels(np.concatenate([normal, self.total]))
        theta = self.level * np.stack([np.ones_like(self.s), self.s, self.c]) + step
        # The samples' variance is scale * (1 / w + excess): what exceeds the weights' own goes
        # through the estimate as it is, N^-1 (N + excess N2) N^-1.
        squared = normal_matrices(frame_sums, self.weights.series(2), psi)
        variance = phase_variance(theta, inverse) + self.excess * phase_variance(
            theta, inverse, squared
        )
        with np.errstate(invalid="ignore"):
            sigma = np.sqrt(variance * self.scale)
        ny, nx = self.shape
        sigma, chi2, count = (v.reshape(ny, nx) for v in (sigma, square / self.spread, count))
        return theta.reshape(3, ny, nx), sigma, chi2, count


def phase_variance(theta: F64, inverse: F64, middle: F64 | None = None) -> F64:
    """Variance of the phase from that of theta.

    Parameters
    ----------
    theta : (3, ...) float64
    inverse : (6, ...) float64
        Inverse normal matrix, upper triangle, as from `pixcal.kernels.bilinear.solve_pixels`.
    middle : (6, ...) float64, optional
        Matrix M of ``inverse M inverse``; without it the covariance is ``inverse`` itself.
    """
    s, c = theta[1], theta[2]
    with np.errstate(divide="ignore", invalid="ignore"):
        u1, u2 = c / (s * s + c * c), -s / (s * s + c * c)
    v0 = inverse[1] * u1 + inverse[2] * u2
    v1 = inverse[3] * u1 + inverse[4] * u2
    v2 = inverse[4] * u1 + inverse[5] * u2
    if middle is None:
        return np.asarray(u1 * v1 + u2 * v2)
    m = middle
    return np.asarray(
        m[0] * v0 * v0 + m[3] * v1 * v1 + m[5] * v2 * v2
        + 2 * (m[1] * v0 * v1 + m[2] * v0 * v2 + m[4] * v1 * v2)
    )  # fmt: skip


def phase_sigma(theta: F64, covariance: F64) -> F64:
    """Error of the phase (rad) from the covariance (6, ...) of theta (3, ...)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt(phase_variance(theta, covariance)))
