"""The Cramér-Rao bound of a pixel's phase, from light and noise alone, in closed form.

A sample has the mean ``c = B iota + A alpha sin u``, u the fringe's phase at the pixel in that
frame, and the variance c + r: shot noise and what the sample has without light. Where u is uniform,
what iota and alpha take is even about u = pi/2 and what the phase takes is odd: they do not mix,
and free iota and alpha cost the phase nothing. One frame then gives (physics note, sections 1 to 3)

    information = < (A alpha cos u)² / (c + r) > = s - sqrt(s² - (A alpha)²),   s = B iota + r

whose limits are iota at full contrast without read noise, and alpha² / (2 s) at faint contrast.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pixcal.model.arrays import F64

NODES = 9  # places of the quadrature over the changes from frame to frame
TURN = 720  # steps of a turn where a mean over the phase has no closed form


@dataclass(frozen=True)
class FrameSpread:
    """How light and contrast change from frame to frame, as places and weights of a quadrature."""

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

    def mean(self, values: F64) -> F64:
        """Mean over the frames of values (..., n)."""
        return np.asarray(values @ self.weight)


STEADY = FrameSpread(np.ones(1), np.ones(1), np.ones(1))


def phase_information(
    iota: ArrayLike, alpha: ArrayLike, variance: float, spread: FrameSpread = STEADY
) -> F64:
    """Information of one frame on a pixel's phase, 1/rad², at uniform phases, over the spread.

    ``iota``, ``alpha``: e-, at B = A = 1. ``variance``: e-², of a sample without light.
    """
    total = np.asarray(iota, float)[..., None] * spread.level + variance
    swing = np.asarray(alpha, float)[..., None] * spread.amplitude
    # The difference of two nearly equal numbers at faint contrast, written as a quotient.
    root = np.sqrt(np.maximum(total**2 - swing**2, 0.0))
    return spread.mean(swing**2 / (total + root))


def unweighted_variance(
    iota: ArrayLike, alpha: ArrayLike, variance: float, spread: FrameSpread = STEADY
) -> F64:
    """Variance (rad²) of one frame with equal weights: twice the bound's at full contrast."""
    square = spread.amplitude**2
    noise = np.asarray(iota, float)[..., None] * spread.level + variance
    power = np.asarray(alpha, float) ** 2 * spread.mean(square) ** 2
    return np.asarray(2 * spread.mean(square * noise) / power)


def sampling_loss(iota: float, alpha: float, variance: float, phases: F64) -> tuple[float, float]:
    """Frames needed with given phases (t,), over uniform ones: at the median and worst phase.

    Few phases favour some pixels and mix iota, alpha and phase: infinite where they are not told.
    """
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


@dataclass(frozen=True)
class WeightErrors:
    """Cost of wrong weights: relative increase in frames per squared error.

    Weights ``(1 + e(u)) / variance`` add the variance of e over the phases, by their information.
    """

    # for each e-² of a constant error of a sample's variance: a wrong bias or read noise
    offset: float
    scale: float  # for a relative error of the light, squared: a wrong flat

    @classmethod
    def of(cls, iota: float, alpha: float, variance: float) -> "WeightErrors":
        """For a pixel; parameters as `phase_information`."""
        u = 2 * np.pi * (np.arange(TURN * 8) + 0.5) / (TURN * 8)
        light = iota + alpha * np.sin(u)
        noise = light + variance
        weight = np.cos(u) ** 2 / noise
        weight /= weight.sum()

        def scatter(values: F64) -> float:
            return float(weight @ values**2 - (weight @ values) ** 2)

        return cls(scatter(1 / noise), scatter(light / noise))
