"""Telegraph noise of a population of pixels, from the moments of each one's noise.

A pixel that jumps by A between two equally likely levels has A²/4 more variance. The distribution
of the variances gives the share of such pixels and their mean amplitude, by maximum likelihood:
most pixels have the common noise, a share has more, with A from an exponential distribution.

A pixel could also just be noisier. Of Gaussian noise of any size the kurtosis and the correlation
of neighbouring frames, each over the variance, do not depend on the variance (Basu's theorem); so
their sums over pixels, weighted by the variance, have known mean and scatter.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq, minimize
from scipy.special import expit, logsumexp
from scipy.stats import chi2

from pixcal.kernels.significance import sigmas_of_best

F64 = NDArray[np.float64]

AMPLITUDES = np.geomspace(0.1, 300, 90)
"""Amplitudes over the common noise that are looked at."""

NOISY = 3.0
"""Excess of the variance, in its own sigmas, from which a pixel's noise is looked at."""

CLEAR = 1.0
"""Excess of the variance, over the common one, from which a pixel's time is measured."""

_FEW = 5
_OUTLIER = 5.0
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
    switching, switching_error = _switching(parts)
    share, amplitude, errors = _population(parts, switching)
    return Telegraph(
        share, amplitude, switching, *errors, switching_error,
        sigmas_of_best(flat_top, staying), flat_top, staying, noisy,
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


def _seen(keep: float, count: float) -> tuple[float, float]:
    """What is seen in a number of frames of a variance of one that stays by ``keep`` a frame.

    Returns
    -------
    variance : float
        About the mean of the frames.
    neighbours : float
        As in `_Moments`.
    """
    n = int(count)
    lag = np.arange(1, n)
    powers = keep**lag
    # Correlation with the mean: of all frames on average, and of the first or last one.
    mean = (n + 2 * np.sum((n - lag) * powers)) / n**2
    end = (1 + powers.sum()) / n
    variance = n * (1 - mean) / (n - 1)
    return float(variance), float(keep - ((n + 1) * mean - 2 * end) / (n - 1))


def _keep(switching_s: float, period_s: float) -> float:
    return float(np.exp(-2 * period_s / switching_s)) if switching_s > 0 else 0.0


def _switching(parts: Sequence[_Moments]) -> tuple[float, float]:
    """Mean stay in a level and its error, s, from neighbouring frames of the noisy pixels."""
    period = min(m.period_s for m in parts)
    # Of pixels that barely stand out many do so by chance, and too far.
    clear = max((np.count_nonzero(m.excess > CLEAR) for m in parts), default=0) >= _FEW
    excesses = [np.where(m.excess > CLEAR * clear, m.excess, 0) for m in parts]

    def rest(log_time: float) -> tuple[float, float]:
        """Products of neighbours beyond those for a time, and their error."""
        total = square = 0.0
        for m, excess in zip(parts, excesses, strict=True):
            count = float(np.median(m.count))
            variance, neighbours = _seen(_keep(np.exp(log_time), m.period_s), count)
            expected = neighbours / variance * excess
            left = np.where(excess > 0, m.neighbours + 1 / m.count - expected, 0)
            total += float(left.sum())
            square += float(left @ left)
        return total, square**0.5

    low, high = np.log(0.1 * period), np.log(1e3 * period)

    def solved(more: float) -> float:
        """Logarithm of the time for which so much more than was measured is expected."""
        if rest(high)[0] + more >= 0:
            return float(high)
        return float(brentq(lambda v: rest(v)[0] + more, low, high, xtol=1e-4))

    none, error = rest(low)
    if none <= 3 * error:
        longest = float(np.exp(solved(error))) if none + error > 0 else 0.0
        return 0.0, max(longest, period)
    found = solved(0.0)
    slope = abs(rest(found + 0.05)[0] - rest(found - 0.05)[0]) / 0.1
    return float(np.exp(found)), float(np.exp(found) * rest(found)[1] / max(slope, 1e-12))


def _population(
    parts: Sequence[_Moments], switching_s: float
) -> tuple[float, float, tuple[float, float]]:
    """Share of the pixels, their mean amplitude (e-), and the errors of both."""
    pixels = np.unique(np.concatenate([m.pixel for m in parts]))
    unit = min(m.sigma for m in parts)
    log_ratio = np.zeros((len(pixels), len(AMPLITUDES)))
    for m in parts:
        count = float(np.median(m.count))
        seen, _ = _seen(_keep(switching_s, m.period_s), count)
        variance = 1 + seen * (AMPLITUDES * unit / m.sigma / 2) ** 2
        ratio = m.dof / 2 * (m.variance[:, None] * (1 - 1 / variance) - np.log(variance))
        np.add.at(log_ratio, np.searchsorted(pixels, m.pixel), ratio)

    mixture = _Mixture.of(log_ratio)

    def cost(p: F64) -> float:
        share, mean = expit(p[0]), np.exp(p[1])
        weight = AMPLITUDES / mean * np.exp(-AMPLITUDES / mean) * np.gradient(np.log(AMPLITUDES))
        # Amplitudes below those looked at do nothing.
        telegraph = mixture.log_likelihood(share * weight)
        return -float(np.logaddexp(np.log(max(1 - share * weight.sum(), 1e-12)), telegraph).sum())

    start = np.array([-4.0, 1.0])
    best = minimize(cost, start, method="Nelder-Mead", options={"xatol": 1e-3, "fatol": 1e-3}).x
    share, mean = float(expit(best[0])), float(np.exp(best[1]))
    covariance = _curvature(cost, best)
    if covariance is None:
        return share, unit * mean, (1.0, unit * mean)
    errors = np.sqrt(np.diag(covariance))
    return (
        share,
        unit * mean,
        (
            float(min(errors[0] * share * (1 - share) + 1e-9, 1.0)),
            float(unit * mean * errors[1]),
        ),
    )


@dataclass(frozen=True)
class _Mixture:
    """Likelihoods (pixel, class) over the largest of each pixel, and the logarithm of that."""

    ratio: F64
    largest: F64
    logarithms: F64

    @classmethod
    def of(cls, logarithms: F64) -> "_Mixture":
        largest = logarithms.max(axis=1)
        return cls(np.exp(logarithms - largest[:, None]), largest, logarithms)

    def log_likelihood(self, weight: F64) -> F64:
        """Of each pixel, with weights (class,) of the classes."""
        total = self.ratio @ weight
        found = self.largest + np.log(np.maximum(total, _UNDERFLOW))
        # Where the largest has hardly any weight the others have been rounded to nothing.
        lost = total <= _UNDERFLOW
        found[lost] = logsumexp(self.logarithms[lost], b=weight, axis=1)
        return found


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
