"""Pixels of a tile by weighted least squares, for known frames."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from pixcal.estimators.fringe_fit.fringes import FrameParameters, SmoothPhasor, smooth_phasor
from pixcal.kernels.bilinear import GAP, GOES_ON, N_SUMS, solve_pixels, sweep_batches
from pixcal.kernels.medians import median
from pixcal.model.arrays import F32, F64, U16, Mask

MOST_FRAMES = 64  # summed in float32


class Coding(NamedTuple):
    """Electrons of a code: ``scale * code + offset``; ``fill`` marks a sample without weight."""

    scale: float
    offset: float
    fill: int

    def electrons(self, codes: U16) -> F32:
        """Electrons of codes, as float32 numbers."""
        charge = codes * np.float32(self.scale)
        charge += np.float32(self.offset)
        return charge


@dataclass
class Tile:
    """A part of the window."""

    y: tuple[int, int]  # y, x: first pixel and the one after the last, along each axis
    x: tuple[int, int]
    read: F32  # read, shot: (y, x) variance of a sample: `shot * model + read` (e-²)
    shot: F32
    good: Mask  # (y, x) pixels to use

    @property
    def shape(self) -> tuple[int, int]:
        """(y, x) size."""
        return self.y[1] - self.y[0], self.x[1] - self.x[0]

    @property
    def centre(self) -> tuple[float, float]:
        """Centre (y, x) in pixels of the window."""
        return (self.y[0] + self.y[1] - 1) / 2, (self.x[0] + self.x[1] - 1) / 2


class PixelSums:
    """Sums that grow block by block about a start model, of the run and of batches of its frames.

    ``model``: (3, y, x) start. ``ranges``: first and end frame of each batch. ``turn, sigma``:
    (batch, y, x) phases relative to the start model and their errors, rad; NaN in gaps.
    """

    def __init__(
        self,
        tile: Tile,
        coding: Coding,
        frames: FrameParameters,
        model: F32,
        ranges: Sequence[tuple[int, int]] = (),
    ) -> None:
        ny, nx = tile.shape
        self.model, self.position = model, 0
        # The first pixel relative to the tile's centre, where the frames' parameters hold.
        self._fixed = (-(ny - 1) / 2, -(nx - 1) / 2, model, tile.read, tile.shot)
        self._coding = coding
        self._g, self._dk = (f.astype(np.float32) for f in (frames.at(*tile.centre), frames.dk))
        self._part, self._total = np.zeros((2, ny, N_SUMS, nx))
        self.turn, self.sigma = np.full((2, len(ranges), ny, nx), np.nan, np.float32)
        # Sums are cut at the ends of batches, and where one begins after a gap.
        self._cuts = {a: GAP for a, b in ranges if b > a}
        self._cuts |= {b: n for n, (a, b) in enumerate(ranges) if b > a}

    def add(self, codes: U16) -> None:
        """Add the codes (t, y, x) of the frames that follow."""
        first, last = self.position, self.position + len(codes)
        inside = {c - first for c in self._cuts if first < c < last}
        stops = sorted(inside | {*range(MOST_FRAMES, len(codes), MOST_FRAMES), len(codes)})
        closes = [self._cuts.get(first + stop, GOES_ON) for stop in stops]
        sweep_batches(
            codes,
            *self._coding,
            self._g[first:last],
            self._dk[first:last],
            *self._fixed,
            np.array(stops),
            np.array(closes),
            self._part,
            self._total,
            self.turn,
            self.sigma,
        )
        self.position = last

    @property
    def sums(self) -> F64:
        """Sums of all frames so far (N_SUMS, y, x), for `solve_pixels`."""
        return np.moveaxis(self._total + self._part, 1, 0)

    def finish(self) -> tuple[F64, F64, F64, F64]:
        """End the run: theta (3, y, x); phase errors, chi-square and samples, each (y, x)."""
        sums = self.sums
        step, covariance, chi2 = solve_pixels(sums)
        theta = self.model + step
        return theta, phase_sigma(theta, covariance), chi2, sums[10]


def phase_sigma(theta: F64, covariance: F64) -> F64:
    """Error of the phase (rad) from the covariance (6, ...) of theta (3, ...)."""
    _, s, c = theta
    _, _, _, v11, v12, v22 = covariance
    with np.errstate(divide="ignore", invalid="ignore"):
        variance = (c * c * v11 - 2 * c * s * v12 + s * s * v22) / (s * s + c * c) ** 2
        return np.asarray(np.sqrt(variance))


def accumulate(
    tile: Tile, blocks: Sequence[U16], coding: Coding, frames: FrameParameters, theta: F32
) -> F64:
    """Sums (N_SUMS, y, x) of a tile over all blocks of codes (t, y, x), in the order of time."""
    sums = PixelSums(tile, coding, frames, theta)
    for block in blocks:
        sums.add(block)
    return sums.sums


def start_model(
    tile: Tile,
    blocks: Sequence[U16],
    coding: Coding,
    frames: FrameParameters,
    k: tuple[float, float],
    start: F64 | None = None,
) -> tuple[F32, SmoothPhasor]:
    """Smooth model (3, y, x) of a tile, for weights free of the pixel's own noise; its phasor.

    Phase and visibility are smooth over the tile; the level is the pixel's own. ``k``: near fringe
    vector, rad/px. ``start``: (3, y, x) pixels if known; else from an unweighted fit.
    """
    theta = start
    if theta is None:
        nothing = np.zeros((3, *tile.shape), np.float32)
        even = replace(tile, read=nothing[0] + 1, shot=nothing[0])
        theta = solve_pixels(accumulate(even, blocks, coding, frames, nothing))[0]
    iota = theta[0]
    usable = np.isfinite(iota) & (iota > 0)
    good = tile.good & usable
    level = median(iota[good]) if good.any() else 1.0
    iota = np.where(usable, iota, level)
    phasor = np.asarray(np.where(usable, theta[2] + 1j * theta[1], 0.0) / iota, complex)
    smooth = smooth_phasor(phasor, good, k)
    model = np.stack([iota, iota * smooth.map.imag, iota * smooth.map.real])
    return model.astype(np.float32), smooth
