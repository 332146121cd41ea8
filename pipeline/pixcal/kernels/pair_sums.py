"""Products of residuals of two neighbours, summed for a fit of what they are made of."""

from typing import Any

import numpy as np

from pixcal.kernels import kernel
from pixcal.model.arrays import F32, F64

_TERMS = 4


def pair_sums(
    residual: F32,
    variance: F32,
    charge: F32,
    shared: tuple[F32, F32],
    covariance: F32,
    of_place: F32,
    step: tuple[int, int],
    margin: int,
) -> tuple[F64, F64]:
    """Normal matrix (4, 4) and right-hand side (4,) for products of pixels at a step.

    The terms are a constant, the sum of the two charges, and what is ``shared`` in two ways. A
    product has the weight of one over the product of the two variances.

    Parameters
    ----------
    residual, variance, charge : (t, y, x) float32; pairs of which a residual is zero have no weight
    shared : two (t, y, x) float32, at the first pixel of each pair
    covariance, of_place : (t, j, j), (j, y, x) float32 of the functions of place that each frame
        was free to have: what they took off the product of two residuals is put back
    step : rows (not negative) and columns to the second pixel
    margin : pixels along the edges that are not used
    """
    sums = np.zeros((_TERMS, _TERMS + 1))
    _sum(residual, variance, charge, *shared, covariance, of_place, *step, margin, sums)
    normal = np.triu(sums[:, :_TERMS])
    return normal + np.triu(normal, 1).T, sums[:, _TERMS]


# Sums of a row in any order. Views of rows have no negative index: only then loops are vectorised.
@kernel(fastmath={"reassoc", "contract"})
def _sum(
    residual: Any, variance: Any, charge: Any, shared1: Any, shared2: Any, covariance: Any,
    of_place: Any, dy: int, dx: int, margin: int, sums: Any,
) -> None:  # fmt: skip
    frames, ny, nx = residual.shape
    left, right = margin + max(0, -dx), nx - margin - max(0, dx)
    taken, share = np.empty((2, max(0, right - left)), np.float32)
    zero = np.float32(0)
    for t in range(frames):
        for y in range(margin, ny - margin - dy):
            one, other = residual[t, y, left:right], residual[t, y + dy, left + dx : right + dx]
            var1, var2 = variance[t, y, left:right], variance[t, y + dy, left + dx : right + dx]
            q1, q2 = charge[t, y, left:right], charge[t, y + dy, left + dx : right + dx]
            first, second = shared1[t, y, left:right], shared2[t, y, left:right]
            taken[:] = 0
            for i in range(len(of_place)):
                share[:] = 0
                for j in range(len(of_place)):
                    factor = covariance[t, i, j]
                    there = of_place[j, y + dy, left + dx : right + dx]
                    for x in range(right - left):
                        share[x] += factor * there[x]
                here = of_place[i, y, left:right]
                for x in range(right - left):
                    taken[x] += share[x] * here[x]
            n = n_q = n_a = n_b = qq = qa = qb = aa = ab = bb = r = rq = ra = rb = zero
            for x in range(right - left):
                product = one[x] * other[x]
                w = np.float32(1) / (var1[x] * var2[x]) if product != 0 else zero
                product = product + taken[x]
                q, a, b = q1[x] + q2[x], first[x], second[x]
                n += w
                n_q += w * q
                n_a += w * a
                n_b += w * b
                qq += w * q * q
                qa += w * q * a
                qb += w * q * b
                aa += w * a * a
                ab += w * a * b
                bb += w * b * b
                r += w * product
                rq += w * product * q
                ra += w * product * a
                rb += w * product * b
            row = ((n, n_q, n_a, n_b, r), (zero, qq, qa, qb, rq), (zero, zero, aa, ab, ra),
                   (zero, zero, zero, bb, rb))  # fmt: skip
            for i in range(_TERMS):
                for j in range(_TERMS + 1):
                    sums[i, j] += row[i][j]
