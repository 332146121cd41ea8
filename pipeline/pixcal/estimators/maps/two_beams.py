"""Light and contrast of two Gaussian beams, as smooth surfaces of the maps of a fringe set.

The beams of the two fibres have centres, radii and powers of their own: the logarithm u of the
ratio of their intensities is a quadratic polynomial of position. Their contrast is
``gamma sech(u / 2)``, with gamma the coherence. Light times contrast, the amplitude of the fringes,
is the exponential of a quadratic polynomial.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.special import chdtrc

from pixcal.estimators.maps.structure import clipped, legendre, smooth_surface
from pixcal.kernels.medians import robust_sigma
from pixcal.model.arrays import F64, Mask

_DEGREE = 2  # of the logarithm of the ratio of two Gaussian beams
_CELLS = 24  # along each side of a map; the contrast is fitted to their means
# starts of the fit: the logarithm of the ratio at the centre, and its slopes down and across
_STARTS = tuple((even, *slope) for even in (0, 1) for slope in ((1, 0), (0, 1), (1, 1), (1, -1)))
_STEPS = 60  # of the fit from each start
_ANY = 6  # degree of a smooth contrast of any cause
_TERMS = (_DEGREE + 1) * (_DEGREE + 2) // 2  # polynomials up to the degree
_OFF = 0.01  # chance of a misfit beyond which a quadratic logarithm of the contrast is not enough
# largest share of that misfit that two beams may leave over, beyond noise: the contrast may be
# theirs, or have another cause, such as light that does not interfere
_LEFT = 0.01


def contrast_surface(theta: F64, good: Mask) -> F64:
    """Contrast (y, x) of two Gaussian beams, fitted to the maps (3, y, x) of a set."""
    # If beams are similar its logarithm is quadratic, and fitted as such. If that does not fit,
    # different beams are tried, and used if they fit.
    alpha = np.hypot(*theta[1:])
    used = good & (alpha > 0) & (theta[0] > 0)
    log = np.log(np.divide(alpha, theta[0], out=np.ones_like(alpha), where=used))
    log = np.where(used, log, np.nan)
    alike = smooth_surface(log, used, _DEGREE)
    log = np.where(np.isfinite(clipped(log - alike)), log, np.nan)
    terms = legendre(log.shape, _ANY)
    cells, weight = _cells(np.concatenate([[log], terms]))
    noise = robust_sigma(np.diff(log, axis=1)) / np.sqrt(2)
    if len(weight) <= len(cells) or not noise > 0:
        return np.asarray(np.exp(alike))
    weight /= noise
    data, of_any, of_terms = cells[0], cells[1:], cells[1 : _TERMS + 1]

    def chi2(design: F64) -> float:
        """Of the logarithm of the contrast as a polynomial."""
        rest = data - np.linalg.lstsq((weight * design).T, weight * data)[0] @ design
        return float(((weight * rest) ** 2).sum())

    smooth = chi2(of_any)
    misfit, free = chi2(of_terms) - smooth, len(of_any) - len(of_terms)
    if chdtrc(free, misfit) > _OFF:
        return np.asarray(np.exp(alike))

    def off(values: F64) -> F64:
        model = values[0] - _log_cosh(values[1:] @ of_terms / 2)
        return np.asarray(weight * (model - data))

    def slopes(values: F64) -> F64:
        by_ratio = -np.tanh(values[1:] @ of_terms / 2) / 2
        return np.asarray(weight * np.vstack([np.ones_like(weight), by_ratio * of_terms])).T

    fits = []
    for start in _STARTS:
        first = np.zeros(_TERMS + 1)
        first[0], first[1:4] = data.max(), start
        fits.append(least_squares(off, first, slopes, method="lm", max_nfev=_STEPS))
    best = min(fits, key=lambda one: float(one.cost))
    left = max(2 * float(best.cost) - smooth, 0.0)
    if left - free > _LEFT * misfit and chdtrc(free, left) < _OFF:
        return np.asarray(np.exp(alike))
    ratio = np.tensordot(best.x[1:], terms[:_TERMS], 1)
    return np.asarray(np.exp(best.x[0] - _log_cosh(ratio / 2)))


def light_surface(light: F64, contrast: F64, good: Mask) -> F64:
    """Mean light (y, x), smooth over the window, of beams whose contrast surface is known."""
    used = good & (light > 0)
    log = np.log(np.where(used, light * contrast, 1.0))
    return np.asarray(np.exp(smooth_surface(log, used)) / contrast)


def _log_cosh(x: ArrayLike) -> F64:
    return np.asarray(np.logaddexp(x, np.negative(x)) - np.log(2))


def _cells(maps: F64) -> tuple[F64, F64]:
    """Means (map, cell) of maps (map, y, x) where the first is finite; roots of pixel numbers."""
    kept = np.isfinite(maps[:1])
    sums = np.where(kept, np.concatenate([maps, np.ones_like(maps[:1])]), 0.0)
    for axis in (1, 2):
        length = sums.shape[axis]
        edges = np.linspace(0, length, min(length, _CELLS) + 1)[:-1].astype(int)
        sums = np.add.reduceat(sums, edges, axis)
    sums = sums.reshape(len(sums), -1)
    sums = sums[:, sums[-1] > 0]
    return sums[:-1] / sums[-1], np.sqrt(sums[-1])
