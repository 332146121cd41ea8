"""How the products of residuals, of a pixel with itself and with a neighbour, go with the level."""

from typing import Any

import numpy as np
from numba import njit

from pixcal.model.arrays import F32, I64, Mask

N_SUMS = 7  # for each step: number, normal matrix (11, 12, 22), right-hand side (1, 2), square


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz", "arcp"})  # type: ignore[untyped-decorator]
def product_sums(
    rest: F32,
    model: F32,
    shot_factor: F32,
    read: F32,
    good: Mask,
    of_time: F32,
    of_pixels: F32,
    steps: I64,
    taken: F32,
    limit: float,
) -> Any:
    """Sums for ``product = a shot + b read``, by steps from a pixel to another.

    ``shot`` and ``read`` are means of the two pixels' variances; all is divided by the root of the
    product of their variances, so that every product has the same weight.

    Parameters
    ----------
    rest, model : (t, y, x) float32, residuals (NaN without weight) and their model, e-
    shot_factor, read : (y, x) float32, variance of a sample: ``shot_factor * model + read``, e-²
    good : (y, x) bool
    of_time, of_pixels : (t, k), (k, y, x) float32; their product over the variance is the share of
        a sample's variance that its pixel's own fit took up
    steps : (n, 2) int64, rows (not negative) and columns
    taken : (n,) float32, covariance that the frames' fits took off, as a share of the variance
    limit : standard deviations beyond which a residual has no weight

    Returns
    -------
    (n, N_SUMS) float64
    """
    frames, ny, nx = rest.shape
    sums = np.zeros((len(steps), 7))
    size, unit = np.empty((ny, nx), np.float32), np.empty((ny, nx), np.float32)
    shot, still = np.empty((ny, nx), np.float32), np.empty((ny, nx), np.float32)
    one, zero, half = np.float32(1), np.float32(0), np.float32(0.5)
    most = np.float32(limit)
    for t in range(frames):
        for y in range(ny):
            for x in range(nx):
                level = max(model[t, y, x], zero) * shot_factor[y, x]
                weight = one / (level + read[y, x])
                fitted = zero
                for k in range(of_time.shape[1]):
                    fitted += of_time[t, k] * of_pixels[k, y, x]
                inverse = np.sqrt(weight)
                value = rest[t, y, x] * inverse
                # False of NaN.
                here = good[y, x] & (np.abs(value) <= most)
                size[y, x] = value / np.sqrt(one - fitted * weight) if here else zero
                unit[y, x] = inverse if here else zero
                shot[y, x] = level * inverse if here else zero
                still[y, x] = read[y, x] * inverse if here else zero
        for n in range(len(steps)):
            dy, dx, lost = steps[n, 0], steps[n, 1], taken[n]
            for y in range(ny - dy):
                number = s11 = s12 = s22 = p1 = p2 = square = zero
                for x in range(max(0, -dx), nx - max(0, dx)):
                    v, u = y + dy, x + dx
                    first = half * (shot[y, x] * unit[v, u] + unit[y, x] * shot[v, u])
                    second = half * (still[y, x] * unit[v, u] + unit[y, x] * still[v, u])
                    there = one if second > zero else zero
                    product = size[y, x] * size[v, u] + lost * there
                    number += there
                    s11 += first * first
                    s12 += first * second
                    s22 += second * second
                    p1 += first * product
                    p2 += second * product
                    square += product * product
                sums[n, 0] += number
                sums[n, 1] += s11
                sums[n, 2] += s12
                sums[n, 3] += s22
                sums[n, 4] += p1
                sums[n, 5] += p2
                sums[n, 6] += square
    return sums
