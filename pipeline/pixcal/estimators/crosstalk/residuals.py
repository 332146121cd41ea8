"""Residuals of frames, as noise to be correlated between pixels.

Frames are corrected for the couplings known so far. Two parts are removed: what is common to the
pixels of a frame (offset; light, contrast and phase, constant over the window or linear along it),
and what is common to the frames of a pixel (its level and slow drift; its fringe with harmonics).
Removing the first correlates residuals by minus the products of the modes, which are appended as if
they were frames. Removing the second leaves less noise, and as much less information.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.distortions import FramesByPixels
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.kernels.crosstalk import (
    STEPS,
    Coupling,
    filled,
    largest_outflow,
    uncouple,
    uncouple_fringes,
)
from pixcal.kernels.frame_order import slow_trends
from pixcal.kernels.line_means import without_line_means
from pixcal.model.arrays import F32, Indices, Mask

UNIT = 1e4  # unit of charge, electrons; variances are in 10⁴ e-²
CLIP = 6.0  # residuals beyond this many sigmas (particles, telegraph noise) are excluded
# most samples of a sequence; longer ones are thinned to frames spread over them
MAX_SAMPLES = 6_000_000
MIN_FRAMES = 16  # fewest frames of a fringe set for residuals
HARMONICS = 5  # of a pixel's fringe, as a nonlinear response causes
# modes are kept at this interval of frames; they change little, and only their products count
STRIDE = 16
LEFT = 1e-3  # most of the coupled noise that the correction for couplings may leave
MIN_NOISE_SHARE = 0.1  # least share of its noise that a usable sample retains


@dataclass(frozen=True)
class Residuals:
    """Weighted residuals of t frames and of modes."""

    e: F32  # (r, y, x) residuals, 10² e-, times weight; those of the modes are last
    # (t, y, x) mean charge, 10⁴ e-, whose shot noise variance is the same number; (1, y, x) where
    # it is the same in all frames
    charge: F32
    weight: F32  # (t, y, x) one over the variance; zero where a sample is not used
    frame: Indices  # (r,) row of ``charge`` of each residual

    @property
    def brightness(self) -> float:
        """Median charge, 10⁴ e-."""
        used = self.weight > 0
        return float(np.median(np.broadcast_to(self.charge, used.shape)[used])) if used.any() else 0


def all_residuals(evidence: Evidence, known: Sequence[Coupling] = ()) -> Iterator[Residuals]:
    """Residuals of each sequence of frames, without the known couplings."""
    for stack in evidence.stacks:
        if len(stack.adu) > 1:
            yield _of_stack(stack, evidence, known)
    for fringes in evidence.fringes.values():
        if len(fringes.g) >= MIN_FRAMES:
            yield _of_fringes(fringes, known)


def _spread(frames: int, pixels: int) -> Indices:
    few = max(MIN_FRAMES, MAX_SAMPLES // pixels)
    return np.unique(np.linspace(0, frames - 1, min(frames, few)).astype(int))


def _of_stack(stack: Stack, evidence: Evidence, known: Sequence[Coupling]) -> Residuals:
    """Bias, darks or flats; offset and level of each frame are free, and each pixel's drift."""
    at = _spread(len(stack.adu), evidence.good.size)
    signal = (stack.adu[at] - evidence.bias) * evidence.gain
    signal = uncouple(signal, known, evidence.origin, _steps(known, signal)) / UNIT
    light = signal.mean(axis=0)
    good = evidence.good & (stack.adu.max(axis=0) < evidence.saturation_adu)
    noise = without_line_means(((signal - light) * UNIT**0.5).astype(np.float32), good)
    charge = np.maximum(light, 0).astype(np.float32)
    # Even light is nearly the offset; centred, the two are told apart in single precision.
    contrast = charge - np.float32(charge.mean(dtype=float))
    common = np.stack([np.ones_like(charge), contrast])[: 1 + (stack.kind == "flat")]
    read = np.full_like(charge, evidence.read_noise**2 / UNIT)
    trends = np.ascontiguousarray(slow_trends(stack.frame[at]).T)
    return _noise(noise, charge[None], read, trends, common, good)


def _steps(known: Sequence[Coupling], signal: NDArray[Any]) -> int:
    """Steps of the inverse of couplings: each leaves the share of a change that leaves a pixel."""
    rise = max((c.per_ke for c in known), default=0.0)
    share = largest_outflow(known) * (1 + 2e-3 * max(rise, 0) * float(np.max(signal)))
    return math.ceil(math.log(LEFT) / math.log(share)) if 0 < share < 1 else STEPS


def _of_fringes(fringes: FringeEvidence, known: Sequence[Coupling]) -> Residuals:
    """Fringe frames less the fit, before division by the flat."""
    at, good = _spread(len(fringes.g), fringes.good.size), fringes.good
    flat = 1 / fringes.shot_factor
    fringes = replace(fringes, electrons=fringes.electrons[at], g=fringes.g[at], dk=fringes.dk[at])
    samples = fringes.electrons * flat.astype(np.float32)
    theta = filled(np.where(good, fringes.theta, np.nan) * flat, fringes.k)
    if known:
        seen = np.isfinite(samples)
        samples = np.where(seen, samples, replace(fringes, theta=theta).model)
        samples = uncouple(samples, known, fringes.origin, _steps(known, samples))
        samples[~seen] = np.nan
        theta = uncouple_fringes(theta, known, fringes.origin)
    model = replace(fringes, theta=theta).model
    rest = (samples - model) * np.float32(UNIT**-0.5)
    charge = np.maximum(model / np.float32(UNIT), 0)
    read = (fringes.read_variance * flat**2).astype(np.float32) / np.float32(UNIT)
    # Also changes along the window: a moving fringe vector, rows that are exposed later.
    y, x = grid((good.shape[0], good.shape[1]))
    places = np.concatenate([theta, x * theta, y * theta]) / np.abs(theta).max()
    turn = np.exp(1j * np.outer(range(1, HARMONICS + 1), fringes.phi))
    harmonics = np.concatenate([np.ones((1, len(at))), turn.real, turn.imag])
    of_time = np.ascontiguousarray(np.linalg.qr(harmonics.T)[0].T, np.float32)
    return _noise(rest, charge, read, of_time, places.astype(np.float32), good)


def _noise(rest: F32, charge: F32, read: F32, of_time: F32, of_place: F32, good: Mask) -> Residuals:
    """Residuals (t, y, x) without the parts common to pixels or to frames."""
    (frames, *place), variance = rest.shape, charge + read
    used = good & (rest**2 < CLIP**2 * variance)
    weight = np.divide(1, variance, out=np.zeros_like(rest), where=used)
    weight, of_place = weight.reshape(frames, -1), of_place.reshape(len(of_place), -1)
    freedom = FramesByPixels(weight, of_time, of_place)
    rest = freedom.left_over(rest.reshape(weight.shape))
    kept = 1 - freedom.absorbed_by_pixels()
    weight = np.where(kept > MIN_NOISE_SHARE, weight, np.float32(0))
    # Excess noise lowers the weight of every product.
    excess = (rest**2 * weight).sum(dtype=float) / max((kept * (weight > 0)).sum(dtype=float), 1)
    weight = weight / np.float32(max(1.0, excess))
    # A product of two residuals keeps this share of the covariance, and of the information.
    information = np.asarray(weight * np.sqrt(np.maximum(kept, 0)), np.float32)
    size, axes = np.linalg.eigh(freedom.frame_covariance[::STRIDE])
    size *= frames / len(size)
    to_modes = (np.sqrt(np.maximum(size, 0))[:, None] * axes).swapaxes(1, 2).astype(np.float32)
    modes = (np.stack(to_modes, axis=1) @ of_place) * information[::STRIDE]
    e = np.concatenate([rest * weight, *modes]).reshape(-1, *place)
    frame = np.arange(frames) * (len(charge) > 1)
    frame = np.concatenate([frame, *[frame[::STRIDE]] * len(modes)])
    return Residuals(e, charge, information.reshape(-1, *place), frame)
