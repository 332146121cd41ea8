"""The pass over the cube: parameters and errors of every pixel, also in every batch."""

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from pixcal.estimators.fringe_fit.fringes import FrameParameters, SmoothPhasor, plane_wave, wrapped
from pixcal.estimators.fringe_fit.tile_fit import Coding, PixelSums, Tile, start_model
from pixcal.model.arrays import F32, F64, I32, U16

DEFAULT_FRAMES = 500  # frames of a batch in a long run (paper, section 4.3)
MIN_FRAMES = 16  # fewest frames of a batch, in which each pixel has three unknowns
WANTED = 24  # batches wanted of a run too short for `DEFAULT_FRAMES`
# pixels of a tile for which the Cramér-Rao bound is computed, if there are few tiles
BOUND_PIXELS = 128


@dataclass(frozen=True)
class FrameBatches:
    """Batches of equal duration."""

    frames: int  # frames of a full batch
    period_s: float  # time from frame to frame
    # first frame and the one after the last of each batch; empty for a gap
    ranges: tuple[tuple[int, int], ...]
    time: F64  # (batch,) centre of each batch, seconds from the first frame
    note: str = ""  # note for the reader, or ""

    @property
    def count(self) -> I32:
        """Frames in each batch."""
        return np.array([b - a for a, b in self.ranges], dtype=np.int32)


def plan_batches(time_s: F64, frames: int | None = None) -> FrameBatches:
    """Divide a run into batches of equal time, by the time (t,) of its frames, gaps included."""
    # By default of 500 frames, or fewer in a shorter run, for some 24 batches.
    n = len(time_s)
    length = frames or max(MIN_FRAMES, min(DEFAULT_FRAMES, n // WANTED))
    steps = np.diff(time_s)
    period = float(np.median(steps)) if n > 1 else 1.0
    note = ""
    if period > 0 and time_s[-1] - time_s[0] < 20 * n * period:
        # Slots are counted from frame to frame, so small errors of the period do not add up.
        slots = np.concatenate([[0], np.cumsum(np.maximum(1, np.rint(steps / period)))])
    else:
        slots, period = np.arange(n, dtype=float), period if period > 0 else 1.0
        note = "irregular time stamps: batches are counted in frames, not seconds"
    n_batches = int((slots[-1] + 1) // length) if n else 0
    edges = np.searchsorted(slots, np.arange(n_batches + 1) * length)
    ranges = tuple((int(a), int(b)) for a, b in pairwise(edges))
    # A batch with many missing frames has a different noise and counts as a gap.
    ranges = tuple((a, b) if b - a >= 0.75 * length else (a, a) for a, b in ranges)
    centre = np.asarray((np.arange(n_batches) + 0.5) * length * period, dtype=np.float64)
    return FrameBatches(length, period, ranges, centre, note)


@dataclass(frozen=True)
class TileMaps:
    """Results of the sweep of a tile."""

    iota: F32  # iota, alpha: (y, x) mean and amplitude (e-) at B = A = 1
    alpha: F32
    phase: F32  # (y, x) phase (rad, in ±pi) relative to the carrier `k . (r - reference)`
    sigma: F32  # (y, x) 1-sigma error of the phase (rad) that the noise model predicts
    chi2: F32  # (y, x) reduced chi-square
    count: F32  # (y, x) samples with weight
    smooth: SmoothPhasor  # of the start model
    # batch_phase, batch_sigma: (batch, y, x) phase of each batch relative to that of all
    # frames, and its error (rad); NaN in gaps
    batch_phase: F32
    batch_sigma: F32
    bound: F64  # (n,) Cramér-Rao bound of the phase (rad) for a sample of good pixels


def frames_to_prime(frames: FrameParameters, block: int) -> int:
    """Frames, a multiple of ``block``, after which a pixel's system is well conditioned."""
    n = len(frames.g)
    for stop in range(block, n, block):
        g = frames.g[:stop]
        scale = np.sqrt((g**2).mean(axis=0))
        if np.linalg.cond((g / scale).T @ (g / scale)) < 50:
            return stop
    return n


@dataclass(frozen=True)
class SetSweep:
    """What the sweeps of all tiles of a set have in common."""

    coding: Coding
    frames: FrameParameters
    k: tuple[float, float]  # carrier (kx, ky), rad/px
    batches: FrameBatches
    prime: int  # first frames held until the start model is made (`frames_to_prime`)
    bound_pixels: int = BOUND_PIXELS  # pixels for which the Cramér-Rao bound is computed


def sweep_tile(tile: Tile, blocks: Iterable[U16], common: SetSweep) -> TileMaps:
    """Fit a tile, taking its blocks (t, y, x) of stored codes one after the other."""
    frames = common.frames
    held: list[U16] = []
    sums: PixelSums | None = None
    for block in blocks:
        if sums is not None:
            sums.add(block)
            continue
        held.append(block.copy())
        n_held = sum(map(len, held))
        if n_held < common.prime and n_held < len(frames.g):
            continue
        first = FrameParameters(frames.g[:n_held], frames.dk[:n_held], frames.reference)
        model, smooth = start_model(tile, held, common.coding, first, common.k)
        sums = PixelSums(tile, common.coding, frames, model, common.batches.ranges)
        while held:
            sums.add(held.pop(0))
    if sums is None or sums.position != len(frames.g):
        given = sum(map(len, held)) if sums is None else sums.position
        raise ValueError(f"{given} frames given, {len(frames.g)} expected")
    return _maps(tile, common, smooth, sums)


def _maps(tile: Tile, common: SetSweep, smooth: SmoothPhasor, sums: PixelSums) -> TileMaps:
    frames, k = common.frames, common.k
    theta, sigma, chi2, count = sums.finish()
    z = theta[2] + 1j * theta[1]
    (cy, cx), (ry, rx) = tile.centre, frames.reference
    carrier = plane_wave(tile.shape, k, k[0] * (cx - rx) + k[1] * (cy - ry))
    with np.errstate(divide="ignore", invalid="ignore"):
        reduced = np.where(count > 3, chi2 / (count - 3), np.nan)
    turn = np.angle(z * smooth.map.conj()).astype(np.float32)
    return TileMaps(
        iota=theta[0].astype(np.float32),
        alpha=np.abs(z).astype(np.float32),
        phase=np.angle(z * carrier.conj()).astype(np.float32),
        sigma=sigma.astype(np.float32),
        chi2=reduced.astype(np.float32),
        count=count.astype(np.float32),
        smooth=smooth,
        batch_phase=_relative(sums.turn, turn),
        batch_sigma=sums.sigma,
        bound=phase_bound(tile, theta, frames, common.bound_pixels),
    )


def _relative(batches: F32, turn: F32) -> F32:
    """Phases of batches (batch, y, x) relative to the run's (y, x); the former are overwritten."""
    batches -= turn
    # Most are within ±pi, and wrapping them takes longer than this check.
    near = not len(batches) or np.abs(batches).max() < np.pi
    return batches if near else wrapped(batches)


def phase_bound(tile: Tile, theta: F64, frames: FrameParameters, number: int = BOUND_PIXELS) -> F64:
    """Cramér-Rao bound of the phase (rad) for a sample of pixels of a tile, for known frames."""
    # For Gaussian noise of the pixel's own fitted variance (physics note, section 3).
    usable = tile.good & np.isfinite(theta).all(axis=0)
    where = np.flatnonzero(usable)
    if not len(where):
        return np.zeros(0)
    # Golden-ratio steps: an even step would fall on the same phase of the fringe again and again.
    spread = np.arange(min(number, len(where))) * 0.6180339887498949 % 1.0
    picked = where[(spread * len(where)).astype(int)]
    bounds = []
    for y, x in zip(*np.unravel_index(picked, tile.shape), strict=True):
        maps = theta[:, y, x]
        g = frames.at(y + tile.y[0], x + tile.x[0])
        variance = tile.shot[y, x] * np.maximum(g @ maps, 0) + tile.read[y, x]
        information = g.T @ (g / variance[:, None])
        gradient = np.array([0.0, maps[2], -maps[1]]) / (maps[1] ** 2 + maps[2] ** 2)
        try:
            bounds.append(np.sqrt(gradient @ np.linalg.solve(information, gradient)))
        except np.linalg.LinAlgError:
            continue
    return np.array(bounds)
