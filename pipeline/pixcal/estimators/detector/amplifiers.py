"""Amplifiers of slightly different gain: steps in the flat that the noise has as well.

A response step between two blocks of columns or rows is a gain step if the shot noise steps with
it. The amplifier with more e-/ADU gives fewer ADU for the same light, and its noise, computed with
the common gain, is smaller by the same factor. Where the pixels themselves respond differently,
the noise follows the light and has no step.
"""

import numpy as np
from numpy.polynomial.legendre import legvander

from pixcal.kernels.robust import robust_sigma
from pixcal.model.arrays import F64, Mask

MAX_BOUNDARIES = 7  # most boundaries along each axis
NARROWEST = 8  # fewest rows or columns of an amplifier
SIGNIFICANT = 6.0  # standard deviations of a step of the flat
SMOOTH = 2  # degree of the lamp's variation


def relative_gain(flat: F64, noise: F64, good: Mask) -> F64:
    """Gain (y, x) of every pixel's amplifier over the mean; exactly 1 where no boundary was found.

    ``flat``: (y, x) relative response. ``noise``: (y, x) mean square of samples over that expected.
    """
    log_gain = np.zeros(flat.shape)
    used = good & (flat > 0) & (noise > 0)
    response = np.where(used, np.log(np.where(used, flat, 1.0)), np.nan)
    squares = np.where(used, noise, np.nan)
    for axis in (0, 1):
        along = _profile(response, axis)
        steps = _boundaries(along)
        if not steps:
            continue
        size, _ = _sizes(along, steps)
        in_noise, error = _sizes(_profile(squares, axis), steps)
        place = np.arange(flat.shape[axis])
        for number, step in enumerate(steps):
            of_gain = (in_noise[number] - size[number]) ** 2 < in_noise[number] ** 2
            clear = abs(size[number]) > 2 * error[number]
            if of_gain and clear:
                log_gain -= np.expand_dims(size[number] * (place >= step), 1 - axis)
    return np.asarray(np.exp(log_gain - log_gain.mean()))


def _profile(values: F64, axis: int) -> F64:
    """Mean of each row (axis 0) or column (1); the median of all for empty ones."""
    count = np.isfinite(values).sum(axis=1 - axis)
    found = np.full(values.shape[axis], np.nanmedian(values))
    kept = np.compress(count > 0, values, axis=axis)
    found[count > 0] = np.nanmean(kept, axis=1 - axis)
    return found


def _boundaries(along: F64) -> list[int]:
    """First places of the blocks after the first, most significant steps first, in order."""
    steps: list[int] = []
    noise = robust_sigma(np.diff(along)) / np.sqrt(2)
    places = range(NARROWEST, len(along) - NARROWEST + 1)
    while noise > 0 and len(steps) < MAX_BOUNDARIES:
        free = [p for p in places if all(abs(p - s) >= NARROWEST for s in steps)]
        basis = np.linalg.qr(_terms(len(along), steps))[0]
        rest = along - basis @ (basis.T @ along)
        best, at = 0.0, 0
        for place in free:
            step = (np.arange(len(along)) >= place).astype(float)
            step -= basis @ (basis.T @ step)
            size = abs(step @ rest) / np.linalg.norm(step)
            best, at = max((best, at), (float(size), place))
        if best < SIGNIFICANT * noise:
            break
        steps.append(at)
    return sorted(steps)


def _terms(count: int, steps: list[int]) -> F64:
    smooth = legvander(np.linspace(-1, 1, count), SMOOTH)
    return np.column_stack([smooth, *[(np.arange(count) >= s).astype(float) for s in steps]])


def _sizes(along: F64, steps: list[int]) -> tuple[F64, F64]:
    """Steps of a profile, and their errors from its scatter."""
    terms = _terms(len(along), steps)
    inverse = np.linalg.inv(terms.T @ terms)
    fitted = inverse @ (terms.T @ along)
    scatter = float(np.var(along - terms @ fitted)) * len(along) / (len(along) - terms.shape[1])
    first = SMOOTH + 1
    return fitted[first:], np.sqrt(np.diag(inverse)[first:] * scatter)
