"""Residuals of frames, as noise to be correlated between pixels.

Two parts are removed: what is common to the pixels of a frame (offset; light, contrast and phase,
constant over the window or linear along it), and what is common to the frames of a pixel (its
level; its light and fringe, and the harmonics of a nonlinear response). Removing the first
correlates residuals by minus the products of the modes, which are kept to correct for that.
Removing the second makes residuals smaller, which is corrected here.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.distortions import TwoWay
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.kernels.crosstalk import Coupling, filled, noise_shares, uncouple, uncouple_fringes
from pixcal.kernels.line_means import without_line_means
from pixcal.model.arrays import F32, Indices

UNIT = 1e4  # unit of charge, electrons; variances are in 10⁴ e-²
CLIP = 6.0  # residuals beyond this many sigmas (particles, telegraph noise) are excluded
# most samples of a sequence; longer ones are thinned to frames spread over them
MAX_SAMPLES = 6_000_000
MIN_FRAMES = 16  # fewest frames of a fringe set for residuals
# modes are kept at this interval of frames; they change little, and only their products count
STRIDE = 16
LEVELS = 128  # of the response common to all pixels
MIN_NOISE_SHARE = 0.1  # least share of its noise that a usable sample retains


@dataclass(frozen=True)
class Residuals:
    """Residuals in units of their noise; zero where a sample has no weight."""

    e: F32  # (t, y, x) residual over its sigma
    charge: F32  # (t, y, x) mean charge as collected, which is its variance, over sigma (10⁴ e-)
    shot: F32  # (t, y, x) variance that charge gives after the couplings, over sigma
    one: F32  # (t, y, x) one over sigma
    # (m, s, y, x) modes removed from every `STRIDE`-th frame, orthonormal, scaled to represent
    # all
    modes: F32
    steady: bool = False  # whether the charge of a pixel is the same in all frames

    @property
    def brightness(self) -> float:
        """Median charge, 10⁴ e-."""
        used = self.one > 0
        return float(np.median(self.charge[used] / self.one[used])) if used.any() else 0.0

    @property
    def taken(self) -> tuple[F32, F32, F32]:
        """Modes as if they were frames, and their charge and one, (m s, y, x)."""
        times = (len(self.modes), 1, 1)
        charge, one = (np.tile(a[::STRIDE], times) for a in (self.charge, self.one))
        return self.modes.reshape(one.shape), charge, one


def all_residuals(evidence: Evidence, known: Sequence[Coupling]) -> Iterator[Residuals]:
    """Residuals of each sequence of frames; known couplings give the charge collected."""
    kept = noise_shares(known, evidence.good.shape, evidence.origin)[0].astype(np.float32)
    for stack in evidence.stacks:
        if len(stack.adu) > 1:
            yield _of_stack(stack, evidence, known, kept)
    for fringes in evidence.fringes.values():
        if len(fringes.g) >= MIN_FRAMES:
            yield _of_fringes(fringes, known, kept)


def _spread(frames: int, pixels: int) -> Indices:
    few = max(MIN_FRAMES, MAX_SAMPLES // pixels)
    return np.unique(np.linspace(0, frames - 1, min(frames, few)).astype(int))


def _of_stack(stack: Stack, evidence: Evidence, known: Sequence[Coupling], kept: F32) -> Residuals:
    """Bias, darks or flats; offset and level of each frame are free, and each pixel's level."""
    at = _spread(len(stack.adu), evidence.good.size)
    signal = (stack.adu[at] - evidence.bias) * evidence.gain
    light = signal.mean(axis=0)
    used = evidence.good & (stack.adu.max(axis=0) < evidence.saturation_adu)
    noise = ((signal - light) / UNIT**0.5).astype(np.float32)
    rest = np.where(used, without_line_means(noise, used), np.float32(np.nan))
    collected = np.maximum(uncouple(light, known, evidence.origin), 0)
    charge = np.broadcast_to((collected / UNIT).astype(np.float32), rest.shape)
    level = np.ones((1, len(at)), np.float32)
    common = [np.ones(used.size), charge[0].ravel()][: 1 + (stack.kind == "flat")]
    read = np.full(used.shape, evidence.read_noise**2 / UNIT, np.float32)
    found = _noise(rest, charge, read, kept, level, np.array(common, np.float32))
    return replace(found, steady=True)


def _of_fringes(found: FringeEvidence, known: Sequence[Coupling], kept: F32) -> Residuals:
    """Fringe frames less the fit, as they were before they were divided by the flat."""
    # A nonlinear response causes second and third harmonics of the fringes that differ by pixel.
    at = _spread(len(found.g), found.good.size)
    flat = 1 / found.shot_factor
    theta = filled(np.where(found.good, found.theta, np.nan) * flat, found.k)
    collected = uncouple_fringes(theta, known, found.origin)
    light = replace(found, theta=collected, g=found.g[at], dk=found.dk[at]).model
    charge = np.maximum(light / np.float32(UNIT), 0)
    # Also changes along the window: a moving fringe vector, rows that are exposed later.
    y, x = grid(flat.shape)
    places = np.concatenate([theta, x * theta, y * theta]).reshape(9, -1) / np.abs(theta).max()
    scale = np.where(found.good, flat / UNIT**0.5, np.nan).astype(np.float32)
    rest = _without_response(found.residual[at] * scale, charge)
    read = (found.read_variance * flat**2 / UNIT).astype(np.float32)
    turn = np.exp(1j * np.outer([1, 2, 3], found.phi[at]))
    own = np.concatenate([np.ones((1, len(at))), turn.real, turn.imag])
    of_time = np.ascontiguousarray(np.linalg.qr(own.T)[0].T, np.float32)
    return _noise(rest, charge, read, kept, of_time, places.astype(np.float32))


def _without_response(rest: F32, charge: F32) -> F32:
    """Residuals (t, y, x) less their mean at each level: a nonlinear response. In place."""
    # Frame by frame: the level indices of all frames would take more memory than the frames.
    step = float(charge.max()) / LEVELS or 1.0
    count, total = np.zeros((2, LEVELS))
    for noise, level in zip(rest, charge, strict=True):
        used = np.isfinite(noise)
        at = np.minimum((level[used] / step).astype(int), LEVELS - 1)
        count += np.bincount(at, minlength=LEVELS)
        total += np.bincount(at, noise[used], LEVELS)
    some = np.flatnonzero(count)
    if len(some):
        mean = total[some] / count[some]
        for noise, level in zip(rest, charge, strict=True):
            noise -= np.interp(level / step - 0.5, some, mean).astype(np.float32)
    return rest


def _noise(rest: F32, charge: F32, read: F32, kept: F32, of_time: F32, of_place: F32) -> Residuals:
    """Residuals in units of their noise, without what is common to pixels and to frames."""
    shot = charge * kept
    variance = shot + read
    weight = np.where(rest**2 < CLIP**2 * variance, 1 / variance, np.float32(0))
    one = np.sqrt(weight)
    freedom = TwoWay(weight.reshape(len(rest), -1), of_time, of_place)
    e = freedom.left_over(rest.reshape(len(rest), -1)).reshape(rest.shape) * one
    left = np.maximum(1 - freedom.taken_by_pixels(), np.float32(MIN_NOISE_SHARE))
    e /= np.sqrt(left).reshape(e.shape)
    # Excess noise lowers the weight of every product.
    squares = float(np.einsum("tyx,tyx->t", e, e).sum(dtype=float))
    excess = max(1.0, squares / max(int(np.count_nonzero(one)), 1))
    less = np.float32(excess**-0.5)
    size, axes = np.linalg.eigh(freedom.frame_covariance[::STRIDE])
    to_modes = (np.sqrt(np.maximum(size, 0))[:, None] * axes).swapaxes(1, 2).astype(np.float32)
    modes = np.stack(to_modes, axis=1) @ of_place
    modes = modes.reshape(len(of_place), -1, *rest.shape[1:]) * one[::STRIDE]
    modes *= less * np.float32(np.sqrt(len(e) / modes.shape[1]))
    one *= less
    return Residuals(e * less, charge * one, shot * one, one, modes)
