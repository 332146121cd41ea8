"""A constant added to a whole frame, separated from noise of rows, columns and pixels.

Stripes of rows divide the pixels into halves, and so do stripes of columns. The mean of a frame (W)
holds its offset and all noise; the difference of halves by rows (R) the noise of rows and pixels,
by columns (C) of columns and pixels, by both (K) of pixels alone, each with the same variance as in
the mean. The four variances therefore give that of the offset, without a noise model; offsets are
Wiener-filtered accordingly.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.diagnosis.free_frames import stripe_half
from pixcal.estimators.frame_series.series import TimedValues, wiener
from pixcal.estimators.frame_series.variance_components import (
    Modes,
    estimate_components,
    walk_modes,
)
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.model.arrays import F32, F64, Mask

FEWEST = 5  # fewest frames: with fewer, chance does not follow the assumed distribution
FEWEST_PIXELS = 16  # in each quarter
# R, C, K of the quarters
CONTRASTS = np.array([[1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]]) / 4
# whether noise of pixels, rows and columns is present in W, R, C, K
NOISES = np.array([[1, 1, 1, 1], [1, 1, 0, 0], [1, 0, 1, 0]])
# lowest size of the pixels' noise over the prediction; other parts may be negative down to
# `BELOW` of it
MIN_NOISE = 0.05
BELOW = 0.3
_MIN_VARIANCE = 1e-6  # e-², of samples in pixels that are not good


@dataclass(frozen=True)
class OffsetSeries:
    """Offsets of consecutive frames."""

    name: str
    time_s: F64  # (t,) after the first frame of the acquisition where that is known
    step_s: float  # median time from frame to frame
    values: F64  # (t, 4) W, R, C, K, e-
    noise: F64  # (4,) their variance from the noise of the pixels, e-²
    nuisance: F64  # (t, p) shapes that are no offsets

    def __len__(self) -> int:
        return len(self.values)


def dark_offsets(stack: Stack, good: Mask, gain: float, read_noise: float) -> OffsetSeries | None:
    """Offsets of frames without light, e-; None where they are too few."""
    masks = _quarters(good)
    if len(stack.adu) < FEWEST or masks is None:
        return None
    signal = (stack.adu - stack.adu.mean(axis=0)) * np.float32(gain)
    means = np.stack([signal[:, mask].mean(axis=1, dtype=float) for mask in (good, *masks)])
    noise = [max(read_noise, 0.1) ** 2 / mask.sum() for mask in (good, *masks)]
    nothing = np.zeros((len(stack.adu), 0))
    return _series(stack.kind, stack.time_s, stack.start_s, means, np.array(noise), nothing)


def fringe_offsets(fringes: FringeEvidence, flat: F64) -> OffsetSeries | None:
    """Offsets of fringe frames: ``1 / flat`` after division by the flat, with B, A, phi free."""
    masks = _quarters(fringes.good)
    if len(fringes.g) < FEWEST or masks is None:
        return None
    quarters = _sums(fringes, flat, masks)
    whole = tuple(np.sum(part, axis=0) for part in zip(*quarters, strict=True))
    fits = [_constant(*sums) for sums in (whole, *quarters)]
    if not all(np.isfinite(f).all() for f in fits):
        return None
    means = np.stack([value for value, _ in fits])
    noise = np.array([variance.mean() for _, variance in fits])
    phi = fringes.phi
    # A nonlinear response: harmonics of the phase, and the level of the light.
    shapes = [np.cos(phi), np.sin(phi), np.cos(2 * phi), np.sin(2 * phi), fringes.g[:, 0]]
    return _series(
        fringes.name, fringes.time_s, fringes.start_s, means, noise, np.stack(shapes, axis=1)
    )


def offset_modes(every: Sequence[OffsetSeries], shapes: Sequence[F64]) -> Modes:
    """All series for `estimate_components`: known changes (t, q) first, then offsets."""
    widths = [s.nuisance.shape[1] for s in every]
    q = shapes[0].shape[1]
    values, designs, parts, least = [], [], [], np.full(2, -np.inf)
    at = q
    for i, s in enumerate(every):
        n = len(s) - 1
        design = np.zeros((n, 4, q + sum(widths)))
        basis = walk_modes(s.time_s)
        design[:, 0, :q] = basis.of(shapes[i])
        design[:, 0, at : at + widths[i]] = basis.of(s.nuisance)
        at += widths[i]
        part = np.zeros((2 + 3 * len(every), n, 4, 4))
        part[0, :, 0, 0], part[1, :, 0, 0] = 1.0, basis.walk
        part[2 + 3 * i : 5 + 3 * i] = (NOISES * s.noise)[:, None, :, None] * np.eye(4)
        values.append(basis.of(s.values))
        designs.append(design)
        parts.append(part)
        least = np.maximum(least, -BELOW * s.noise[0] / np.array([1.0, basis.walk.max()]))
    limits = [MIN_NOISE, -BELOW * MIN_NOISE, -BELOW * MIN_NOISE]
    return Modes(
        values=np.concatenate(values),
        known=np.concatenate(designs),
        parts=np.concatenate(parts, axis=1),
        start=np.concatenate([np.zeros(2), np.tile([1.0, 0.0, 0.0], len(every))]),
        least=np.concatenate([least, np.tile(limits, len(every))]),
    )


def _quarters(good: Mask) -> list[Mask] | None:
    """Good pixels of the four quarters, in the order of `CONTRASTS`."""
    ny, nx = good.shape
    rows, columns = stripe_half(ny)[:, None], stripe_half(nx)
    masks = [good & (rows == a) & (columns == b) for a in (True, False) for b in (True, False)]
    return masks if min(int(mask.sum()) for mask in masks) >= FEWEST_PIXELS else None


def _sums(fringes: FringeEvidence, flat: F64, masks: Sequence[Mask]) -> list[tuple[F64, F64]]:
    """Normal matrices (t, 4, 4) and right sides (t, 4) of light, fringes and offset; by mask."""
    maps = np.concatenate([fringes.theta, 1 / flat[None]]).reshape(4, -1)
    rows, columns = np.triu_indices(len(maps))
    variance = np.maximum(fringes.variance, np.float32(_MIN_VARIANCE))
    pull, weight = (own.reshape(len(own), -1) for own in (fringes.residual, 1 / variance))
    missing = np.isnan(pull)
    if missing.any():
        pull, weight = np.where(missing, 0, pull), np.where(missing, 0, weight)
    pull = pull * weight

    def summed(weights: F32 | F64, patterns: F64) -> F64:
        # All masks together, so that the weights are read once.
        every = np.stack([np.where(mask.ravel(), patterns, 0) for mask in masks])
        sums = weights @ every.astype(np.float32).reshape(-1, patterns.shape[1]).T
        return np.asarray(sums.astype(float).reshape(len(weights), len(masks), -1).swapaxes(0, 1))

    normals, rights = summed(weight, maps[rows] * maps[columns]), summed(pull, maps)
    return list(zip(symmetric(normals), rights, strict=True))


def _constant(normal: F64, right: F64) -> tuple[F64, F64]:
    """Last coefficient (t,) of a weighted fit of patterns, and its variance."""
    last = inverse_normal(normal, 1e-15)[:, -1]
    return np.einsum("ti,ti->t", last, right), last[:, -1]


def _series(
    name: str, time_s: F64, start_s: float, means: F64, noise: F64, nuisance: F64
) -> OffsetSeries:
    """From the means of all pixels and of the quarters (5, t), and their variances (5,)."""
    step = float(np.median(np.diff(time_s))) or 1.0
    return OffsetSeries(
        name=name,
        time_s=time_s + (start_s if np.isfinite(start_s) else 0.0),
        step_s=step,
        values=np.concatenate([means[:1], CONTRASTS @ means[1:]]).T,
        noise=np.concatenate([noise[:1], CONTRASTS**2 @ noise[1:]]),
        nuisance=nuisance,
    )


def unlit_stacks(evidence: Evidence, *kinds: str) -> list[Stack]:
    """Series of frames without light, less those that begin soon after light."""
    # After light the level may fall for many frames, as in a detector that lags: that is no bias.
    return [s for s in evidence.stacks if s.kind in kinds and not evidence.soon_after_light(s)]


def dark_offset_series(evidence: Evidence) -> list[TimedValues]:
    """Changes of the level of bias and dark frames, where these have one exposure time."""
    drift = []
    for kind in ("bias", "dark"):
        stacks = unlit_stacks(evidence, kind)
        if len(stacks) != 1:
            continue
        series = dark_offsets(stacks[0], evidence.good, evidence.gain, evidence.read_noise)
        if series is None:
            continue
        modes = offset_modes([series], [np.zeros((len(series), 0))])
        size = np.maximum(estimate_components(modes).size, 0.0)
        parts = size[:, None, None, None] * modes.parts
        smooth = wiener(parts, parts[:2].sum(axis=0)[:, :, 0], modes.values)
        drift.append((f"{kind} frames", stacks[0].time_s, walk_modes(series.time_s).series(smooth)))
    return drift
