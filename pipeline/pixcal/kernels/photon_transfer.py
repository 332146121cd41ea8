"""Photon transfer: noise against level, from pairs of frames. `gain_fit` fits the gain to it.

The difference of two frames of the same scene contains neither scene nor response map, only noise.
Half its variance, in ADU, is ``level / gain + read_variance``. It is measured in blocks of pixels,
whose level may differ within the block: both sides of that equation are means over the same pixels,
and a pixel's mean and difference are uncorrelated for Poisson light (given the sum of two Poisson
counts, the expected square of their difference is that sum), so structured light does not bias the
slope.

Charge that neighbours share lowers the variance of single pixels and raises the measured gain: in
proportion to the signal with crosstalk (Moore, Ninkov & Forrest 2006), with a curved relation for
brighter-fatter. The missing noise is in the covariances of neighbours, which are measured up to
`REACH` and added with their posterior weight.
"""

import math
from itertools import product
from typing import Any

import numpy as np

from pixcal.kernels import kernel
from pixcal.kernels.bilinear import FAST
from pixcal.kernels.medians import SIGMA_OF_MAD
from pixcal.kernels.robust import clipped_variance_factor, median_and_deviation
from pixcal.model.arrays import F32, F64

BLOCK = 16  # pixels along each side of a block
N_BINS = 512  # bins of level: bin n holds `n² / 4` to `(n + 1)² / 4` ADU, the last one all above
REACH = 2  # pixels between neighbours whose covariance is measured, along each axis

# rows and columns from a pixel to its neighbours, each pair of pixels once
LAGS = np.array(
    [(y, x) for y in range(REACH + 1) for x in range(-REACH, REACH + 1) if (y, x) > (0, 0)]
)

# of the sums: degrees of freedom, level, variance and the covariance of each of `LAGS`
COLUMNS = 3 + len(LAGS)

SHARED = 4.0  # errors beyond which neighbours share noise
_EVERYWHERE = 0.5  # least over largest covariance of lags above which noise is common to all pixels
_SIZES = 12  # of covariances of neighbours that are tried
# least share of a block's pixels, along each axis, that have a neighbour at a lag in it
_PAIRED = 1 - REACH / BLOCK
_CLIP = 7.0  # pixels of a population of unequal noise are no outliers
_MIN_PIXELS = 32  # fewest to separate outliers from noise


@kernel(fastmath=FAST, error_model="numpy")
def _add_blocks(
    first: F32, second: F32, per_level: float, read_variance: float, quantum: float,
    centre: F32, spread: F32, lags: Any, used: F32, there: F32, out: F64,
) -> None:  # fmt: skip
    slope, floor = np.float32(per_level), np.float32(read_variance)
    clip, step = np.float32(_CLIP), np.float32(quantum)
    columns, zero = -(-first.shape[1] // BLOCK), np.float32(0)
    # ``used`` and ``there`` are scratch. Flat, with zeros between the rows and after them: a
    # neighbour is so many places on.
    width = BLOCK + REACH
    for block in range(len(out)):
        # With too few pixels it is NaN, and nothing is within the limits.
        middle, wide = centre[block], spread[block]
        y0, x0 = block // columns * BLOCK, block % columns * BLOCK
        for i in range(used.size):
            used[i], there[i] = zero, zero
        n = total = square = level = zero
        for y in range(min(BLOCK, first.shape[0] - y0)):
            one, two = first[y0 + y, x0 : x0 + BLOCK], second[y0 + y, x0 : x0 + BLOCK]
            row, has = used[y * width :], there[y * width :]
            for x in range(one.size):
                a, b = one[x], two[x]
                mean, d = np.float32(0.5) * (a + b), a - b
                sigma = np.sqrt(max(mean, zero) * slope + floor)
                # The median deviation of integers may be zero.
                limit = clip * np.sqrt((wide * sigma) ** 2 + step * step) + step
                inside = abs(d - middle * sigma) <= limit
                row[x], has[x] = d if inside else zero, inside
                n, total, square = n + has[x], total + row[x], square + row[x] * row[x]
                level += mean if inside else zero
        if n < 2:
            continue
        variance = np.float32(0.5) * (square - total * total / n) / (n - 1)
        out[block, 0], out[block, 1], out[block, 2] = n - 1, level / n, variance
        for i in range(BLOCK * width):
            used[i] -= there[i] * (total / n)
        for lag in range(len(lags)):
            on = lags[lag, 0] * width + lags[lag, 1]
            others, are = used[on:], there[on:]
            pairs = product = zero
            for i in range(BLOCK * width):
                pairs += there[i] * are[i]
                product += used[i] * others[i]
            # The subtracted mean is of the same pixels: it removes 1 / n of the variance.
            if pairs > 0:
                out[block, 3 + lag] = np.float32(0.5) * product / pairs + variance / n


def pair_statistics(
    first: F32, second: F32, *, gain: float, read_noise: float, quantum: float
) -> F64:
    """Level and noise of the blocks of a pair of frames.

    Returns (block, COLUMNS): degrees of freedom, level (ADU), variance of one sample (ADU²) without
    outliers, corrected for the clipping, and covariance (ADU²) of pixels apart by each of `LAGS`.
    All zero for blocks of fewer than 32 pixels.

    first, second : (y, x) frames of the same scene, made equally bright, ADU above bias and dark;
        NaN is not used
    gain, read_noise : rough guess, e-/ADU and ADU, only to separate outliers from noise where the
        level changes within a block
    quantum : step of the samples, ADU
    """
    pair = np.ascontiguousarray(first, np.float32), np.ascontiguousarray(second, np.float32)
    level = np.maximum(np.float32(0.5) * (pair[0] + pair[1]), np.float32(0))
    sigma = np.sqrt(level * np.float32(1 / gain) + np.float32(read_noise**2))
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = (pair[0] - pair[1]) / sigma
    # Over the expected noise, (place in a block, block); NaN beyond the frame.
    beyond = [(0, -n % BLOCK) for n in ratio.shape]
    padded = np.pad(ratio, beyond, constant_values=np.nan)
    blocks = padded.reshape(padded.shape[0] // BLOCK, BLOCK, -1, BLOCK).transpose(1, 3, 0, 2)
    ratios = np.ascontiguousarray(blocks.reshape(BLOCK * BLOCK, -1))
    few = np.isfinite(ratios).sum(axis=0) < _MIN_PIXELS
    centre, spread = median_and_deviation(ratios)
    centre[few] = np.nan
    out = np.zeros((len(few), COLUMNS))
    spread *= np.float32(SIGMA_OF_MAD)
    scratch = np.empty((2, (BLOCK + REACH) * (BLOCK + REACH + 1)), np.float32)
    _add_blocks(*pair, 1 / gain, read_noise**2, quantum, centre, spread, LAGS, *scratch, out)
    out[:, 2:] /= clipped_variance_factor(_CLIP)
    return out


def bin_pairs(blocks: F64) -> F64:
    """Sums (N_BINS, COLUMNS) over blocks of similar level, of what `pair_statistics` gives.

    Degrees of freedom; the same times level, variance and covariances. May be added.
    """
    dof, level, *_ = blocks.T
    bins = np.minimum(2 * np.sqrt(np.maximum(level, 0)), N_BINS - 1).astype(int)
    sums = (np.bincount(bins, w, N_BINS) for w in (dof, *(dof * v for v in blocks.T[1:])))
    # Without blocks numpy counts in integers.
    return np.stack(list(sums), axis=1).astype(float)


# Prior of the covariances of neighbours over the shot noise: normal numbers that fall off with a
# power of the distance. All of a kernel have one size in common, and each differs from it by `_OWN`
# times as much. The size is zero with probability `_NOTHING`, or any from the smallest (or from the
# error, if that is less) to the largest.
_NOTHING, _SMALLEST, _LARGEST, _OWN = 0.3, 2e-3, 0.1, 0.3
_POWERS = (2.0, 3.0, 6.0)  # of charge that pushes (2, 3), of capacitance


def _shared_noise(shares: F64, error: float) -> tuple[F64, float]:
    """Weight of each share in the common noise, and its variance."""
    # ``shares``: covariances (12,) at `LAGS` over the shot noise, each with this error. The average
    # over sizes and powers, each with the weight of its evidence, as of the gain (`gain_fit`).
    count = len(LAGS)
    # The mean subtracted from a block is of shared noise, and so larger.
    seen, twice = np.eye(count) - 2 / BLOCK**2, 2 * (1 + 1 / BLOCK**2)
    logs, weights, variances = [0.0], [np.zeros(count)], [0.0]
    sizes = np.geomspace(min(error, _SMALLEST), _LARGEST, _SIZES)
    for power, size in product(_POWERS, sizes):
        falling = size * np.hypot(*LAGS.T) ** -power
        before = np.outer(falling, falling) + np.diag((_OWN * falling) ** 2)
        spread = seen @ before @ seen.T / error**2 + np.eye(count)
        learnt = before @ seen.T @ np.linalg.inv(spread) / error**2
        unlikely = shares @ (np.linalg.solve(spread, shares) - shares) / error**2
        logs.append(-(unlikely + np.linalg.slogdet(spread)[1]) / 2)
        weights.append(twice * learnt.sum(axis=0))
        variances.append(twice**2 * float((before - learnt @ seen @ before).sum()))
    some = (1 - _NOTHING) / (len(logs) - 1)
    chance = np.exp(np.array(logs) - max(logs)) * [_NOTHING, *[some] * (len(logs) - 1)]
    chance /= chance.sum()
    weight = chance @ np.array(weights)
    apart = (np.array(weights) - weight) @ shares
    return weight, float(chance @ (np.array(variances) + apart**2))


def add_neighbours(lit: F64, dark: F64) -> tuple[F64, dict[tuple[int, int], float], float]:
    """Noise of pixels with the covariances of neighbours added.

    Covariances beyond those without light are added to the variance of the pixel itself, twice for
    the two neighbours. Each is too noisy alone: all lags together give their posterior weights. The
    noise of the added covariances is in the degrees of freedom.

    ``lit`` and ``dark`` are from `bin_pairs`, of flats and of frames without light. Returns sums
    (N_BINS, 3) of degrees of freedom, level and variance; the lags (y, x) that count for more than
    half with their significance, which may be due to chance below `SHARED`, or (0, 0) alone where
    all pixels share noise; and the relative error of the shot noise, and so of the gain, common to
    all levels, as neighbours may share more or less than was added.
    """
    sums = lit[:, :3].copy()
    used = np.flatnonzero((lit[:, 0] > 0) & (lit[:, 1] > 0))
    without = dark.sum(axis=0)
    if not len(used) or not without[0] > 0:
        return sums, {}, 0.0
    none = without / without[0]
    dof = lit[used, 0]
    level, variance = (lit[used, 1:3] / dof[:, None]).T
    beyond = lit[used, 3:] / dof[:, None] - none[3:]
    weight = dof * level / np.maximum(variance, 1e-100) ** 2
    error = math.hypot(
        math.sqrt((weight**2 * variance**2 / dof).sum()),
        weight.sum() * none[2] / math.sqrt(without[0]),
    )
    shared, shot = weight @ beyond, float(weight @ (variance - none[2]))
    if shared.min() > _EVERYWHERE * shared.max() and shared.min() > SHARED * error:
        return sums, {(0, 0): float(shared.min() / error)}, 0.0
    if not shot > 0:
        return sums, {}, 0.0
    noise = error / shot
    counted, unknown = _shared_noise(shared / shot, noise / _PAIRED)
    of_added = float((counted**2).sum())
    sums[used, 2] += dof * (beyond @ counted)
    sums[used] /= 1 + of_added / 2
    errors = np.abs(shared) * _PAIRED / error
    lags = {
        (y, x): float(e)
        for (y, x), e, times in zip(LAGS.tolist(), errors, counted, strict=True)
        if times > 1
    }
    return sums, lags, math.sqrt(max(unknown - of_added * noise**2, 0.0))
