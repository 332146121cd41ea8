"""Sums over the pixels of each row of every frame, for a weighted fit of terms in the frames."""

import numpy as np
from numba import njit

from pixcal.kernels.bilinear import FAST, add_normal, add_right
from pixcal.model.arrays import F32, F64

MODES = 5  # light, cosine, sine, and the turns of the fringe vector along x and y


@njit(cache=True, nogil=True, fastmath=FAST)  # type: ignore[untyped-decorator]
def row_sums(
    rest: F32, weight: F32, light: F32, g: F32, theta: F32, y: F32, x: F32
) -> tuple[F64, F64, F64, F64]:
    """Weighted products of a frame's light with itself, the residuals and the frame's own modes.

    The modes are what a frame's own fit can change: its light, cosine and sine (theta), and the
    turns of the fringe vector, ``(g1 theta2 - g2 theta1) x`` and with y.

    Parameters
    ----------
    rest, weight, light : (t, y, x) float32
        Residuals, finite; their weight; what is looked for in them.
    g : (t, 3) float32
    theta : (3, y, x) float32
        Finite.
    y, x : (y,), (x,) float32

    Returns
    -------
    inner : (t, 15) float64
        Of the modes with each other, over the frame: the upper triangle, row by row.
    of_rest : (t, 5) float64
        Of the modes with the residuals, over the frame.
    across : (t, y, 5) float64
        Of the modes with the light, by row.
    own : (y, 2) float64
        Of the light with itself and with the residuals, over all frames.
    """
    nt, ny, nx = rest.shape
    packed, of_rest = np.zeros((nt, MODES * (MODES + 1) // 2)), np.zeros((nt, MODES))
    across, own = np.zeros((nt, ny, MODES)), np.zeros((ny, 2))
    turn, of_light, ys = np.empty(nx, np.float32), np.empty(nx, np.float32), np.empty_like(x)
    weighted = np.empty(nx, np.float32)
    for t in range(nt):
        for row in range(ny):
            h0, h1, h2, w = theta[0, row], theta[1, row], theta[2, row], weight[t, row]
            squares = products = np.float32(0)
            for i in range(nx):
                r, one = rest[t, row, i], light[t, row, i]
                turn[i] = h2[i] * g[t, 1] - h1[i] * g[t, 2]
                weighted[i], of_light[i], ys[i] = w[i] * r, w[i] * one, y[row]
                squares += of_light[i] * one
                products += of_light[i] * r
            add_normal(h0, h1, h2, turn, w, ys, x, packed[t])
            add_right(h0, h1, h2, turn, weighted, ys, x, of_rest[t])
            add_right(h0, h1, h2, turn, of_light, ys, x, across[t, row])
            own[row, 0] += squares
            own[row, 1] += products
    return packed, of_rest, across, own
