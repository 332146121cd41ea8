"""Read noise of a converter with missing codes, which change noise and mean levels.

A sample whose code is missing gets a neighbouring code. The variance of noise of a few codes then
depends on the level; the noise is found from a model of the conversion, pixel by pixel. Noise below
a quarter of the widest gap is poorly constrained. The counts of all samples show which neighbour
replaces a missing code. All in codes.
"""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.optimize import brentq
from scipy.special import ndtr

from pixcal.kernels.medians import median_and_sigma
from pixcal.model.arrays import F64, I64

POPULATED = 20.0  # counts on both sides from which an empty code is missing
_BLOCK = 32  # codes whose shifts are summed
_NEAR = 4  # codes examined on either side
_FINE = 16  # levels per code
_REACH = 8.0  # of the noise
_USUAL = 5.0  # spreads of the means of usual pixels
_LEAST = 0.5  # least noise: below it samples do not leave a wide code
_MOST = 500  # largest range of levels
_STANDS_IN = (0.5, -0.5, 0.0)  # next code, code before, nearest: thresholds relative to the middle


def missing_codes(counts: F64) -> I64:
    """Codes that never occur in ``counts`` (code,) though some just below and just above do."""
    # Between the noise of two levels, as of the colours of a camera, no code is missing: counts
    # fall off towards the gap so steeply that none is expected there.
    empty, there = np.flatnonzero(counts == 0), np.flatnonzero(counts > 0)
    if len(there) < 2:
        return empty[:0]
    above = np.clip(np.searchsorted(there, empty), 1, len(there) - 1)
    missing = np.ones(len(empty), np.bool_)
    for at, step in ((above - 1, -1), (above, 1)):
        near, next_on = there[at], there[np.clip(at + step, 0, len(there) - 1)]
        # Counts of a normal distribution fall off ever more steeply.
        expected = counts[near] * np.minimum(counts[near] / counts[next_on], 1.0)
        away = (near - empty) * step
        missing &= (away > 0) & (away <= _NEAR)
        missing &= expected > POPULATED
    return empty[missing]


def step_noise(counts: F64) -> tuple[float, float]:
    """Noise that missing codes add to samples whose own noise spans many codes.

    Returns the variance of the shifts of samples, and their spectral density at low frequency over
    codes: it changes the slope of the mean level, and so the noise, from level to level.
    """
    beside = np.pad(counts, _NEAR)
    often = sliding_window_view(beside, 2 * _NEAR + 1).max(axis=1) > POPULATED
    there = np.flatnonzero((counts > 0) & often)
    begins = np.concatenate([there[:1], there[:-1] + 1])
    near = there - begins < 2 * _NEAR
    moved = np.concatenate(
        [
            np.arange(end - begin, -1, -1)
            for begin, end in zip(begins[near], there[near], strict=True)
        ]
    )
    blocks = moved[: len(moved) // _BLOCK * _BLOCK].reshape(-1, _BLOCK).sum(axis=1)
    density = float(blocks.var()) / _BLOCK if len(blocks) > 1 else 0.0
    return float(moved.var()), density


def noise_before_missing_codes(
    variance: float, error: float, means: F64, frames: int, counts: F64, step: float = 1.0
) -> tuple[float, float] | None:
    """Noise whose variance after conversion, averaged over pixels, is that given; and its error.

    None where no noise does.

    variance, error : of a sample, on average over the pixels, and its standard error
    means : (n,) mean samples of such pixels over ``frames`` frames
    counts : (code,) how often each code occurred
    step : of the converter, if all of its codes were multiplied by it
    """
    middle, spread = median_and_sigma(means)
    low, high = middle + np.array([-1, 1]) * max(_USUAL * spread, 1.0)
    margin = _REACH * np.sqrt(variance) + 2
    if high - low + 2 * margin > _MOST:
        return None
    means = means[(means >= low) & (means <= high)]
    codes = np.arange(int(low - margin), int(high + margin) + 1)
    codes = codes[~np.isin(codes, missing_codes(counts))]
    level = np.arange(low - 2, high + 2, 1 / _FINE)
    best: tuple[float, float, float] | None = None
    gaps = np.diff(codes)
    laws = [(codes[1:] + codes[:-1]) / 2 - side * (gaps - 1) for side in _STANDS_IN]
    if step > 1:
        laws.append((np.rint(codes[1:] / step) - 0.5) * step)
    for begins in laws:

        def reached(sigma: float, begins: F64 = begins) -> F64:
            return np.asarray(ndtr((level[:, None] - begins) / sigma))

        def moments(sigma: float, gaps: I64 = gaps) -> tuple[F64, F64]:
            chance, first = reached(sigma), float(codes[0])
            mean = first + chance @ gaps
            return mean, first**2 + chance @ np.diff(codes**2.0) - mean**2

        def excess(sigma: float) -> float:
            table = moments(sigma)
            seen = _variance_at(means, np.interp(means, *table) / frames, *table)
            return float(seen.mean()) - variance

        least, most = _LEAST, float(np.sqrt(variance)) + 1
        if not excess(least) < 0 < excess(most):
            continue
        sigma = float(brentq(excess, least, most, xtol=1e-4))
        slope = (excess(1.01 * sigma) - excess(sigma)) / (0.01 * sigma)
        at = np.interp(means, moments(sigma)[0], level)
        share = np.bincount(np.rint((at - level[0]) * _FINE).astype(int), minlength=len(level))
        chance = -share @ np.diff(reached(sigma), prepend=1.0, append=0.0)
        seen = np.where(codes < len(counts), counts[np.minimum(codes, len(counts) - 1)], 0.0)
        misfit = float(np.sum((seen / seen.sum() - chance / chance.sum()) ** 2))
        if slope > 0 and (best is None or misfit < best[0]):
            best = misfit, sigma, error / slope
    return best and best[1:]


def _variance_at(mean: F64, error: F64, means: F64, variances: F64) -> F64:
    """Variances of samples at means with errors (variances), corrected for bias by these."""
    curvature = np.gradient(np.gradient(variances, means), means)
    at = np.interp(mean, means, variances)
    return np.asarray(at - np.interp(mean, means, curvature) * error / 2)
