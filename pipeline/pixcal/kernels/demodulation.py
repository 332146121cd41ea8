"""Local phase of fringes: sums of a small linear model in windows that follow the fringes.

The frame is first divided by a smooth illumination. What is left in each window is a quadratic
background and fringes whose contrast and phase may change linearly,
``b0 + b1 u + b2 v + b3 u² + b4 u v + b5 v² + (1, u, v) × (cos P, sin P)``, u and v from -1 to 1
across and along the fringes and P a smooth carrier. The normal equations of this model add up:
windows may be cut by any tiling of the frame.
"""

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pixcal.kernels.normal_matrix import symmetric
from pixcal.model.arrays import F64, Mask

N_TERMS = 12
# where the terms of cos P and sin P begin; the first of each is that of the window's centre
COSINE, SINE = 6, 9
# upper triangle of the normal matrix, right-hand side, sum of squares, number of samples
N_SUMS = N_TERMS * (N_TERMS + 1) // 2 + N_TERMS + 2


@njit(cache=True, nogil=True, inline="always")  # type: ignore[untyped-decorator]
def _horner(coefficients: F64, x: float) -> float:
    value = 0.0
    for n in range(coefficients.size - 1, -1, -1):
        value = value * x + coefficients[n]
    return value


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def window_sums(
    signal: NDArray[Any],
    good: Mask,
    start: tuple[int, int],
    layout: F64,
    first: tuple[int, int],
    carrier: F64,
    light: F64,
    frame: F64,
    sums: F64,
) -> None:
    """Add the samples of a tile to the sums of the windows that it touches.

    Parameters
    ----------
    signal, good : (y, x) electrons, and samples to use
    start : (y, x) of the tile's first pixel
    layout : (6,) direction cosines (x, y) across the fringes, first edge across and along, and size
        across and along of the windows, px
    first : number across and along of the window that ``sums[0, 0]`` belongs to
    carrier, light : (n, n) phase P in rad, ``sum carrier[i, j] Y^i X^j``, and logarithm of the
        smooth illumination in the same way
    frame : (3,) ``X = (x - frame[0]) / frame[2]``, ``Y = (y - frame[1]) / frame[2]``
    sums : (across, along, N_SUMS), added to
    """
    ux, uy, edge_u, edge_v, width, length = layout
    row, light_row = np.empty(carrier.shape[0]), np.empty(light.shape[0])
    term = np.empty(N_TERMS)
    for n in range(signal.shape[0]):
        y = float(start[0] + n)
        scaled = (y - frame[1]) / frame[2]
        for j in range(row.size):
            row[j] = _horner(carrier[:, j], scaled)
        for j in range(light_row.size):
            light_row[j] = _horner(light[:, j], scaled)
        for m in range(signal.shape[1]):
            if not good[n, m]:
                continue
            x = float(start[1] + m)
            across = (ux * x + uy * y - edge_u) / width
            along = (ux * y - uy * x - edge_v) / length
            i, j = int(np.floor(across)), int(np.floor(along))
            u, v = 2 * (across - i) - 1, 2 * (along - j) - 1
            place = sums[i - first[0], j - first[1]]
            scaled = (x - frame[0]) / frame[2]
            phase = _horner(row, scaled)
            c, s = np.cos(phase), np.sin(phase)
            term[0], term[1], term[2] = 1.0, u, v
            term[3], term[4], term[5] = u * u, u * v, v * v
            term[6], term[7], term[8] = c, u * c, v * c
            term[9], term[10], term[11] = s, u * s, v * s
            value = float(signal[n, m]) * np.exp(-_horner(light_row, scaled))
            at = 0
            for p in range(N_TERMS):
                for q in range(p, N_TERMS):
                    place[at] += term[p] * term[q]
                    at += 1
            for p in range(N_TERMS):
                place[at + p] += term[p] * value
            place[at + N_TERMS] += value * value
            place[at + N_TERMS + 1] += 1.0


def solve_windows(sums: F64) -> tuple[F64, F64, F64]:
    """Phase of each window from its sums (window, N_SUMS), its error and its light.

    The phase is delta in ``cos(P + delta)`` at the window's centre, rad, in ±pi; the error is from
    the scatter about the model, rad, infinite where nothing can be said; the light is the mean at
    the centre, in units of the illumination.
    """
    count = sums[:, -1]
    phase, background = np.zeros(len(sums)), np.zeros(len(sums))
    sigma = np.full(len(sums), np.inf)
    use = np.flatnonzero(count >= 3 * N_TERMS)
    size = N_TERMS * (N_TERMS + 1) // 2
    normal = symmetric(sums[use, :size])
    scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-300))
    normal /= scale[:, :, None] * scale[:, None, :]
    # Far below rounding of good windows; those that it changes get errors beyond use.
    normal += 1e-13 * np.eye(N_TERMS)
    inverse = np.linalg.inv(normal)
    right = sums[use, size : size + N_TERMS] / scale
    solved = np.einsum("nij,nj->ni", inverse, right)
    rest = sums[use, -2] - np.einsum("ni,ni->n", solved, right)
    # The difference of two large numbers keeps so many digits.
    variance = np.maximum(rest, 1e-15 * sums[use, -2]) / (count[use] - N_TERMS)
    theta, pair = solved / scale, [COSINE, SINE]
    covariance = inverse[:, pair][:, :, pair] / (scale[:, pair, None] * scale[:, None, pair])
    a, b = theta[:, COSINE], theta[:, SINE]
    square = np.maximum(a * a + b * b, 1e-300)
    slope = np.stack([b, -a], axis=1) / square[:, None]
    error = variance * np.einsum("ni,nij,nj->n", slope, covariance, slope)
    phase[use], background[use] = np.arctan2(-b, a), theta[:, 0]
    sigma[use] = np.where(error > 0, np.sqrt(np.abs(error)), np.inf)
    return phase, sigma, background
