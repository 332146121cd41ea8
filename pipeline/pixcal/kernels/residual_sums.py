"""Sums of products of neighbouring residuals, to fit their covariance linearly in the level."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels import kernel
from pixcal.model.arrays import F32, F64, Indices, Mask


def residual_sums(
    rest: F32,
    model: F32,
    shot_factor: F64,
    read: F64,
    good: Mask,
    of_time: NDArray[np.floating],
    of_pixels: NDArray[np.floating],
    taken: F64,
    steps: Indices,
    limit: float,
) -> F64:
    """Sums (step, 7) for ``product = a shot + b read`` of residuals, by steps between pixels.

    ``shot`` and ``read`` are means of the two pixels' variances; all terms are divided by the root
    of the product of their variances, so that every product has the same weight. The sums are: the
    number, the normal matrix (11, 12, 22), the right-hand side (1, 2), the squared products.

    rest, model : (t, y, x) residuals (NaN without weight) and their model, e-
    shot_factor, read : (y, x) variance of a sample: ``shot_factor * model + read``, e-²
    good : (y, x) bool
    of_time, of_pixels : (t, k), (k, y, x); their product over the variance is the share of a
        sample's variance that the fit of its pixel absorbed
    taken : (step,) covariance that the frames' fits removed, as a share of the variance
    steps : (step, 2) rows (not negative) and columns
    limit : standard deviations beyond which a residual has no weight
    """
    sums = np.zeros((len(steps), 7))
    arrays = (shot_factor, read, of_time, of_pixels, taken)
    factor, still, *fitted = (np.ascontiguousarray(a, np.float32) for a in arrays)
    # Outside compiled code, where it would take longer to compile.
    frame, line = np.empty((3, *good.shape), np.float32), np.empty(good.shape[1], np.float32)
    _sum(rest, model, factor, still, good, *fitted, steps, np.float32(limit), line, *frame, sums)
    return sums


# Row sums may be reordered; comparisons with NaN keep their meaning.
@kernel(fastmath={"reassoc", "contract"})
def _sum(
    rest: Any, model: Any, factor: Any, read: Any, good: Any, of_time: Any, of_pixels: Any,
    taken: Any, steps: Any, limit: Any, fitted: Any, signal: Any, root: Any, size: Any, sums: Any,
) -> None:  # fmt: skip
    frames, ny, nx = rest.shape
    for t in range(frames):
        for y in range(ny):
            for x in range(nx):
                fitted[x] = 0
            for k in range(of_pixels.shape[0]):
                share = of_time[t, k]
                for x in range(nx):
                    fitted[x] += share * of_pixels[k, y, x]
            for x in range(nx):
                charge = np.float32(model[t, y, x])
                charge = charge * factor[y, x] if charge > 0 else np.float32(0)
                weight = np.float32(1) / (charge + read[y, x])
                value = np.float32(rest[t, y, x]) * np.sqrt(weight)
                used = good[y, x] & (abs(value) <= limit)  # false for NaN
                left = np.sqrt(np.float32(1) - fitted[x] * weight)
                signal[y, x] = charge
                root[y, x] = np.sqrt(weight) if used else np.float32(0)
                size[y, x] = value / left if used else np.float32(0)
        for n in range(len(steps)):
            dy, dx = steps[n, 0], steps[n, 1]
            low, high = max(0, -dx), nx - max(0, dx)
            for y in range(ny - dy):
                # Views without negative indices: only then are loops vectorised.
                root1, root2 = root[y, low:high], root[y + dy, low + dx : high + dx]
                size1, size2 = size[y, low:high], size[y + dy, low + dx : high + dx]
                signal1, signal2 = signal[y, low:high], signal[y + dy, low + dx : high + dx]
                read1, read2 = read[y, low:high], read[y + dy, low + dx : high + dx]
                count = s11 = s12 = s22 = p1 = p2 = square = np.float32(0)
                for x in range(high - low):
                    both = np.float32(0.5) * root1[x] * root2[x]
                    first = both * (signal1[x] + signal2[x])
                    second = both * (read1[x] + read2[x])
                    there = np.float32(both > 0)
                    product = size1[x] * size2[x] + taken[n] * there
                    count += there
                    s11 += first * first
                    s12 += first * second
                    s22 += second * second
                    p1 += first * product
                    p2 += second * product
                    square += product * product
                sums[n, 0] += count
                sums[n, 1] += s11
                sums[n, 2] += s12
                sums[n, 3] += s22
                sums[n, 4] += p1
                sums[n, 5] += p2
                sums[n, 6] += square
