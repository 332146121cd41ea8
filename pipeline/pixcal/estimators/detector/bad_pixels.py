"""Which pixels are bad: one rule per flag, which is set only where there are data to decide.

The rules compare a pixel with others, and require a difference larger than the noise of the frames
can cause: on a perfect detector fewer than one pixel in 10⁵ is flagged.
"""

import math
from collections.abc import Sequence

import numpy as np
from scipy.special import chdtri

from pixcal.estimators.detector.calibration import MIN_STEPS, ExposureLevel
from pixcal.kernels.medians import median_and_sigma
from pixcal.kernels.robust import lit
from pixcal.model.arrays import F64, Mask

NEIGHBOURS = 16  # side (px) of the blocks whose median a pixel is compared with

# rows and columns to pixels of the same mosaic colour on squares about one; opposite ones are
# equally far from the two ends of the list
_AROUND = np.array(np.meshgrid(*[np.arange(-6, 7, 2)] * 2, indexing="ij")).reshape(2, -1).T
_RINGS = tuple(_AROUND[abs(_AROUND).max(axis=1) == reach] for reach in (2, 4, 6))
_FALSE_ALARM = 1e-6
_SIGNIFICANT = 5.0
_MANY_SIGNIFICANT = 6.0
_MIN_OUTLIERS = 3
_OUTLIER_SHARE = 0.02
_KURTOSIS_SIGMAS = 4.0
_KURTOSIS_SAMPLES = 32
_CURVES = 2
_DEGREE = 3
_FARTHEST = 4.0
_RARE = 0.1  # share of samples above which departures are not those of pixels or single columns
_CLIPPINGS = 4
_CLIP = 4.0
_POPULATION = 4.0  # standard deviations of log noise up to which pixels are of one population
_SPREAD_DOF, _QUANTILES = 8, 1000
# variance of few samples (square steps), times its squared freedom, below which it has few values
_COARSE = 12.0
_UNKNOWN_SPREAD = 0.7  # of the logarithm of variance over pixels, where codes do not tell it
_HALF_A_STEP = 1 / 4 + 1 / 12  # variance of noise of half a step, which hardly depends on the level
_QUARTILE = 0.6745  # of a normal distribution, in standard deviations
_FEWEST = 64
_SAMPLE = 4096


def hot(rate: F64, error: F64, sigma: float, limit: float) -> Mask:
    """Pixels with dark signal far above their neighbours; amplifier glow does not count.

    rate, error : (y, x) dark signal of each pixel and its standard error (ADU/s), starting at a
        block boundary
    sigma : robust spread of the detector's dark signals (ADU/s); the neighbours' may be larger
    limit : in units of ``sigma``
    """
    median, upper = _around(rate)
    excess, spread = rate - median, np.fmax(np.fmax(sigma, error), (upper - median) / _QUARTILE)
    return (excess > limit * spread) & (excess > _SIGNIFICANT * error) & (error > 0)


def dead(flat: F64, error: F64, low: float, high: float, floor: float) -> Mask:
    """Pixels with response far below or above their neighbours, or almost none.

    flat, error : (y, x) relative response and its standard error, starting at a block boundary
    low, high : limits in units of the median of the pixel's block, and of the upper quartile of
        its pixels above ``floor``: near a dark edge most may be unlit
    floor : lowest response of a lit pixel
    """
    median, upper = _around(flat)[0], _around(np.where(flat < floor, np.nan, flat))[1]
    below = (flat < low * median) & (median - flat > _SIGNIFICANT * error)
    above = (flat > high * upper) & (flat - upper > _SIGNIFICANT * error) & (flat > floor)
    unlit = flat < floor
    below[below & ~unlit] = _below_rings(flat, below & ~unlit, low)
    above[above] = _below_rings(-flat, above, high)
    return below | above | unlit


def _below_rings(flat: F64, where: Mask, factor: float) -> Mask:
    """Whether pixels (n,) are below ``factor`` times the median of a ring about them."""
    # Light falls steeply at the edge of the lit area, but pixels of a ring that lie along the edge
    # are equally bright. Around a cluster of dead pixels the widest ring reaches good ones.
    y, x = np.nonzero(where)
    below = np.zeros(len(y), np.bool_)
    for offsets in _RINGS:
        rows, columns = y[:, None] + offsets[:, 0], x[:, None] + offsets[:, 1]
        inside = (rows >= 0) & (rows < flat.shape[0]) & (columns >= 0) & (columns < flat.shape[1])
        values = np.where(
            inside, flat[np.where(inside, rows, 0), np.where(inside, columns, 0)], np.nan
        )
        # Only opposite pairs: a truncated ring would lie on one side of the edge.
        pairs = np.isfinite(values) & np.isfinite(values[:, ::-1])
        values[~pairs] = np.nan
        # Without pairs the block decides.
        values[~pairs.any(axis=1)] = np.inf
        below |= flat[where] < factor * np.nanmedian(values, axis=1)
    return below


def _around(values: F64) -> tuple[F64, F64]:
    """Median and upper quartile of each pixel's block of `NEIGHBOURS` by `NEIGHBOURS`."""
    # Each colour of a filter mosaic (every second row and column) separately; maps start at a block
    # boundary, as chunks do. A pixel with an empty block keeps its value.
    maps = np.stack([values, values])
    for y, x in np.ndindex(2, 2):
        colour = values[y::2, x::2]
        if not colour.size:
            continue
        blocks = np.stack(_of_blocks(colour))
        maps[:, y::2, x::2] = np.where(np.isfinite(blocks), blocks, colour)
    return maps[0], maps[1]


def _of_blocks(flat: F64) -> tuple[F64, F64]:
    ny, nx = flat.shape
    size = NEIGHBOURS // 2
    rows, columns = -(-ny // size), -(-nx // size)
    padded = np.full((rows * size, columns * size), np.nan)
    padded[:ny, :nx] = flat
    blocks = padded.reshape(rows, size, columns, size).swapaxes(1, 2).reshape(rows, columns, -1)
    ordered = np.sort(blocks, axis=-1)  # NaN last
    last = np.maximum(np.isfinite(blocks).sum(axis=-1) - 1, 0)
    maps = []
    for rank in (last // 2, (3 * last + 3) // 4):
        value = np.take_along_axis(ordered, rank[..., None], -1)[..., 0]
        maps.append(value.repeat(size, axis=0).repeat(size, axis=1)[:ny, :nx])
    return maps[0], maps[1]


def noisy(
    variance: F64, dof: F64, expected: F64, kurtosis: F64, outliers: F64, factor: float
) -> Mask:
    """Pixels with dark noise far above the read noise, telegraph noise included.

    They have a standard deviation ``factor`` times the usual one, a smaller excess with a flat top,
    or more outliers than particles cause.
    variance, dof, expected : (y, x) temporal variance (ADU²), its freedom, and a usual pixel's
    kurtosis, outliers : (y, x) excess kurtosis (NaN: unknown) and number of outliers
    """
    ratio = variance / expected
    dofs, which = np.unique(dof, return_inverse=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        limits = certainly_noisy(dofs)
        significant = (dof > 0) & (ratio > limits[which].reshape(dof.shape))
        flat_top = kurtosis < -_KURTOSIS_SIGMAS * np.sqrt(24 / dof)
    loud = significant & (ratio > factor**2)
    telegraph = significant & flat_top & (dof >= _KURTOSIS_SAMPLES)
    blinking = outliers >= np.maximum(_MIN_OUTLIERS, _OUTLIER_SHARE * dof)
    return np.asarray(loud | telegraph | blinking)


def certainly_noisy(dof: float | F64) -> F64:
    """Variance over the usual one above which a pixel is not noisy by chance."""
    return np.asarray(chdtri(dof, _FALSE_ALARM) / dof)


def variance_nearby(variance: F64, dof: F64, usual: float) -> F64:
    """Variance (ADU²) of a usual pixel near each, at least ``usual``: amplifiers differ."""
    known = dof > 0
    if not known.any():
        return np.full(variance.shape, usual)
    typical = max(float(np.median(dof[known])), 1.0)
    nearby = _around(np.where(known, variance, np.nan))[0] * typical / chdtri(typical, 0.5)
    return np.asarray(np.fmax(nearby, usual))


def noisy_factor(
    least: float, variance: F64, dof: int, quantum: float, *, unlike: bool = False
) -> float:
    """Factor (at least ``least``) over the usual standard deviation above which pixels are noisy.

    Pixels of a log-normal population (sCMOS) are no defects. ``variance``: of pixels without light
    (ADU²), with ``dof``. ``quantum``: step of the samples (ADU). ``unlike``: allow for such a
    population also if noise is too far below a step to show it.
    """
    known = variance[variance > 0]
    if dof < 1 or not known.size:
        return least
    usual = float(np.median(known))
    # Includes the sampling scatter of the variances, which moves pixels as far.
    spread = median_and_sigma(np.log(known))[1]
    reach = _POPULATION * spread
    below = usual < _HALF_A_STEP * quantum**2
    if below and not unlike:
        return least
    if below or dof < _SPREAD_DOF:  # that scatter dominates, and is far from log-normal
        alike = chdtri(dof, (np.arange(_QUANTILES) + 0.5) / _QUANTILES)
        scatter = max(spread**2 - median_and_sigma(np.log(alike))[1] ** 2, 0.0) ** 0.5
        if below or dof**2 * usual < _COARSE * quantum**2:
            scatter = _UNKNOWN_SPREAD
        reach = math.hypot(_POPULATION * scatter, np.log(certainly_noisy(dof)))
    return max(least, math.exp(reach / 2))


def noisy_beyond(least: float, spread: float) -> float:
    """As above, given the scatter over pixels of the logarithm of the noise."""
    return max(least, math.exp(_POPULATION * spread))


def nonlinear(steps: Sequence[ExposureLevel], levels: F64, limit: float) -> Mask:
    """Pixels whose signal departs from that of others over exposure-time steps of flats.

    Compared with pixels of equal brightness, because a nonlinearity of all pixels is no defect.
    ``steps``: any number; with fewer than three none is flagged. ``levels``: (step,) of
    `step_levels`. ``limit``: largest relative change of the pixel's share of the level.
    """
    shape = steps[0].signal.shape
    if len(steps) < MIN_STEPS:
        return np.zeros(shape, np.bool_)
    signal = np.stack([step.signal for step in steps])
    variance = np.stack([step.variance for step in steps])
    levels = levels[:, None, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        share = signal / levels
        error = np.sqrt(variance) / levels
        weight = np.where(np.isfinite(share) & (error > 0) & (levels > 0), error**-2, 0.0)
        share = np.where(weight > 0, share, 0.0)
        beyond = _departing(share, error, weight, limit)
        if beyond.mean() > _RARE:
            # Light that changes with the step, as that of a lamp that flickers in the rows.
            for axis in (2, 1):
                mean = (weight * share).sum(axis=0) / weight.sum(axis=0)
                rest = np.where(weight > 0, share / mean - 1, np.nan)
                common = np.nan_to_num(_line_medians(rest, axis))
                share = share - np.where(weight > 0, mean * common, 0.0)
            beyond = _departing(share, error, weight, limit)
    enough = (weight > 0).sum(axis=0) >= MIN_STEPS
    return np.asarray(beyond.any(axis=0) & enough)


def _departing(share: F64, error: F64, weight: F64, limit: float) -> Mask:
    """Where shares (step, y, x) of the level depart from those of neighbours equally bright."""
    total = weight.sum(axis=0)
    for _ in range(_CURVES):
        mean = (weight * share).sum(axis=0) / total
        share = share - mean * _common(share / mean - 1, mean, weight > 0)
    mean = (weight * share).sum(axis=0) / total
    # A step is part of the mean, so their difference varies less than the step alone.
    spread = np.sqrt(np.maximum(error**2 - 1 / total, 0))
    off = np.abs(share - mean)
    departing = (off > limit * np.abs(mean)) & (off > _MANY_SIGNIFICANT * spread) & (weight > 0)
    return np.asarray(departing)


def _line_medians(values: F64, axis: int) -> F64:
    """Median of the finite values along an axis, which is kept; NaN where there are none."""
    empty = np.isnan(values).all(axis=axis, keepdims=True)
    return np.where(empty, np.nan, np.nanmedian(np.where(empty, 0, values), axis, keepdims=True))


def _common(off: F64, brightness: F64, used: Mask) -> F64:
    """Part of departures (step, y, x) common to pixels of equal brightness (y, x), and a slope."""
    # An iris shutter gives a slope over the tile.
    seen = lit(brightness)
    if not seen.any():
        return np.zeros_like(off)
    usual, scale = median_and_sigma(brightness[seen])
    x = (brightness - usual) / scale if scale > 0 else 0 * brightness
    powers = np.vander(np.nan_to_num(np.clip(x, -_FARTHEST, _FARTHEST)).ravel(), _DEGREE + 1)
    places = np.indices(brightness.shape).reshape(2, -1).T / max(brightness.shape) - 0.5
    powers = np.hstack([powers, places])
    some = np.arange(0, x.size, max(x.size // _SAMPLE, 1) | 1)
    some = some[seen.ravel()[some]]
    picked = powers[some]
    products = (picked[:, :, None] * picked[:, None]).reshape(len(some), -1)
    rests = off.reshape(len(off), -1)[:, some]
    usable = used.reshape(len(off), -1)[:, some] & np.isfinite(rests)
    curves = [_curve(picked, products, *one) for one in zip(rests, usable, strict=True)]
    common = (np.array(curves) @ powers.T).reshape(off.shape)
    return np.where(used & np.isfinite(off), common, 0.0)


def _curve(powers: F64, products: F64, values: F64, usable: Mask) -> F64:
    """Sum of terms that fits values (n,) without outliers; all zero for too few values."""
    # ``powers, products``: (n, term), (n, term * term) of each value, and products of each two.
    terms = np.zeros(powers.shape[1])
    kept = usable
    for _ in range(_CLIPPINGS):
        if np.count_nonzero(kept) < _FEWEST:
            break
        normal = (kept @ products).reshape(len(terms), -1)
        terms[:] = np.linalg.lstsq(normal, np.where(kept, values, 0.0) @ powers)[0]
        left = values - powers @ terms
        limit = _CLIP * max(median_and_sigma(left[kept])[1], 1e-12)
        before, kept = kept, usable & (np.abs(left) < limit)
        if np.array_equal(kept, before):
            break
    return terms
