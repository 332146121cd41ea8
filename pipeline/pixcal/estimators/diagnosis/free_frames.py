"""Parameters of frames of which each is free, from all good pixels and from either half."""

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.fringe_fit.fringes import FrameParameters, grid
from pixcal.estimators.fringe_fit.tile_fit import Coding
from pixcal.kernels.bilinear import frame_sums
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.model.arrays import F64, Mask

FreeFrames = tuple[F64, F64]  # parameters (t, 5) of independent frames, and covariance
STRIPE = 4  # rows of a stripe of `FringeEvidence.halves`: few neighbours lie in different halves
NO_SAMPLE = -(1 << 30)  # electrons that mark a sample without weight


def stripes(shape: tuple[int, ...]) -> Mask:
    """One half of a window by stripes of rows (columns if rows are few), to broadcast to (y, x)."""
    axis = 0 if shape[0] >= 2 * STRIPE else 1
    return np.expand_dims(stripe_half(shape[axis]), 1 - axis)


def stripe_half(count: int) -> Mask:
    """Every other stripe of rows or columns, in the order of Thue and Morse."""
    # The sequence has no period that could coincide with fringes.
    return np.asarray(np.bitwise_count(np.arange(count) // STRIPE) % 2 == 0)


def free_frames(
    codes: NDArray[np.generic],
    coding: Coding,
    start: FrameParameters,
    theta: F64,
    read_variance: F64,
    shot_factor: F64,
    good: Mask,
) -> tuple[FreeFrames, FreeFrames, FreeFrames]:
    """Parameters (t, 5) of every frame independently, for known pixels, and their covariance.

    From all good pixels, and from each half of them by stripes of rows: the bench is common to both
    halves; the noise of samples, and of whole rows, is not.

    ``codes``: (t, y, x) samples as they are stored, or in electrons. ``start``: at the middle
    of the part. The maps are as in `FringeEvidence`.
    """
    y, x = np.broadcast_arrays(*grid((good.shape[0], good.shape[1])))
    g, dk = start.g.astype(np.float32), start.dk.astype(np.float32)

    def sums(good: Mask) -> tuple[F64, F64]:
        used, n = np.flatnonzero(good), len(g)
        packed, right = np.zeros((n, 15)), np.zeros((n, 5))
        samples = np.take(codes.reshape(n, -1), used, axis=1).astype(np.float32, copy=False)
        maps = (y, x, theta, read_variance, shot_factor)
        pixels = (np.ascontiguousarray(one[..., good], np.float32) for one in maps)
        frame_sums(samples, *coding, g, dk, *pixels, packed, right)
        return packed, right

    def solved(packed: F64, right: F64) -> FreeFrames:
        covariance = inverse_normal(symmetric(packed), 1e-10)
        step = np.einsum("tij,tj->ti", covariance, right)
        return np.hstack([g, dk]) + step, covariance

    half = stripes(good.shape)
    one, other = sums(good & half), sums(good & ~half)
    return solved(one[0] + other[0], one[1] + other[1]), solved(*one), solved(*other)
