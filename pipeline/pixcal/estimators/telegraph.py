"""Telegraph noise of a population of pixels, from the moments of each one's noise.

A pixel that jumps by A between two equally likely levels has A²/4 more variance. The distribution
of the variances gives the share of such pixels and their mean amplitude, by maximum likelihood:
most pixels have the common noise, a share has more, with A from an exponential distribution.

A pixel could also just be noisier. Of Gaussian noise of any size the kurtosis and the correlation
of neighbouring frames, each over the variance, do not depend on the variance (Basu's theorem); so
their sums over pixels, weighted by the variance, have known mean and scatter.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.special import expit, logsumexp, softmax
from scipy.stats import chi2

from pixcal.kernels.significance import sigmas_of_best

F64 = NDArray[np.float64]

AMPLITUDES = np.geomspace(0.1, 300, 90)
"""Amplitudes over the common noise that are looked at."""

NOISY = 3.0
"""Excess of the variance, in its own sigmas, from which a pixel's noise is looked at."""

LIKELY = 0.1
"""Chance of telegraph noise from which a pixel's frames are looked at for how long it stays."""

ROUNDS = 3
"""Most, in which population and time are found, each with the other known."""

SETTLED = 0.5
"""Change of the time, over its error, after which no other round is needed."""

_OUTLIER = 5.0
_DRAWN = 600
_LEAST = 8
_UNDERFLOW = 1e-200


@dataclass(frozen=True)
class Series:
    """Noise of pixels in frames that follow one another.

    Attributes
    ----------
    noise : (t, n) float64
        Over the common noise, about the pixel's mean; NaN where there is none.
    pixel : (n,) int
        Which pixels.
    sigma : float
        The common noise, e-.
    period_s : float
        From frame to frame; nan when unknown.
    """

    noise: F64
    pixel: NDArray[np.intp]
    sigma: float
    period_s: float


@dataclass(frozen=True)
class Telegraph:
    """What was found.

    Attributes
    ----------
    share, amplitude, switching_s : float
        Of the pixels; mean, e-; mean stay in a level, s (0: no longer than a frame).
    share_error, amplitude_error, switching_error : float
    significance : float
        That noisy pixels jump.
    flat_top, staying : float
        Its two signs, in sigmas.
    noisy : int
        Pixels that stand out.
    """

    share: float
    amplitude: float
    switching_s: float
    share_error: float
    amplitude_error: float
    switching_error: float
    significance: float
    flat_top: float
    staying: float
    noisy: int


def find_telegraph(series: Sequence[Series]) -> Telegraph | None:
    """Telegraph noise from one or several series of the same pixels; None without samples."""
    parts = [m for s in series if (m := _moments(s)) is not None]
    if not parts:
        return None
    flat_top, staying, noisy = _signs(parts)
    # A pixel's variance is high by telegraph noise or by chance: how much is which, the population
    # tells; how much of it a few frames hold, the time.
    found = _population(parts, 0.0)
    switching, switching_error = _switching(parts, found)
    for _ in range(ROUNDS):
        before = switching
        if before == 0:
            break
        found = _population(parts, switching)
        switching, switching_error = _switching(parts, found)
        if abs(switching - before) < SETTLED * switching_error:
            break
    return Telegraph(
        found.share, found.amplitude, switching, found.share_error, found.amplitude_error,
        switching_error, sigmas_of_best(flat_top, staying), flat_top, staying, noisy,
    )  # fmt: skip


@dataclass(frozen=True)
class _Moments:
    """Of the noise of each pixel of a series, in units of the common noise."""

    pixel: NDArray[np.intp]
    count: F64
    """Samples."""
    variance: F64
    kurtosis: F64
    """Excess, unbiased."""
    neighbours: F64
    """Sum of products of neighbouring frames, over the degrees of freedom of the variance."""
    dof: float
    """Of the variance: fewer than the samples have where pixels differ anyway."""
    sigma: float
    period_s: float
    frames: int
    """That most pixels have."""

    def of(self, pixels: NDArray[np.intp]) -> "_Moments":
        """Of some pixels (ascending) alone."""
        own = np.isin(self.pixel, pixels)
        names = ("pixel", "count", "variance", "kurtosis", "neighbours")
        return replace(self, **{name: getattr(self, name)[own] for name in names})

    @property
    def excess(self) -> F64:
        """Variance beyond the common one; zero where that is not clear."""
        excess = self.variance - 1
        return np.where(excess > NOISY * np.sqrt(2 / self.dof), excess, 0)


def _moments(series: Series) -> _Moments | None:
    x = series.noise - np.nanmedian(series.noise, axis=0)
    # One wild sample is a particle's; noise of two levels has more of them, or none.
    wild = np.abs(x) > _OUTLIER
    x[wild & (wild.sum(axis=0) == 1)] = np.nan
    n = np.isfinite(x).sum(axis=0).astype(float)
    used = n > _LEAST
    if not used.any():
        return None
    x, n = x[:, used], n[used]
    x = np.nan_to_num(x - np.nanmean(x, axis=0))
    square = (x**2).sum(axis=0)
    square = np.maximum(square, 1e-12)
    variance = square / (n - 1)
    kurtosis = n * (x**4).sum(axis=0) / square**2 - 3
    kurtosis = (n - 1) / ((n - 2) * (n - 3)) * ((n + 1) * kurtosis + 6)
    neighbours = (x[1:] * x[:-1]).sum(axis=0) / (n - 1)
    dof = float(np.median(n)) - 1
    centre = np.median(variance) * dof / chi2.median(dof)
    # Half the pixels lie between the quartiles, whatever the noisy ones do.
    low, high = np.quantile(variance / centre, (0.25, 0.75))
    wide = (high - low) / np.diff(chi2.ppf((0.25, 0.75), dof) / dof)[0]
    return _Moments(
        series.pixel[used],
        n,
        variance / centre,
        kurtosis,
        neighbours / centre,
        dof / max(float(wide), 1.0) ** 2,
        series.sigma * float(np.sqrt(centre)),
        series.period_s if np.isfinite(series.period_s) and series.period_s > 0 else 1.0,
        int(np.median(n)),
    )


def _signs(parts: Sequence[_Moments]) -> tuple[float, float, int]:
    """How much flatter noisy pixels' noise is, and how much more it stays, than Gaussian noise."""
    flat = flat_variance = stay = stay_variance = 0.0
    noisy: set[int] = set()
    for m in parts:
        n, part = m.count, m.excess / (1 + m.excess)
        of_kurtosis = 24 * n * (n - 1) ** 2 / ((n - 3) * (n - 2) * (n + 3) * (n + 5))
        flat -= float(part**2 @ m.kurtosis)
        flat_variance += float(part**4 @ of_kurtosis)
        # Mean and variance for white noise, exact (Moran 1948, Biometrika 35, 255).
        stay += float(part @ (m.neighbours / m.variance + 1 / n))
        stay_variance += float(part**2 @ ((n - 2) ** 2 / (n**2 * (n - 1))))
        noisy.update(m.pixel[m.excess > 0].tolist())
    if not flat_variance:
        return 0.0, 0.0, 0
    return flat / flat_variance**0.5, stay / stay_variance**0.5, len(noisy)


def _keep(switching_s: float, period_s: float) -> float:
    return float(np.exp(-2 * period_s / switching_s)) if switching_s > 0 else 0.0


def _switching(parts: Sequence[_Moments], population: "_Population") -> tuple[float, float]:
    """Mean stay in a level and its error, s, from neighbouring frames."""
    period = min(m.period_s for m in parts)
    # The others say nothing of it.
    few = population.pixels[population.chance > LIKELY]
    if not len(few):
        return 0.0, period
    own = [m.of(few) for m in parts]

    def rest(log_time: float) -> tuple[float, float]:
        """Products of neighbours beyond those for a time, and their error."""
        classes = [_Classes.of(m, population.unit, float(np.exp(log_time))) for m in own]
        mixture = _Mixture.of(_joined(few, own, classes))
        chance = mixture.chance(population.weight)
        of_class = mixture.shares(population.weight)
        total = square = 0.0
        for m, one in zip(own, classes, strict=True):
            at = np.searchsorted(few, m.pixel)
            expected = np.einsum("nk,nk->n", of_class[at], one.neighbours())
            left = chance[at] * (m.neighbours + 1 / m.count - chance[at] * expected)
            total += float(left.sum())
            square += float(left @ left)
        return total, square**0.5

    # Of longer stays the frames do not tell how long.
    longest = max(m.period_s * m.frames for m in parts)
    low, high = np.log(0.1 * period), np.log(max(longest, period))

    def solved(more: float) -> float:
        """Logarithm of the time for which so much more than was measured is expected."""
        if rest(high)[0] + more >= 0:
            return float(high)
        return float(brentq(lambda v: rest(v)[0] + more, low, high, xtol=3e-3))

    none, error = rest(low)
    if none <= 3 * error:
        at_most = float(np.exp(solved(error))) if none + error > 0 else 0.0
        return 0.0, max(at_most, period)
    found = solved(0.0)
    slope = abs(rest(found + 0.05)[0] - rest(found - 0.05)[0]) / 0.1
    return float(np.exp(found)), float(np.exp(found) * rest(found)[1] / max(slope, 1e-12))


@dataclass(frozen=True)
class _Population:
    """Pixels with telegraph noise.

    Attributes
    ----------
    share, amplitude, share_error, amplitude_error : float
        Of the pixels; mean, e-.
    unit : float
        Noise that `AMPLITUDES` are over, e-.
    weight : (class,) float64
        Share of the pixels in each class of amplitudes.
    pixels : (n,) int
        All that there are.
    chance : (n,) float64
        That each is one of them.
    """

    share: float
    amplitude: float
    share_error: float
    amplitude_error: float
    unit: float
    weight: F64
    pixels: NDArray[np.intp]
    chance: F64


def _population(parts: Sequence[_Moments], switching_s: float) -> _Population:
    """Of how many pixels, and how strong, for a mean stay in a level."""
    pixels = np.unique(np.concatenate([m.pixel for m in parts]))
    unit = min(m.sigma for m in parts)
    # One after the other: each is large.
    classes = (_Classes.of(m, unit, switching_s) for m in parts)
    mixture = _Mixture.of(_joined(pixels, parts, classes))

    def weights(p: F64) -> F64:
        """Share of the pixels in each class of amplitudes."""
        share, mean = expit(p[0]), np.exp(p[1])
        weight = AMPLITUDES / mean * np.exp(-AMPLITUDES / mean) * np.gradient(np.log(AMPLITUDES))
        return np.asarray(share * weight)

    def cost(p: F64) -> float:
        return -float(mixture.log_likelihood(weights(p)).sum())

    start = np.array([-4.0, 1.0])
    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3}).x
    share, mean = float(expit(best[0])), float(np.exp(best[1]))
    of_all = unit, weights(best), pixels, mixture.chance(weights(best))
    covariance = _curvature(cost, best)
    if covariance is None:
        return _Population(share, unit * mean, 1.0, unit * mean, *of_all)
    errors = np.sqrt(np.diag(covariance))
    share_error = float(min(errors[0] * share * (1 - share) + 1e-9, 1.0))
    amplitude_error = float(unit * mean * errors[1])
    return _Population(share, unit * mean, share_error, amplitude_error, *of_all)


@dataclass(frozen=True)
class _Classes:
    """Pixels of a series, for each amplitude that they may have.

    Attributes
    ----------
    likely : (n, class) float64
        Likelihood of each pixel's variance over the largest of its own.
    largest : (n, 1) float64
        The logarithm of that, over the likelihood of a quiet pixel.
    added : (class,) float64
        Variance that an amplitude adds, over the common one.
    chances, products : (level, class) float64
        From `_levels`.
    """

    likely: F64
    largest: F64
    added: F64
    chances: F64
    products: F64

    @classmethod
    def of(cls, m: _Moments, unit: float, switching_s: float) -> "_Classes":
        added = (AMPLITUDES * unit / m.sigma / 2) ** 2
        levels = m.variance[:, None] * (added / (1 + added))
        levels -= np.log1p(added)
        levels *= m.dof / 2
        largest = levels.max(axis=1, keepdims=True)
        levels -= largest
        np.exp(levels, out=levels)
        of_levels = _levels(_keep(switching_s, m.period_s), m.frames)
        return cls(levels, largest, added, *of_levels)

    def mixed(self) -> F64:
        """Likelihoods (n, class) by what a pixel may have shown of its amplitude."""
        mixed = self.likely @ self.chances
        return np.asarray(np.maximum(mixed, _UNDERFLOW, out=mixed))

    def log_ratio(self) -> F64:
        """Logarithms (n, class) of the likelihoods over that of a quiet pixel."""
        mixed = self.mixed()
        np.log(mixed, out=mixed)
        mixed += self.largest
        return mixed

    def neighbours(self) -> F64:
        """Products of neighbouring frames (n, class) to be expected, as in `_Moments`."""
        return np.asarray((self.likely @ self.products) * self.added / self.mixed())


@lru_cache(maxsize=64)
def _levels(keep: float, count: int) -> tuple[F64, F64]:
    """What a pixel of an amplitude shows in a number of frames, by its stays.

    One that stays long shows more or less of its two levels, or only one: it looks as if it had
    another amplitude.

    Returns
    -------
    chances : (level, class) float64
        That a pixel of a class has the variance that those of another have on average.
    products : (level, class) float64
        That chance, times the products of neighbouring frames it then has over its full variance.
    """
    rng = np.random.default_rng(0)
    turns = np.where(rng.random((count, _DRAWN)) < (1 - keep) / 2, -1.0, 1.0)
    states = np.cumprod(turns, axis=0)
    states -= states.mean(axis=0)
    seen = (states**2).sum(axis=0) / (count - 1)
    near = (states[1:] * states[:-1]).sum(axis=0) / (count - 1)
    step = np.log(AMPLITUDES[1] / AMPLITUDES[0])
    moves = np.rint(np.log(np.maximum(seen, 1e-12)) / 2 / step).astype(int)
    classes = np.arange(len(AMPLITUDES))
    chances, products = np.zeros((2, len(classes), len(classes)))
    for move in np.unique(moves):
        at = np.clip(classes + move, 0, classes[-1]), classes
        np.add.at(chances, at, np.mean(moves == move))
        np.add.at(products, at, near[moves == move].sum() / _DRAWN)
    return chances, products


def _joined(
    pixels: NDArray[np.intp], parts: Sequence[_Moments], classes: Iterable[_Classes]
) -> F64:
    """Logarithms (pixel, class) of the likelihood ratios of all series together."""
    total = np.zeros((len(pixels), len(AMPLITUDES)))
    for m, one in zip(parts, classes, strict=True):
        np.add.at(total, np.searchsorted(pixels, m.pixel), one.log_ratio())
    return total


@dataclass(frozen=True)
class _Mixture:
    """Likelihood ratios (pixel, class) over the largest of each pixel, and the logarithm of that.

    Pixels that are of no class are quiet; their ratio is one.
    """

    ratio: F64
    largest: F64
    logarithms: F64

    @classmethod
    def of(cls, logarithms: F64) -> "_Mixture":
        largest = logarithms.max(axis=1)
        return cls(np.exp(logarithms - largest[:, None]), largest, logarithms)

    def log_telegraph(self, weight: F64) -> F64:
        """Of each pixel, of all classes with their weights (class,)."""
        total = self.ratio @ weight
        found = self.largest + np.log(np.maximum(total, _UNDERFLOW))
        # Where the largest has hardly any weight the others have been rounded to nothing.
        lost = total <= _UNDERFLOW
        found[lost] = logsumexp(self.logarithms[lost], b=weight, axis=1)
        return found

    def log_likelihood(self, weight: F64) -> F64:
        """Of each pixel, quiet or not."""
        # Amplitudes below those looked at do nothing.
        quiet = np.log(max(1 - weight.sum(), 1e-12))
        return np.asarray(np.logaddexp(quiet, self.log_telegraph(weight)))

    def chance(self, weight: F64) -> F64:
        """Of each pixel, that it is not quiet."""
        return np.asarray(np.exp(self.log_telegraph(weight) - self.log_likelihood(weight)))

    def shares(self, weight: F64) -> F64:
        """Chances (pixel, class) of the classes, if it is not."""
        logarithms = self.logarithms + np.log(np.maximum(weight, _UNDERFLOW))
        return np.asarray(softmax(logarithms, axis=1))


def _curvature(cost: Callable[[F64], float], at: F64, step: float = 0.05) -> F64 | None:
    """Inverse of the second derivatives; None where it is not a minimum."""
    moves = step * np.eye(len(at))
    second = np.array(
        [
            [
                cost(at + a + b) - cost(at + a - b) - cost(at - a + b) + cost(at - a - b)
                for b in moves
            ]
            for a in moves
        ]
    ) / (4 * step**2)
    if np.linalg.eigvalsh(second)[0] <= 1e-9:
        return None
    return np.asarray(np.linalg.inv(second))
