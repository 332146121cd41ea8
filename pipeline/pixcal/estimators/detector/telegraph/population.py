"""How many pixels jump, how far, and how long they stay.

The distribution of the pixels' variances gives the share of such pixels and their mean amplitude,
by maximum likelihood: most pixels have the common noise, a share has more, with amplitudes from a
gamma distribution (exponential unless the data require another). Neighbouring frames give the dwell
time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq, minimize
from scipy.special import expit, gammaln, xlogy

from pixcal.estimators.detector.telegraph.classes import (
    AMPLITUDES,
    AmplitudeClasses,
    Mixture,
    Stays,
    joined,
    of_own_noise,
    own_noises,
)
from pixcal.estimators.detector.telegraph.moments import Moments
from pixcal.model.arrays import F64, Indices

# logarithm of the shape: prior 1-sigma, and largest value
_USUAL, _MAX_LOG_SHAPE = 1.5, 4.0
_MOVE = 1e-4  # step of parameters for derivatives of the classes' shares
# of the logits of shares, of logarithms of amplitudes over the noise, and of shapes
_RANGES = (
    (-16.0, 16.0),
    (np.log(AMPLITUDES[0]), np.log(AMPLITUDES[-1])),
    (-_MAX_LOG_SHAPE, _MAX_LOG_SHAPE),
)
_CLEAR = 8.0  # log-likelihood by which a shape other than exponential must be better
# probability of telegraph noise from which a pixel is used for the dwell time,
LIKELY = 0.1
_MOST = 0.95  # and quantile of their variances above which a pixel's weight is reduced


@dataclass(frozen=True)
class Population:
    """Pixels with telegraph noise."""

    # share, amplitude, shape, share_error, amplitude_error, shape_error: of the pixels; mean,
    # e-; of the amplitudes' gamma distribution
    share: float
    amplitude: float
    shape: float
    share_error: float
    amplitude_error: float
    shape_error: float
    unit: float  # noise that is the unit of `AMPLITUDES`, e-
    weight: F64  # (class,) share of the pixels in each class of amplitudes
    pixels: Indices  # (n,) all pixels
    chance: F64  # (n,) probability that each has telegraph noise


def find_population(parts: Sequence[Moments], stays: Stays) -> Population:
    """Share and amplitudes of pixels with telegraph noise, for given dwell times."""
    pixels = np.unique(np.concatenate([m.pixel for m in parts]))
    unit = min(m.sigma for m in parts)
    stands_for = np.ones(len(pixels))
    for m in parts:
        stands_for[np.searchsorted(pixels, m.pixel)] = m.stands_for
    mixture = Mixture.of(joined(pixels, parts, unit, stays))

    def weights(p: F64) -> F64:
        """Share of the pixels in each class of amplitudes."""
        share, mean, shape = expit(p[0]), np.exp(p[1]), _shape(p)
        x = AMPLITUDES * shape / mean
        density = np.exp(xlogy(shape - 1, x) - x - gammaln(shape)) * shape / mean
        return np.asarray(share * density * np.gradient(AMPLITUDES))

    def cost(p: F64) -> float:
        far = float(np.sum(p[2:] ** 2)) / (2 * _USUAL**2)
        return far - float(stands_for @ mixture.log_likelihood(weights(p)))

    def slope(p: F64) -> F64:
        moves = _MOVE * np.eye(len(p))
        by = np.array([(weights(p + m) - weights(p - m)) / (2 * _MOVE) for m in moves])
        of_weight = mixture.slope(weights(p), stands_for)
        return np.concatenate([np.zeros(2), p[2:] / _USUAL**2]) - by @ of_weight

    def lowest(start: F64) -> F64:
        return np.asarray(
            minimize(cost, start, jac=slope, method="L-BFGS-B", bounds=_RANGES[: len(start)]).x
        )

    best = lowest(np.array([-4.0, 1.0]))
    other = lowest(np.append(best, 0.5))
    if cost(other) < cost(best) - _CLEAR:
        best = other
    share, mean, shape = float(expit(best[0])), float(np.exp(best[1])), _shape(best)
    of_all = unit, weights(best), pixels, mixture.chance(weights(best))
    covariance = _curvature(cost, best)
    if covariance is None:
        return Population(share, unit * mean, shape, 1.0, unit * mean, 0.0, *of_all)
    errors = np.sqrt(np.diag(covariance))
    share_error = float(min(errors[0] * share * (1 - share) + 1e-9, 1.0))
    amplitude_error = float(unit * mean * errors[1])
    shape_error = float(shape * errors[2]) if len(best) > 2 else 0.0
    return Population(share, unit * mean, shape, share_error, amplitude_error, shape_error, *of_all)


def _shape(p: F64) -> float:
    """Shape of the gamma distribution: exponential if it is no parameter."""
    return float(np.exp(np.clip(p[2], -_MAX_LOG_SHAPE, _MAX_LOG_SHAPE))) if len(p) > 2 else 1.0


def _curvature(cost: Callable[[F64], float], at: F64, step: float = 0.05) -> F64 | None:
    """Inverse of the second derivatives; None where it is not a minimum."""
    moves = step * np.eye(len(at))

    def change(a: F64, b: F64) -> float:
        return cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b)

    second = np.array([[change(a, b) for b in moves] for a in moves]) / (4 * step**2)
    if np.linalg.eigvalsh(second)[0] <= 1e-9:
        return None
    return np.asarray(np.linalg.inv(second))


def find_switching(
    parts: Sequence[Moments], population: Population, decades: float, upper: float
) -> tuple[float, float]:
    """Mean dwell time and its error, s, from neighbouring frames."""
    period = min(m.period_s for m in parts)
    # Other pixels do not constrain it.
    few = population.pixels[population.chance > LIKELY]
    if not len(few):
        return 0.0, period

    def rest(log_time: float, most: float) -> tuple[float, float]:
        return _rest(parts, population, Stays(float(np.exp(log_time)), decades, upper), 0, most)

    # The frames do not constrain longer dwell times.
    longest = max(m.period_s * m.frames for m in parts)
    low, high = np.log(0.1 * period), np.log(max(longest, period))

    def solved(more: float) -> float:
        """Logarithm of the time whose expected products exceed those measured by ``more``."""
        if rest(high, most)[0] + more >= 0:
            return float(high)
        return float(brentq(lambda v: rest(v, most)[0] + more, low, high, xtol=3e-3))

    # Then all pixels count equally, as a few may hide the signal of the others.
    for most in (_MOST, 0.0):
        none, error = rest(low, most)
        if none > 3 * error:
            break
    else:
        at_most = float(np.exp(solved(error))) if none + error > 0 else 0.0
        return 0.0, max(at_most, period)
    found = solved(0.0)
    slope = abs(rest(found + 0.05, most)[0] - rest(found - 0.05, most)[0]) / 0.1
    return float(np.exp(found)), float(np.exp(found) * rest(found, most)[1] / max(slope, 1e-12))


def off_later(parts: Sequence[Moments], population: Population, stays: Stays) -> float:
    """Products of frames further apart in excess of those for given stays, in errors."""
    total, error = _rest(parts, population, stays, 1, _MOST)
    return total / error if error > 0 else 0.0


def _rest(
    parts: Sequence[Moments], population: Population, stays: Stays, lag: int, most: float
) -> tuple[float, float]:
    """Products of frames at one lag in excess of those for given stays, and their error."""
    few = population.pixels[population.chance > LIKELY]
    if not len(few):
        return 0.0, 0.0
    own = [m.of(few) for m in parts]
    logarithms, expected = _expected(few, own, population.unit, stays, lag)
    mixture = Mixture.of(logarithms)
    chance = mixture.chance(population.weight)
    of_class = mixture.shares(population.weight)
    total = square = 0.0
    for m, products in zip(own, expected, strict=True):
        if not len(m.pixel) or np.isnan(m.products[lag]).any():
            continue
        at = np.searchsorted(few, m.pixel)
        of_pixel = np.einsum("nk,nk->n", of_class[at], products)
        left = chance[at] * (m.products[lag] + 1 / m.count - chance[at] * of_pixel)
        # The products of a few pixels that jump far would outweigh those of all others.
        left *= m.stands_for * np.minimum(np.quantile(m.variance, most) / m.variance, 1)
        total += float(left.sum())
        square += float(left @ left)
    return total, square**0.5


def _expected(
    pixels: Indices, parts: Sequence[Moments], unit: float, stays: Stays, lag: int
) -> tuple[F64, list[F64]]:
    """Result of `joined`, and the expected products of frames (n, class) of each series."""
    totals = [np.zeros((len(m.pixel), len(AMPLITUDES))) for m in parts]
    weight, largest = np.zeros((2, len(pixels), len(AMPLITUDES)))
    largest -= np.inf
    every = np.full(len(pixels), -np.inf)
    for noise, share in own_noises(parts):
        classes = [AmplitudeClasses.of(m, unit, stays, noise) for m in parts]
        ratio, quiet = of_own_noise(pixels, parts, classes)
        ratio += quiet[:, None] + share
        np.logaddexp(every, quiet + share, out=every)
        before, largest = largest, np.maximum(largest, ratio)
        kept, now = np.exp(before - largest), np.exp(ratio - largest)
        weight = weight * kept + now
        for m, one, total in zip(parts, classes, totals, strict=True):
            at = np.searchsorted(pixels, m.pixel)
            total *= kept[at]
            total += now[at] * one.expected(lag)
    ats = (np.searchsorted(pixels, m.pixel) for m in parts)
    expected = [total / weight[at] for total, at in zip(totals, ats, strict=True)]
    return largest + np.log(weight) - every[:, None], expected
