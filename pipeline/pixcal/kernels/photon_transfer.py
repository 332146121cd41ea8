"""Photon transfer: noise against level from pairs of frames, and the gain from its slope.

The difference of two frames of the same scene holds no scene and no response map, only noise. Half
its variance, in ADU, is ``level / gain + read_variance``. It is measured in blocks of pixels, whose
level may differ within the block: both sides of that equation are means over the same pixels, and a
pixel's mean and difference are uncorrelated for Poisson light (given the sum of two Poisson counts,
the expected square of their difference is that sum), so structured light does not bias the slope.

Noise that neighbours share (crosstalk, brighter-fatter) lowers the variance and raises the gain
that comes out; photon transfer cannot tell (physics note, section 6).
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pixcal.kernels.robust import clipped_variance_factor

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

BLOCK = 16
"""Pixels along each side of a block."""

N_BINS = 512
"""Bins of level: bin n holds ``n² / 4`` to ``(n + 1)² / 4`` ADU, the last one all above."""

_CLIP = 5.0
_MIN_PIXELS = 32  # fewer do not tell outliers from noise
_SIGMA_OF_MAD = 1.482602218505602
_ITERATIONS = 4


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _block_statistics(
    first: Any, second: Any, gain: float, read_noise: float, quantum: float, clip: float, size: int
) -> Any:
    ny, nx = first.shape
    rows, columns = -(-ny // size), -(-nx // size)
    out = np.zeros((rows * columns, 3))
    ratio = np.empty(size * size)
    for block in range(rows * columns):
        y0, x0 = block // columns * size, block % columns * size
        y1, x1 = min(y0 + size, ny), min(x0 + size, nx)
        n = 0
        for y in range(y0, y1):
            for x in range(x0, x1):
                mean = 0.5 * (first[y, x] + second[y, x])
                sigma = math.sqrt(max(mean, 0.0) / gain + read_noise**2)
                if not math.isnan(mean):
                    ratio[n] = (first[y, x] - second[y, x]) / sigma
                    n += 1
        if n < _MIN_PIXELS:
            continue
        centre = np.median(ratio[:n])
        spread = _SIGMA_OF_MAD * np.median(np.abs(ratio[:n] - centre))
        n = 0
        total, square, level = 0.0, 0.0, 0.0
        for y in range(y0, y1):
            for x in range(x0, x1):
                mean = 0.5 * (first[y, x] + second[y, x])
                sigma = math.sqrt(max(mean, 0.0) / gain + read_noise**2)
                d = first[y, x] - second[y, x]
                # The median deviation of whole numbers may be nothing.
                limit = clip * math.sqrt((spread * sigma) ** 2 + quantum**2) + quantum
                if abs(d - centre * sigma) <= limit:
                    n += 1
                    total += d
                    square += d * d
                    level += mean
        if n > 1:
            out[block, 0] = n - 1
            out[block, 1] = level / n
            out[block, 2] = 0.5 * (square - total * total / n) / (n - 1)
    return out


def pair_statistics(
    first: F32, second: F32, *, gain: float, read_noise: float, quantum: float
) -> F64:
    """Level and noise of the blocks of a pair of frames.

    Parameters
    ----------
    first, second : (y, x) float32
        Two frames of the same scene, made equally bright, in ADU above bias and dark; NaN where a
        sample is not to be used.
    gain, read_noise : float
        Rough guess (e-/ADU; ADU, above zero), only to tell outliers from noise where the level
        changes within a block.
    quantum : float
        Step of the samples (ADU).

    Returns
    -------
    (block, 3) float64
        Degrees of freedom, level (ADU) and variance of one sample (ADU²), without outliers, the
        variance corrected for the clipping. All zero for the rest of a block at the edge that has
        fewer than 32 pixels.
    """
    out: F64 = _block_statistics(
        first.astype(float), second.astype(float), gain, read_noise, quantum, _CLIP, BLOCK
    )
    out[:, 2] /= clipped_variance_factor(_CLIP)
    return out


def bin_pairs(blocks: F64) -> F64:
    """Sums over blocks of similar level.

    Parameters
    ----------
    blocks : (block, 3) float64
        As `pair_statistics` gives them.

    Returns
    -------
    (N_BINS, 3) float64
        Degrees of freedom; the same times level; the same times variance. May be added.
    """
    dof, level, variance = blocks.T
    bins = np.minimum(2 * np.sqrt(np.maximum(level, 0)), N_BINS - 1).astype(int)
    sums = (np.bincount(bins, w, N_BINS) for w in (dof, dof * level, dof * variance))
    return np.stack(list(sums), axis=1)


@dataclass(frozen=True)
class GainFit:
    """Gain by photon transfer.

    Attributes
    ----------
    gain : float
        e-/ADU.
    error : float
        1 sigma, e-/ADU; widened where the points leave the line by more than their noise.
    chi2_reduced : float
        Of the points about the line.
    levels : (float, float)
        Lowest and highest level used, ADU.
    """

    gain: float
    error: float
    chi2_reduced: float
    levels: tuple[float, float]


def fit_gain(
    sums: F64, read_variance: float, read_variance_error: float, highest: float
) -> GainFit | None:
    """Fit the straight line from the read noise through the points of variance against level.

    The weights come from the line itself, never from the measured variances: those that are low
    by chance would weigh more.

    Parameters
    ----------
    sums : (N_BINS, 3) float64
        As `bin_pairs` gives them.
    read_variance, read_variance_error : float
        Variance at level zero and its error (ADU²).
    highest : float
        Highest level to use (ADU).

    Returns
    -------
    GainFit or None
        None when nothing is above the read noise.
    """
    dof = sums[:, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        level, variance = sums[:, 1] / dof, sums[:, 2] / dof
    used = (dof > 0) & (level > 0) & (level <= highest)
    dof, level, shot = dof[used], level[used], variance[used] - read_variance
    if not used.any() or not (dof * shot).sum() > 0:
        return None
    slope = (dof * shot).sum() / (dof * level).sum()
    weight = curvature = np.zeros(0)
    for _ in range(_ITERATIONS):
        weight = dof / (2 * (slope * level + read_variance) ** 2)
        curvature = (weight * level**2).sum()
        slope = (weight * level * shot).sum() / curvature
        if slope <= 0:
            return None
    chi2 = float((weight * (shot - slope * level) ** 2).sum() / max(len(level) - 1, 1))
    scatter = max(1.0, chi2) / curvature
    lever = (weight * level).sum() / curvature * read_variance_error
    error = math.sqrt(scatter + lever**2)
    return GainFit(
        float(1 / slope), float(error / slope**2), chi2, (float(level.min()), float(level.max()))
    )
