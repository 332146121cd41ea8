"""Pixels of a tile by weighted least squares, the frames being known."""

from collections.abc import Sequence

import numpy as np

from pixcal.estimators.fringe_fit.fringes import FrameParameters, SmoothPhasor, smooth_phasor
from pixcal.estimators.fringe_fit.tile import Coding, Tile
from pixcal.kernels.bilinear import N_SUMS, solve_pixels, sweep_block
from pixcal.model.arrays import C128, F32, F64, U16


def residual_chi2(
    tile: Tile,
    codes: U16,
    coding: Coding,
    frames: FrameParameters,
    theta: F64,
) -> float:
    """Median over a tile's pixels of the reduced chi-square."""
    sums = accumulate(tile, [codes], coding, frames, theta.astype(np.float32))
    _, _, chi2 = solve_pixels(sums)
    reduced = chi2 / np.maximum(sums[10] - 3, 1)
    return float(np.median(reduced[tile.good]))


def accumulate(
    tile: Tile,
    blocks: Sequence[U16],
    coding: Coding,
    frames: FrameParameters,
    theta: F32,
    sums: F64 | None = None,
    variance: tuple[F32, F32] | None = None,
) -> F64:
    """Weighted sums of a tile over blocks of frames that follow one another.

    Parameters
    ----------
    blocks : sequence of (t, y, x) arrays
        Stored codes; together as many frames as ``frames`` holds.
    theta : (3, y, x) float32
        Start model.
    sums : (N_SUMS, y, x) float64, optional
        Sums to add to.
    variance : (read, shot), optional
        Instead of the tile's own.
    """
    sums = np.zeros((N_SUMS, *tile.shape)) if sums is None else sums
    read, shot = variance or (tile.read, tile.shot)
    g = frames.at(*tile.centre).astype(np.float32)
    dk = frames.dk.astype(np.float32)
    start = 0
    for block in blocks:
        for first in range(0, len(block), 64):
            part = block[first : first + 64]
            at = slice(start + first, start + first + len(part))
            sweep_block(
                part,
                coding.scale,
                coding.offset,
                coding.fill,
                g[at],
                dk[at],
                -(tile.shape[0] - 1) / 2,
                -(tile.shape[1] - 1) / 2,
                theta,
                read,
                shot,
                sums,
            )
        start += len(block)
    return sums


def start_model(
    tile: Tile,
    blocks: Sequence[U16],
    coding: Coding,
    frames: FrameParameters,
    k: tuple[float, float],
    start: F64 | None = None,
) -> tuple[F32, SmoothPhasor]:
    """Smooth model (3, y, x) of a tile, for weights that do not know the pixel's own noise.

    The phase and the visibility are smooth over the tile; the level is the pixel's own, known to a
    part in a thousand, and only scales all the weights of that pixel together. With it the smooth
    alpha exp(i psi) / iota.

    Parameters
    ----------
    tile, blocks, coding, frames
        As in `accumulate`.
    k : (float, float)
        Fringe vector near the tile, rad/px.
    start : (3, y, x) float64, optional
        The pixels as they are known; else from an unweighted fit.
    """
    theta = _unweighted_pixels(tile, blocks, coding, frames) if start is None else start
    iota = theta[0]
    usable = np.isfinite(iota) & (iota > 0)
    good = tile.good & usable
    level = float(np.median(iota[good])) if good.any() else 1.0
    iota = np.where(usable, iota, level)
    phasor = np.asarray(np.where(usable, theta[2] + 1j * theta[1], 0.0) / iota, complex)
    smooth = smooth_phasor(phasor, good, k)
    model = np.stack([iota, iota * smooth.map.imag, iota * smooth.map.real])
    return model.astype(np.float32), smooth


def _unweighted_pixels(
    tile: Tile, blocks: Sequence[U16], coding: Coding, frames: FrameParameters
) -> F64:
    """Pixels (3, y, x) by least squares in which all samples count alike."""
    nothing = np.zeros((3, *tile.shape), np.float32)
    even = (np.ones(tile.shape, np.float32), np.zeros(tile.shape, np.float32))
    return solve_pixels(accumulate(tile, blocks, coding, frames, nothing, variance=even))[0]


def fit_tile(
    tile: Tile,
    blocks: Sequence[U16],
    coding: Coding,
    frames: FrameParameters,
    k: tuple[float, float],
    start: F64 | None = None,
) -> tuple[F64, C128]:
    """Weighted fit of every pixel of a tile: theta (3, y, x) and the smooth phasor (y, x)."""
    model, smooth = start_model(tile, blocks, coding, frames, k, start)
    sums = accumulate(tile, blocks, coding, frames, model)
    step, _, _ = solve_pixels(sums)
    return model + step, smooth.map
