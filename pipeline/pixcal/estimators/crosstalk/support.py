"""Detection of couplings: significant links.

Every pair of pixels a step apart, and every period of rows and columns, is tested. A link is
accepted at a false-alarm rate of one acquisition in a hundred; half of that is reserved for the few
tests of adjacent pixels with equal coupling everywhere.
"""

import numpy as np
from scipy.special import ndtri

from pixcal.estimators.crosstalk.links import Place, periods
from pixcal.estimators.crosstalk.sources import Sources, total
from pixcal.kernels.significance import sigmas_of_largest
from pixcal.model.arrays import F64
from pixcal.model.errors import InputError

FALSE_ALARM = 0.01  # chance that noise alone gives any coupling
# Effective share of independent tests, as periods have pixels in common. Measured: it makes the
# median significance of acquisitions without couplings about zero.
INDEPENDENT = 0.35
NEAR, MAX_FAR = 2, 12  # distance (px), and most couplings of a kernel beyond it
NEAREST = (0, 1), (1, 0)  # links that a capacitance makes equal
NOTHING = 1e-6  # weight of a share below which it is not measured


def sigmas_of(*families: tuple[float, int]) -> float:
    """Sigmas of a normal variate as rare as the best of all tests.

    ``families``: the largest chi-square of tests made together, and their number; all families
    have the same share of the chance.
    """
    # A chi-square is the square of a normal of either sign.
    tests = 2 * INDEPENDENT * len(families)
    return max(sigmas_of_largest(best**0.5, tests * count) for best, count in families)


def significant_links(sources: Sources) -> tuple[tuple[Place, ...], float]:
    """Links that stand out, and the significance of the best.

    Raises InputError if so many are far apart that it is no kernel.
    """
    links = sources.links
    tests = len(links) * sum(3 * n * m for n, m in periods(sources.shape))
    gains = []
    for _, equations in sources.periods():
        normal, right = total(equations)
        gains.append(_best_gains(normal, right))
        if len(gains) == 1:
            at = [n for n, step in enumerate(links) if step in NEAREST]
            alike = float(_fall(right[at].sum(), normal[at].sum()))
    best = np.max(gains, axis=0)
    close = [n for n, step in enumerate(links) if max(map(abs, step)) == 1]
    # Each link there, back and both; and the nearest ones as one number.
    few = 3 * len(close) + 1
    taken = best > _critical(tests)
    taken[close] |= gains[0][close] > _critical(few)
    taken[at] |= alike > _critical(few)
    there = tuple(step for step, own in zip(links, taken, strict=True) if own)
    far = sum(max(map(abs, step)) > NEAR for step in there)
    if far > MAX_FAR:
        raise InputError(
            f"not decided: noise is correlated at {len(there)} distances between pixels, {far} of "
            f"them beyond {NEAR} pixels (at most {MAX_FAR} are measured); this is not a "
            "crosstalk kernel"
        )
    adjacent = max(float(gains[0][close].max()), alike)
    return there, sigmas_of((float(best.max()), tests), (adjacent, few))


def _critical(tests: int) -> float:
    return float(ndtri(FALSE_ALARM / 2 / tests / 2) ** 2)


def _best_gains(normal: F64, right: F64) -> F64:
    """Largest fall in chi-square (link,) that one class gives: there, back or both."""
    own = np.diagonal(normal, axis1=-2, axis2=-1)
    mixed = np.diagonal(normal, 1, axis1=-2, axis2=-1)[..., ::2]
    weight = np.concatenate([own[..., ::2] + own[..., 1::2] + 2 * mixed, own], axis=-1)
    value = np.concatenate([right[..., ::2] + right[..., 1::2], right], axis=-1)
    return np.asarray(_fall(value, weight).max(axis=-1))


def _fall(value: F64, weight: F64) -> F64:
    return np.where(weight > NOTHING, value**2 / np.maximum(weight, NOTHING), 0.0)
