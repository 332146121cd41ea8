"""Significance: probabilities and chi-squares in standard deviations of a normal."""

import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import chdtrc, gammainc, gammaln, log_ndtr, ndtri_exp, xlogy

from pixcal.model.arrays import F64

# standard deviations above which an estimate or a part of its law is significant
SIGNIFICANT = 4.0
_LARGE = 1000.0


def root_with_error(
    variance: ArrayLike, error: ArrayLike, below: ArrayLike | None = None
) -> tuple[F64, F64]:
    """Standard deviations, and the longer side of their one-sigma intervals.

    ``variance``: as measured, possibly negative. ``error``: its upper error; ``below``: its lower
    error, if different.
    """
    there = np.maximum(variance, 0.0)
    root = np.sqrt(there)
    low = np.sqrt(np.maximum(there - (error if below is None else below), 0.0))
    return root, np.maximum(np.sqrt(there + error) - root, root - low)


def sigmas_of_chi2(value: float, dof: int) -> float:
    """Standard deviations of a normal that are as rare as a chi-square this large."""
    # By chance alone the result is a standard normal; it is negative for a small chi-square.
    if value > _LARGE:
        # The logarithm of so small a probability underflows; this is its leading order.
        return math.sqrt(value - (dof - 1) * math.log(value / dof))
    return -float(ndtri_exp(min(math.log(chdtrc(dof, max(value, 0.0))), -1e-300)))


def sigmas_of_t(t: float, dof: int) -> float:
    """Normal quantile of a value of Student's distribution, to 2 % (Wallace 1959)."""
    size = (8 * dof + 1) / (8 * dof + 3) * math.sqrt(dof * math.log1p(t**2 / dof))
    return math.copysign(size, t)


def sigmas_of_count(count: int, expected: float) -> float:
    """Standard deviations of a normal that are as rare as more than ``count`` Poisson events.

    ``expected`` is positive. Half of the probability of exactly ``count`` is included, so that no
    events where almost none are expected are no deviation.
    """
    log_equal = float(xlogy(count, expected) - gammaln(count + 1) - expected)
    log_chance = log_equal + math.log(0.5)
    more = float(gammainc(count + 1, expected))
    if more > 0:
        log_chance = float(np.logaddexp(log_chance, math.log(more)))
    return -float(ndtri_exp(min(log_chance, -1e-300)))


def sigmas_of_best(*sigmas: float) -> float:
    """Significance (standard deviations) of the largest of independent standard normals."""
    return sigmas_of_largest(max(sigmas), len(sigmas))


def sigmas_of_largest(largest: float, count: float) -> float:
    """As `sigmas_of_best`, given the largest of ``count`` normals."""
    log_one = float(log_ndtr(-max(largest, -8.0)))
    none = count * math.log1p(-math.exp(log_one))
    # The logarithm of the smaller of both probabilities is the precise one.
    return float(ndtri_exp(none) if none < -0.5 else -ndtri_exp(log_of_any(log_one, count)))


def log_of_any(log_chance: float, count: float) -> float:
    """Log probability of at least one of several independent events of equal probability."""
    # One minus the probability that none does.
    none = count * math.log1p(-math.exp(log_chance))
    return math.log(-math.expm1(none)) if none < -1e-12 else log_chance + math.log(count)
