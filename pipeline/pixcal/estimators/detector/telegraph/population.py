"""Number and amplitudes of pixels that jump, from the distribution of the variances.

A pixel that jumps by A between two equally likely levels has A²/4 more variance, or less where it
stays long or one level is rare. Maximum likelihood: most pixels have the common noise, a share has
more, with amplitudes from a gamma distribution (exponential unless the data require another).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.optimize import minimize
from scipy.special import expit, gammaln, logsumexp, xlogy

from pixcal.estimators.detector.telegraph.moments import Moments
from pixcal.model.arrays import F32, F64

AMPLITUDES = np.geomspace(0.1, 300, 90)  # grid of amplitudes over the common noise
PLACES = (np.arange(5) + 0.5) / 5  # of pixels in the range of dwell times
_DRAWN, _FEWEST_DRAWN = 30_000, 600  # states that are simulated, and pixels at least
_UNDERFLOW = 1e-300
# Pixels' own noise is log-normal. Nodes: reach (its standard deviations), least number, and spacing
# (standard deviations of a sample variance)
_REACH, _FEWEST, _STEP = 3.0, 7, 2.0
# logarithm of the shape: prior 1-sigma, and largest value
_USUAL, _MAX_LOG_SHAPE = 1.5, 4.0
# of the logits of shares, of logarithms of amplitudes over the noise, and of shapes
_RANGES = (
    (-16.0, 16.0),
    (np.log(AMPLITUDES[0]), np.log(AMPLITUDES[-1])),
    (-_MAX_LOG_SHAPE, _MAX_LOG_SHAPE),
)
_CLEAR = 8.0  # log-likelihood by which a shape other than exponential must be better


@dataclass(frozen=True)
class Stays:
    """Dwell times of pixels in a level."""

    mean_s: float  # geometric mean over the pixels; 0: no longer than a frame
    decades: float = 0.0  # range of the pixels' times, uniform in the logarithm
    upper: float = 0.5  # share of the time in the upper level

    def kept(self, period_s: float, places: F32 | F64) -> F64:
        """Correlation from frame to frame of pixels at places in the range, 0 to 1."""
        if not self.mean_s > 0:
            return np.zeros(places.shape)
        times = self.mean_s * 10 ** (self.decades * (places.astype(float) - 0.5))
        return np.asarray(np.exp(-2 * period_s / times))

    def states(self, period_s: float, count: int) -> F64:
        """States (frame, pixel), -1 or 1, less their mean, of pixels at `PLACES` in turn."""
        return _states(tuple(self.kept(period_s, PLACES).tolist()), count, self.upper)


@lru_cache(maxsize=64)
def _states(keeps: tuple[float, ...], count: int, upper: float) -> F64:
    rng = np.random.default_rng(0)
    shape = count, max(_DRAWN // count, _FEWEST_DRAWN)
    keep = np.resize(keeps, shape[1])
    anew, up = rng.random(shape) >= keep, rng.random(shape) < upper
    anew[0] = True
    # Each frame has the state that was last drawn anew.
    drawn = np.maximum.accumulate(np.where(anew, np.arange(count)[:, None], 0), axis=0)
    states = np.where(np.take_along_axis(up, drawn, 0), 1.0, -1.0)
    return np.asarray(states - states.mean(axis=0))


@dataclass(frozen=True)
class Population:
    """Pixels with telegraph noise."""

    # share, amplitude, shape, and their errors: of the pixels; mean, e-; of the amplitudes' gamma
    # distribution
    share: float
    amplitude: float
    shape: float
    share_error: float
    amplitude_error: float
    shape_error: float


def find_population(parts: Sequence[Moments], stays: Stays) -> Population:
    """Share and amplitudes of pixels with telegraph noise, for given dwell times."""
    pixels = np.unique(np.concatenate([m.pixel for m in parts]))
    unit = min(m.sigma for m in parts)
    stands_for = np.ones(len(pixels))
    for m in parts:
        stands_for[np.searchsorted(pixels, m.pixel)] = m.stands_for
    ratio = _joined(parts, unit, stays)
    largest = ratio.max(axis=1)
    ratio = np.exp(ratio - largest[:, None])

    def cost(p: F64) -> float:
        share, mean, shape = expit(p[0]), np.exp(p[1]), np.exp(p[2]) if len(p) > 2 else 1.0
        x = AMPLITUDES * shape / mean
        density = np.exp(xlogy(shape - 1, x) - x - gammaln(shape)) * shape / mean
        weights = share * density * np.gradient(AMPLITUDES)
        # Amplitudes below the grid count as quiet.
        quiet = np.log(max(1 - weights.sum(), 1e-12))
        jumps = largest + np.log(np.maximum(ratio @ weights, _UNDERFLOW))
        far = float(np.sum(p[2:] ** 2)) / (2 * _USUAL**2)
        return far - float(stands_for @ np.logaddexp(quiet, jumps))

    def lowest(start: F64) -> F64:
        return np.asarray(minimize(cost, start, method="L-BFGS-B", bounds=_RANGES[: len(start)]).x)

    best = lowest(np.array([-4.0, 1.0]))
    other = lowest(np.append(best, 0.5))
    if cost(other) < cost(best) - _CLEAR:
        best = other
    share, amplitude = float(expit(best[0])), unit * float(np.exp(best[1]))
    shape = float(np.exp(best[2])) if len(best) > 2 else 1.0
    covariance = _curvature(cost, best)
    if covariance is None:
        return Population(share, amplitude, shape, 1.0, amplitude, 0.0)
    errors = np.sqrt(np.diag(covariance)).tolist()
    share_error = min(errors[0] * share * (1 - share) + 1e-9, 1.0)
    shape_error = shape * errors[2] if len(best) > 2 else 0.0
    return Population(share, amplitude, shape, share_error, amplitude * errors[1], shape_error)


def _curvature(cost: Callable[[F64], float], at: F64, step: float = 0.05) -> F64 | None:
    """Inverse of the second derivatives; None where it is not a minimum."""
    moves = step * np.eye(len(at))

    def change(a: F64, b: F64) -> float:
        return cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b)

    second = np.array([[change(a, b) for b in moves] for a in moves]) / (4 * step**2)
    if np.linalg.eigvalsh(second)[0] <= 1e-9:
        return None
    return np.asarray(np.linalg.inv(second))


def _joined(parts: Sequence[Moments], unit: float, stays: Stays) -> F64:
    """Logarithms (pixel, class) of the likelihoods of all series over that of a quiet pixel."""
    pixels = np.unique(np.concatenate([m.pixel for m in parts]))
    total, every = np.full((len(pixels), len(AMPLITUDES)), -np.inf), np.full(len(pixels), -np.inf)
    moves = [_moves(tuple(stays.kept(m.period_s, PLACES)), m.frames, stays.upper) for m in parts]
    for noise, share in own_noises(parts):
        # One at a time, as each is large.
        ratio, quiet = np.zeros(total.shape), np.full(len(pixels), share)
        for m, chances in zip(parts, moves, strict=True):
            at = np.searchsorted(pixels, m.pixel)  # no pixel is in a series twice
            added = (AMPLITUDES * unit / m.sigma / 2) ** 2 / noise
            levels = log_ratio_of_jumps(m.variance / noise, added, m.samples_dof)
            largest = levels.max(axis=1, keepdims=True)
            mixed = np.exp(levels - largest) @ chances
            ratio[at] += largest + np.log(np.maximum(mixed, _UNDERFLOW))
            quiet[at] -= (m.variance / noise + np.log(noise)) * m.samples_dof / 2
        ratio += quiet[:, None]
        np.logaddexp(total, ratio, out=total)
        np.logaddexp(every, quiet, out=every)
    return np.asarray(total - every[:, None])


def log_ratio_of_jumps(variance: F64, added: F64, dof: float) -> F64:
    """Logarithms (n, class) of the likelihoods of variances (n,) with jumps, over those without.

    ``added``: (class,) variance of the jumps over that of the noise. For given states, a sample
    variance has a noncentral chi-square distribution; its Bessel function is taken for large
    orders (DLMF 10.41.3), with an error of half of 1 / ``dof`` at most.
    """
    order = max(dof / 2 - 1, 0.5)
    s = np.sqrt(1 + variance[:, None] * (added * (dof / order) ** 2))
    log_ratio = s - 1 - np.log((1 + s) / 2)
    log_ratio *= order
    log_ratio -= np.log(s) / 2
    log_ratio -= dof / 2 * added
    return np.asarray(log_ratio)


@lru_cache(maxsize=16)
def _moves(keeps: tuple[float, ...], count: int, upper: float) -> F64:
    """Chances (level, class) that a class of amplitudes shows the variance of another.

    A pixel that stays long may show its levels unequally, or one only.
    """
    seen = (_states(keeps, count, upper) ** 2).sum(axis=0) / (count - 1)
    step = np.log(AMPLITUDES[1] / AMPLITUDES[0])
    moves = np.rint(np.log(np.maximum(seen, 1e-12)) / 2 / step).astype(int)
    classes = np.arange(len(AMPLITUDES))
    chances = np.zeros((len(classes), len(classes)))
    for move, often in zip(*np.unique(moves, return_counts=True), strict=True):
        np.add.at(chances, (np.clip(classes + move, 0, classes[-1]), classes), often / len(moves))
    return chances


def own_noises(parts: Sequence[Moments]) -> list[tuple[float, float]]:
    """Variances over the common one that quiet pixels may have, and logarithms of their shares."""
    dof = np.array([m.samples_dof for m in parts])
    deviation = float(np.sqrt(np.average([m.spread for m in parts], weights=dof**2)))
    step = _STEP * np.sqrt(2 / dof.sum())
    if not deviation:
        return [(1.0, 0.0)]
    at = np.linspace(-_REACH, _REACH, max(int(2 * _REACH * deviation / step) + 2, _FEWEST))
    shares = -(at**2) / 2
    return list(zip(np.exp(deviation * at), shares - logsumexp(shares), strict=True))
