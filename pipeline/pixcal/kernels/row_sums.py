"""Sums over the pixels of each row of every frame, for a weighted fit of terms in the frames."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

MODES = 5  # light, cosine, sine, and the turns of the fringe vector along x and y
_FAST = {"reassoc", "contract", "nsz", "arcp"}


@njit(cache=True, nogil=True, fastmath=_FAST)  # type: ignore[untyped-decorator]
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
    inner : (t, 5, 5) float64
        Of the modes with each other, over the frame.
    of_rest : (t, 5) float64
        Of the modes with the residuals, over the frame.
    across : (t, y, 5) float64
        Of the modes with the light, by row.
    own : (y, 2) float64
        Of the light with itself and with the residuals, over all frames.
    """
    nt, ny, nx = rest.shape
    inner, of_rest = np.zeros((nt, MODES, MODES)), np.zeros((nt, MODES))
    across, own = np.zeros((nt, ny, MODES)), np.zeros((ny, 2))
    for t in range(nt):
        c, s = g[t, 1], g[t, 2]
        for row in range(ny):
            # By powers of x: y is one number in a row.
            i00 = i01 = i02 = i11 = i12 = i22 = np.float32(0)
            i03 = i13 = i23 = i33 = i04 = i14 = i24 = i34 = i44 = np.float32(0)
            r0 = r1 = r2 = r3 = r4 = a0 = a1 = a2 = a3 = a4 = ll = lr = np.float32(0)
            for i in range(nx):
                w, r, one = weight[t, row, i], rest[t, row, i], light[t, row, i]
                h0, h1, h2 = theta[0, row, i], theta[1, row, i], theta[2, row, i]
                h4 = c * h2 - s * h1
                h3 = h4 * x[i]
                w0, w1, w2, w3, w4 = w * h0, w * h1, w * h2, w * h3, w * h4
                i00 += w0 * h0
                i01 += w0 * h1
                i02 += w0 * h2
                i03 += w0 * h3
                i04 += w0 * h4
                i11 += w1 * h1
                i12 += w1 * h2
                i13 += w1 * h3
                i14 += w1 * h4
                i22 += w2 * h2
                i23 += w2 * h3
                i24 += w2 * h4
                i33 += w3 * h3
                i34 += w3 * h4
                i44 += w4 * h4
                r0 += w0 * r
                r1 += w1 * r
                r2 += w2 * r
                r3 += w3 * r
                r4 += w4 * r
                a0 += w0 * one
                a1 += w1 * one
                a2 += w2 * one
                a3 += w3 * one
                a4 += w4 * one
                ll += w * one * one
                lr += w * one * r
            v = y[row]
            upper = (
                (i00, i01, i02, i03, i04 * v),
                (i01, i11, i12, i13, i14 * v),
                (i02, i12, i22, i23, i24 * v),
                (i03, i13, i23, i33, i34 * v),
                (i04 * v, i14 * v, i24 * v, i34 * v, i44 * v * v),
            )
            for m in range(MODES):
                for n in range(MODES):
                    inner[t, m, n] += upper[m][n]
            for m, value in enumerate((r0, r1, r2, r3, r4 * v)):
                of_rest[t, m] += value
            for m, value in enumerate((a0, a1, a2, a3, a4 * v)):
                across[t, row, m] = value
            own[row, 0] += ll
            own[row, 1] += lr
    return inner, of_rest, across, own
