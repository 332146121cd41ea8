"""Moments of each pixel's noise, and evidence of jumps in them.

A pixel that is noisier than others need not jump. For Gaussian noise the kurtosis and the
normalised covariance of neighbouring frames are independent of the variance (Basu's theorem); so
their sums over pixels, weighted by the variance, have known mean and scatter.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.special import chdtri, lambertw

from pixcal.kernels.frame_order import follows
from pixcal.kernels.significance import sigmas_of_best
from pixcal.model.arrays import F64, Indices, Mask

NOISY = 3.0  # excess of the variance, in its own sigmas, from which a pixel is noisy
QUIET = 1 << 14  # most pixels of usual noise that are kept
_OUTLIER = 5.0  # standard deviations
# relative excess of the distance between quartiles of n variances over that of identical pixels,
# times the root of n: three errors (of normal numbers)
_DIFFER = 3.5
_MIN_FRAMES = 8


@dataclass(frozen=True)
class Series:
    """Noise of pixels in consecutive frames."""

    noise: F64  # (t, n) over the common noise, about the pixel's mean; NaN where there is none
    frame: Indices  # (t,) numbers of the frames
    pixel: Indices  # (n,) which pixels
    sigma: float  # the common noise, e-
    period_s: float  # from frame to frame; nan when unknown


@dataclass(frozen=True)
class Moments:
    """Moments of each pixel's noise in a series, in units of the common noise."""

    pixel: Indices
    count: F64  # samples
    variance: F64
    above: F64  # above, below: samples that are outliers upwards and downwards
    below: F64
    kurtosis: F64  # excess, unbiased
    product: F64  # mean product of neighbouring frames; NaN where there are none
    pairs: float  # neighbouring frames, over all but one
    samples_dof: float  # of the variance
    spread: float  # variance over pixels of the logarithm of their true variance
    sigma: float
    period_s: float
    frames: int  # that most pixels have
    stands_for: F64  # (n,) number of pixels that each represents: see `thinned`

    def of(self, pixels: Indices) -> "Moments":
        """Of some pixels (ascending) alone."""
        wanted = np.isin(self.pixel, pixels)
        arrays = ((name, v) for name, v in vars(self).items() if isinstance(v, np.ndarray))
        some: dict[str, Any] = {name: values[..., wanted] for name, values in arrays}
        return replace(self, **some)

    @property
    def dof(self) -> float:
        """Effective degrees of freedom of the variance: fewer where pixels differ."""
        return self.samples_dof / (1 + self.spread * self.samples_dof / 2)

    @property
    def excess(self) -> F64:
        """Variance beyond the common one; zero where not significant."""
        excess = self.variance - 1
        return np.where(excess > NOISY * np.sqrt(2 / self.dof), excess, 0)


def moments_of(series: Series, *, hits: bool = False) -> Moments | None:
    """Moments of the noise of each pixel, or None; ``hits``: whether particles count."""
    x = series.noise - np.nanmedian(series.noise, axis=0)
    above, below = (np.count_nonzero(way * x > _OUTLIER, axis=0) for way in (1, -1))
    if not hits:
        x[_particles(x)] = np.nan
    n = np.isfinite(x).sum(axis=0).astype(float)
    used = n > _MIN_FRAMES
    if not used.any():
        return None
    x, n = x[:, used], n[used]
    x = np.nan_to_num(x - np.nanmean(x, axis=0))
    square = np.maximum((x**2).sum(axis=0), 1e-12)
    variance = square / (n - 1)
    kurtosis = n * ((x * x) ** 2).sum(axis=0) / square**2 - 3
    kurtosis = (n - 1) / ((n - 2) * (n - 3)) * ((n + 1) * kurtosis + 6)
    paired = np.flatnonzero(follows(series.frame))
    pairs = len(paired) / (len(x) - 1)
    product = np.full(x.shape[1], np.nan)
    if len(paired):
        product = (x[paired] * x[paired - 1]).sum(axis=0) / (n - 1) / pairs
    dof = float(np.median(n)) - 1
    centre = np.median(variance) * dof / chdtri(dof, 0.5)
    # Half the pixels lie between the quartiles, whatever the noisy ones do.
    low, high = np.quantile(variance / centre, (0.25, 0.75))
    wide = float(np.log(high / low) / np.diff(np.log(chdtri(dof, (0.75, 0.25))))[0])
    differ = wide - 1 > _DIFFER / np.sqrt(len(variance))
    return Moments(
        series.pixel[used],
        n,
        variance / centre,
        above[used].astype(float),
        below[used].astype(float),
        kurtosis,
        product / centre,
        pairs,
        dof,
        (wide**2 - 1) * 2 / dof if differ else 0.0,
        series.sigma * float(np.sqrt(centre)),
        series.period_s if np.isfinite(series.period_s) and series.period_s > 0 else 1.0,
        int(np.median(n)),
        np.ones(np.count_nonzero(used)),
    )


def all_moments(series: Sequence[Series], *, hits: bool = False) -> list[Moments]:
    """Moments of the series that have any."""
    return [m for s in series if (m := moments_of(s, hits=hits)) is not None]


def _particles(noise: F64) -> Mask:
    """Samples (t, n) far beyond all others of their pixel, unlike jumps between two levels."""
    square = np.nan_to_num(noise**2)
    largest, n = square.max(axis=0), np.isfinite(noise).sum(axis=0)
    others = (square.sum(axis=0) - largest) / np.maximum(n - 2, 1)
    particles: Mask = square > _OUTLIER**2 * np.maximum(others, 1)
    return np.asarray(particles & (particles.sum(axis=0) == 1))


def thinned(parts: Sequence[Moments]) -> list[Moments]:
    """All pixels noisy in any series, and `QUIET` others, each representing several."""
    pixels = np.unique(np.concatenate([m.pixel for m in parts]))
    noisy = np.unique(np.concatenate([m.pixel[m.excess > 0] for m in parts]))
    quiet = np.setdiff1d(pixels, noisy, assume_unique=True)
    if len(quiet) <= QUIET:
        return [*parts]
    chosen = np.random.default_rng(0).choice(quiet, QUIET, replace=False)
    kept, each = np.sort(np.concatenate([noisy, chosen])), len(quiet) / QUIET
    some = [m.of(kept) for m in parts]
    return [replace(m, stands_for=np.where(np.isin(m.pixel, noisy), 1.0, each)) for m in some]


@dataclass(frozen=True)
class Signs:
    """Evidence of jumps in all pixels, in sigmas of Gaussian noise of any size."""

    flat_top: float  # two levels that are about equally frequent
    # outliers that recur in the same pixels on one side only: a rare level, the upper one
    # (positive) or the lower one
    one_sided: float
    staying: float  # correlation of neighbouring frames
    noisy: int  # number of noisy pixels

    @property
    def significance(self) -> float:
        """Of the clearest sign."""
        return sigmas_of_best(self.flat_top, self.one_sided, -self.one_sided, self.staying)


def signs(parts: Sequence[Moments]) -> Signs:
    """Flatness, asymmetry and frame-to-frame correlation of the noise of pixels."""
    flat = flat_variance = stay = stay_variance = more = more_variance = 0.0
    noisy: set[int] = set()
    for m in parts:
        n, part = m.count, m.excess / (1 + m.excess)
        of_kurtosis = 24 * n * (n - 1) ** 2 / ((n - 3) * (n - 2) * (n + 3) * (n + 5))
        flat -= float(part**2 @ m.kurtosis)
        flat_variance += float(part**4 @ of_kurtosis)
        # Mean and variance for white noise, exact (Moran 1948, Biometrika 35, 255).
        stay += float(part @ (m.product / m.variance + 1 / n))
        stay_variance += float(part**2 @ ((n - 2) ** 2 / (n**2 * (n - 1)))) / m.pairs
        for sign, counts in ((1, m.above), (-1, m.below)):
            again, by_chance = _recur(counts)
            more += sign * (again - by_chance)
            more_variance += again + by_chance
        noisy.update(m.pixel[m.excess > 0].tolist())
    if not flat_variance:
        return Signs(0.0, 0.0, 0.0, 0)
    one_sided = float(more / (more_variance + 1) ** 0.5)
    return Signs(flat / flat_variance**0.5, one_sided, stay / stay_variance**0.5, len(noisy))


def _recur(counts: F64) -> tuple[int, float]:
    """Number of pixels with several outliers, and that expected from random hits."""
    once = np.count_nonzero(counts == 1) / len(counts)
    # Of a Poisson distribution with this share of ones: the root below one.
    rate = -float(np.real(lambertw(-min(once, np.exp(-1)))))
    by_chance = len(counts) * (1 - np.exp(-rate) * (1 + rate))
    return int(np.count_nonzero(counts > 1)), float(by_chance)
