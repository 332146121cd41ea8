"""Likelihoods of pixels' variances by classes of amplitudes, and mixtures of the classes.

A pixel that jumps by A between two equally likely levels has A²/4 more variance, or less where it
stays long or one level is rare.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import logsumexp, softmax

from pixcal.estimators.detector.telegraph.moments import LAGS, Moments
from pixcal.model.arrays import F32, F64, Indices

AMPLITUDES = np.geomspace(0.1, 300, 90)  # grid of amplitudes over the common noise
_DRAWN = 600
PLACES = (np.arange(5) + 0.5) / 5  # of pixels in the range of dwell times
_UNDERFLOW = 1e-200
# Pixels' own noise is log-normal. Nodes: reach (its standard deviations), least number, and spacing
# (standard deviations of a sample variance)
_REACH, _FEWEST, _STEP = 3.0, 7, 2.0


@dataclass(frozen=True)
class AmplitudeClasses:
    """Likelihoods of the pixels of a series for each amplitude."""

    likely: F64  # (n, class) likelihood of each pixel's variance over its largest
    largest: F64  # (n, 1) the logarithm of that, over the likelihood of a quiet pixel
    quiet: F64  # (n,) logarithm of the likelihood of a quiet pixel of the same noise
    noise: float  # variance that the pixels have without jumps, over the common one
    added: F64  # (class,) variance that an amplitude adds, over that
    chances: F64  # chances, products: (level, class) and (lag, level, class) from `_levels`
    products: F64

    @classmethod
    def of(cls, m: Moments, unit: float, stays: "Stays", noise: float = 1.0) -> "AmplitudeClasses":
        """Likelihoods of the moments of each pixel."""
        added = (AMPLITUDES * unit / m.sigma / 2) ** 2 / noise
        variance = m.variance / noise
        levels = log_ratio_of_jumps(variance, added, m.samples_dof)
        quiet = -(variance + np.log(noise)) * m.samples_dof / 2
        largest = levels.max(axis=1, keepdims=True)
        levels -= largest
        np.exp(levels, out=levels)
        kept = tuple(stays.kept(m.period_s, PLACES).tolist())
        of_levels = _levels(kept, m.frames, stays.upper)
        return cls(levels, largest, quiet, noise, added, *of_levels)

    def mixed(self) -> F64:
        """Likelihoods (n, class), averaged over the variance that an amplitude may show."""
        mixed = self.likely @ self.chances
        return np.asarray(np.maximum(mixed, _UNDERFLOW, out=mixed))

    def log_ratio(self) -> F64:
        """Logarithms (n, class) of the likelihoods over that of a quiet pixel."""
        mixed = self.mixed()
        np.log(mixed, out=mixed)
        mixed += self.largest
        return mixed

    def expected(self, lag: int) -> F64:
        """Expected products of frames (n, class) at one lag, as in `Moments`."""
        products = (self.likely @ self.products[lag]) * (self.noise * self.added)
        return np.asarray(products / self.mixed())


def log_ratio_of_jumps(variance: F64, added: F64, dof: float) -> F64:
    """Logarithms (n, class) of the likelihoods of variances (n,) with jumps, over those without.

    ``added``: (class,) variance of the jumps over that of the noise. For given states, a sample
    variance has a noncentral chi-square distribution; its Bessel function is taken for large
    orders (DLMF 10.41.3), with an error of half of 1 / ``dof`` at most.
    """
    order = max(dof / 2 - 1, 0.5)
    s = np.sqrt(1 + variance[:, None] * (added * (dof / order) ** 2))
    found = s - 1 - np.log((1 + s) / 2)
    found *= order
    found -= np.log(s) / 2
    found -= dof / 2 * added
    return np.asarray(found)


@dataclass(frozen=True)
class Stays:
    """Dwell times of pixels in a level."""

    mean_s: float  # geometric mean over the pixels; 0: no longer than a frame
    decades: float = 0.0  # range of the pixels' times, uniform in the logarithm
    upper: float = 0.5  # share of the time in the upper level

    def kept(self, period_s: float, places: F32 | F64) -> F64:
        """Correlation from frame to frame of pixels at places in the range, 0 to 1."""
        if not self.mean_s > 0:
            return np.zeros(1)
        times = self.mean_s * 10 ** (self.decades * (places.astype(float) - 0.5))
        return np.asarray(np.exp(-2 * period_s / times))


@lru_cache(maxsize=64)
def states(keeps: tuple[float, ...], count: int, upper: float) -> F64:
    """States (frame, pixel), -1 or 1, less their mean; ``upper``: share of the time at 1."""
    rng = np.random.default_rng(0)
    keep = np.resize(keeps, _DRAWN)
    anew, up = rng.random((count, _DRAWN)) >= keep, rng.random((count, _DRAWN)) < upper
    anew[0] = True
    # Each frame has the state that was last drawn anew.
    drawn = np.maximum.accumulate(np.where(anew, np.arange(count)[:, None], 0), axis=0)
    found = np.where(np.take_along_axis(up, drawn, 0), 1.0, -1.0)
    return np.asarray(found - found.mean(axis=0))


@lru_cache(maxsize=64)
def _levels(keeps: tuple[float, ...], count: int, upper: float) -> tuple[F64, F64]:
    """Chances (level, class) that a class shows another's variance; products (lag, level, class).

    A pixel that stays long may show its levels unequally, or one only: another amplitude.
    """
    shown = states(keeps, count, upper)
    seen = (shown**2).sum(axis=0) / (count - 1)
    near = np.zeros((len(LAGS), _DRAWN))
    for own, lag in zip(near, LAGS, strict=True):
        if count > lag:
            own[:] = (shown[lag:] * shown[:-lag]).sum(axis=0) / (count - lag)
    step = np.log(AMPLITUDES[1] / AMPLITUDES[0])
    moves = np.rint(np.log(np.maximum(seen, 1e-12)) / 2 / step).astype(int)
    classes = np.arange(len(AMPLITUDES))
    chances, *products = np.zeros((1 + len(LAGS), len(classes), len(classes)))
    for move in np.unique(moves):
        at = np.clip(classes + move, 0, classes[-1]), classes
        np.add.at(chances, at, np.mean(moves == move))
        for own, of_lag in zip(products, near, strict=True):
            np.add.at(own, at, of_lag[moves == move].sum() / _DRAWN)
    return chances, np.stack(products)


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


def of_own_noise(
    pixels: Indices, parts: Sequence[Moments], classes: Iterable[AmplitudeClasses]
) -> tuple[F64, F64]:
    """Log-likelihoods of all series for one noise: (pixel, class) over quiet; quiet (pixel,)."""
    total, quiet = np.zeros((len(pixels), len(AMPLITUDES))), np.zeros(len(pixels))
    for m, one in zip(parts, classes, strict=True):
        at = np.searchsorted(pixels, m.pixel)
        total[at] += one.log_ratio()  # no pixel is in a series twice
        quiet[at] += one.quiet
    return total, quiet


def joined(pixels: Indices, parts: Sequence[Moments], unit: float, stays: Stays) -> F64:
    """Logarithms (pixel, class) of the likelihood ratios of all series together."""
    total = np.full((len(pixels), len(AMPLITUDES)), -np.inf)
    every = np.full(len(pixels), -np.inf)
    for noise, share in own_noises(parts):
        # One at a time, as each is large.
        classes = (AmplitudeClasses.of(m, unit, stays, noise) for m in parts)
        ratio, quiet = of_own_noise(pixels, parts, classes)
        ratio += quiet[:, None] + share
        np.logaddexp(total, ratio, out=total)
        np.logaddexp(every, quiet + share, out=every)
    return np.asarray(total - every[:, None])


@dataclass(frozen=True)
class Mixture:
    """Likelihood ratios (pixel, class) over the largest of each pixel, and the logarithm of that.

    Pixels that are of no class are quiet; their ratio is one.
    """

    ratio: F64
    largest: F64
    logarithms: F64

    @classmethod
    def of(cls, logarithms: F64) -> "Mixture":
        """Mixture of classes with these log-likelihoods (pixel, class)."""
        largest = logarithms.max(axis=1)
        return cls(np.exp(logarithms - largest[:, None]), largest, logarithms)

    def log_telegraph(self, weight: F64) -> F64:
        """Log-likelihood ratio of each pixel for classes with weights (class,)."""
        total = self.ratio @ weight
        found = self.largest + np.log(np.maximum(total, _UNDERFLOW))
        # Where the largest has hardly any weight the others underflowed.
        lost = total <= _UNDERFLOW
        found[lost] = logsumexp(self.logarithms[lost], b=weight, axis=1)
        return found

    def log_likelihood(self, weight: F64) -> F64:
        """Of each pixel, quiet or not."""
        # Amplitudes below the grid count as quiet.
        quiet = np.log(max(1 - weight.sum(), 1e-12))
        return np.asarray(np.logaddexp(quiet, self.log_telegraph(weight)))

    def slope(self, weight: F64, stands_for: F64) -> F64:
        """Slope (class,) of the sum of `log_likelihood`, pixels counted ``stands_for`` times."""
        likely = self.log_likelihood(weight)
        own = stands_for * np.exp(self.largest - likely)
        quiet = float(np.sum(stands_for * np.exp(-likely)))
        return np.asarray(own @ self.ratio - quiet)

    def chance(self, weight: F64) -> F64:
        """Probability that each pixel is not quiet."""
        return np.asarray(np.exp(self.log_telegraph(weight) - self.log_likelihood(weight)))

    def shares(self, weight: F64) -> F64:
        """Probabilities (pixel, class) of the classes of pixels that are not quiet."""
        logarithms = self.logarithms + np.log(np.maximum(weight, _UNDERFLOW))
        return np.asarray(softmax(logarithms, axis=1))
