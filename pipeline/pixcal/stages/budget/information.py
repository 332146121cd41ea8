"""Information of a frame on the phase of a pixel, and the cost of weights and phases."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pixcal.model.arrays import F64

NODES = 9  # nodes of the quadrature over frame-to-frame changes
TURN = 720  # steps per cycle for means over the phase without a closed form


@dataclass(frozen=True)
class FrameSpread:
    """Frame-to-frame changes of light and contrast, as nodes and weights of a quadrature."""

    level: F64  # level, amplitude: (n,) B and A, mean about 1
    amplitude: F64
    weight: F64  # (n,) sum 1

    @classmethod
    def normal(cls, level_rms: float, contrast_rms: float, visibility: float) -> "FrameSpread":
        """Normal changes of light and contrast, relative, clipped as `scene` does at contrast 1."""
        x, u = np.polynomial.hermite_e.hermegauss(NODES if level_rms else 1)
        y, v = np.polynomial.hermite_e.hermegauss(NODES if contrast_rms else 1)
        level = np.repeat(np.maximum(1 + level_rms * x, 0), len(y))
        contrast = np.tile(np.clip(1 + contrast_rms * y, 0, 1 / visibility), len(x))
        weight = np.outer(u, v).ravel()
        return cls(level, level * contrast, weight / weight.sum())


STEADY = FrameSpread(np.ones(1), np.ones(1), np.ones(1))


def phase_information(
    iota: ArrayLike, alpha: ArrayLike, variance: float, spread: FrameSpread = STEADY
) -> F64:
    """Information of one frame on a pixel's phase, 1/rad², averaged over phases and spread.

    ``iota``, ``alpha``: e-, at B = A = 1. ``variance``: e-², of a sample without light.
    """
    total = np.asarray(iota, float)[..., None] * spread.level + variance
    swing = np.asarray(alpha, float)[..., None] * spread.amplitude
    # At low contrast, a difference of two nearly equal numbers: written as a quotient.
    root = np.sqrt(np.maximum(total**2 - swing**2, 0.0))
    return np.asarray(swing**2 / (total + root) @ spread.weight)


def unweighted_variance(
    iota: ArrayLike, alpha: ArrayLike, variance: float, spread: FrameSpread = STEADY
) -> F64:
    """Variance (rad²) of one frame with equal weights: twice the bound at full contrast."""
    square = spread.amplitude**2
    noise = np.asarray(iota, float)[..., None] * spread.level + variance
    power = np.asarray(alpha, float) ** 2 * (square @ spread.weight) ** 2
    return np.asarray(2 * (square * noise @ spread.weight) / power)


def sampling_loss(iota: float, alpha: float, variance: float, phases: F64) -> tuple[float, float]:
    """Ratio of frames needed with phases (t,) to uniform phases, at the median and worst phase."""
    # Few phases favour some pixels and mix iota, alpha and phase; infinite if these are degenerate.
    psi = 2 * np.pi * np.arange(TURN) / TURN
    information = np.zeros((TURN, 3, 3))
    for phi in phases:
        sine, cosine = np.sin(psi + phi), np.cos(psi + phi)
        slopes = np.stack([np.ones(TURN), sine, cosine], axis=-1)
        noise = np.maximum(iota + alpha * sine + variance, 1e-9)
        information += slopes[:, :, None] * slopes[:, None, :] / noise[:, None, None]
    information /= len(phases)
    if np.max(np.linalg.cond(information)) > 1e12:
        return np.inf, np.inf
    achieved = np.linalg.inv(information)[:, 2, 2] / alpha**2
    loss = achieved * float(phase_information(iota, alpha, variance))
    return float(np.median(loss)), float(loss.max())
