"""Agreement of two maps of the same pixels, scale by scale: common signal and noise.

The squares of a map's means over blocks of 1, 2, 4, ... pixels a side fall with the side. The loss
from one side to the next is the part of the map at that scale (a nested analysis of variance). The
parts add up, and for white noise each has the variance of a pixel per degree of freedom. Products
of two maps are decomposed in the same way: the common signal is their covariance at a scale.

Modes degenerate in either map are removed from the sums of products, so that maps of any size are
read once, tile by tile. Sums over blocks are one array (k + 3, y, x): of the two maps and their
modes (k), of the maps' variances (2), and of the good pixels.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import ndtri

from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F64

SEEN = 5.0  # sigma above which a covariance is a signal to which a line can be fitted
SIGMA_ACCURACY = 0.02  # relative error of the maps' errors to tolerate before a difference counts


def halve(sums: F64) -> F64:
    """Sums (..., y, x) over blocks of twice the side; blocks at the far edges may be smaller."""
    ny, nx = sums.shape[-2:]
    rows = np.add.reduceat(sums, range(0, ny, 2), axis=-2)
    return np.asarray(np.add.reduceat(rows, range(0, nx, 2), axis=-1))


class Grouping(NamedTuple):
    """Sums of squares of the means of groups of pixels."""

    groups: int  # number of groups with a good pixel
    products: F64  # (k, k) sum over groups of products of means, each times its number of pixels
    noise: F64  # (2,) expected squares of the maps from their variances

    @classmethod
    def of(cls, sums: F64) -> "Grouping":
        """From sums over blocks (k + 3, y, x)."""
        used = sums[:, sums[-1] > 0]
        means = used[:-3] / np.sqrt(used[-1])
        return cls(used.shape[1], means @ means.T, (used[-3:-1] / used[-1]).sum(axis=1))


def double(sums: F64, times: int) -> tuple[list[Grouping], F64]:
    """Groupings of blocks of 1, 2, ... 2**times their side, and the sums over the last."""
    groupings = [Grouping.of(sums)]
    for _ in range(times):
        sums = halve(sums)
        groupings.append(Grouping.of(sums))
    return groupings, sums


@dataclass(frozen=True)
class Projection:
    """The modes removed from both maps, by unweighted least squares on all good pixels."""

    change: F64  # (2, 2 + mode) the maps without their modes, from maps and modes
    inverse: F64  # (mode, mode) inverse of the modes' normal matrix; equal modes count once

    @classmethod
    def of(cls, pixels: Grouping) -> "Projection":
        """From blocks of one pixel; the first two values are the maps."""
        # Modes of the two sides that agree to 1e-8 (in their squares) count once.
        inverse = inverse_normal(pixels.products[2:, 2:], 1e-8)
        return cls(np.hstack([np.eye(2), -pixels.products[:2, 2:] @ inverse]), inverse)

    def difference(self, values: F64) -> tuple[F64, F64, F64]:
        """Both maps (k, ...) without their modes, and the second minus the first."""
        first, second = np.tensordot(self.change, values, 1)
        return first, second, second - first

    def part(self, fine: Grouping, coarse: Grouping, pixels: int) -> "Part":
        """Part of the maps at the scale of ``fine``: its sums minus those of ``coarse``."""
        between = fine.products - coarse.products
        (first, both), (_, second) = self.change @ between @ self.change.T
        raw = fine.groups - coarse.groups
        freedom = max(raw - self.taken(between), 0.0)
        noise = (fine.noise - coarse.noise) * (freedom / raw if raw else 0.0)
        return Part(pixels, freedom, float(first), float(second), float(both), (noise[0], noise[1]))

    def taken(self, products: F64) -> float:
        """Degrees of freedom that removal of the modes takes from products (k, k)."""
        return float(np.sum(self.inverse * products[2:, 2:]))


class VarianceEstimate(NamedTuple):
    """A variance (px²) that may come out negative, and its 1-sigma error."""

    variance: float
    error: float

    def facts(self) -> dict[str, float]:
        """As rms (px, at least 0) with its error and 95 % upper limit, and as variance."""
        positive = max(self.variance, 0.0)
        rms = math.sqrt(positive)
        return {
            "px": rms,
            "error_px": math.sqrt(positive + self.error) - rms,
            "upper_px": math.sqrt(positive + float(ndtri(0.95)) * self.error),
            "variance_px2": self.variance,
            "variance_error_px2": self.error,
        }


class StructuralLine(NamedTuple):
    """Line fitted to the second map against the first, errors in both, and their correlation."""

    correlation: float
    correlation_error: float
    slope: float | None  # None without a common signal
    slope_error: float | None


@dataclass(frozen=True)
class Part:
    """The two maps at one scale, as sums of squares over the window's good pixels (px²)."""

    pixels: float  # good pixels of the window
    freedom: float  # degrees of freedom, less those of the removed modes
    first: float  # first, second, both: squares of the maps, and their product
    second: float
    both: float
    noise: tuple[float, float]  # expected squares from the errors of the maps

    @property
    def difference(self) -> float:
        """Square of the difference."""
        return max(self.first + self.second - 2 * self.both, 0.0)

    @property
    def expected(self) -> float:
        """Square of the difference expected from noise alone."""
        return sum(self.noise)

    @property
    def correlation(self) -> float:
        """Correlation of the two maps."""
        return float(self.both / np.sqrt(max(self.first * self.second, 1e-300)))

    def _estimate(self, square: float, chance: float, noise: float = 0.0) -> VarianceEstimate:
        """From a sum of squares, its chance variance, and noise with an error."""
        error = math.sqrt(chance / self.freedom + noise**2)
        return VarianceEstimate(square / self.pixels, error / self.pixels)

    def common(self) -> VarianceEstimate:
        """Common signal of both maps, from their covariance."""
        return self._estimate(self.both, self.first * self.second + self.both**2)

    def beyond_noise(self, accuracy: float = SIGMA_ACCURACY) -> VarianceEstimate:
        """Excess of the difference over noise of the given relative accuracy."""
        excess, chance = self.difference - self.expected, max(self.difference, self.expected)
        return self._estimate(excess, 2 * chance**2, 2 * accuracy * self.expected)

    def own(self, accuracy: float = SIGMA_ACCURACY) -> list[VarianceEstimate]:
        """Signal of each map that is neither noise nor common to both."""
        return [
            self._estimate(
                square - self.both - noise,
                square * self.difference + (square - self.both) ** 2,
                2 * accuracy * noise,
            )
            for square, noise in zip((self.first, self.second), self.noise, strict=True)
        ]

    def significance(self, accuracy: float = SIGMA_ACCURACY) -> float:
        """Significance of the excess difference, sigma (Wilson and Hilferty's cube root)."""
        if self.freedom < 1 or self.expected <= 0:
            return 0.0
        chance = 2 / (9 * self.freedom)
        root = (self.difference / self.expected) ** (1 / 3)
        return float((root - (1 - chance)) / np.sqrt(chance + (2 * accuracy / 3) ** 2))

    def line(self) -> StructuralLine:
        """Structural relation, error variances known (Fuller, Measurement Error Models, 1.3)."""
        scatter = float((1 - self.correlation**2) / np.sqrt(max(self.freedom, 1.0)))
        signal = self.common()
        if signal.variance < SEEN * signal.error or min(self.noise) <= 0:
            return StructuralLine(self.correlation, scatter, None, None)
        ratio = self.noise[1] / self.noise[0]
        lead = self.second - ratio * self.first
        slope = (lead + np.sqrt(lead**2 + 4 * ratio * self.both**2)) / (2 * self.both)
        # Variances per degree of freedom: of the signal, of the noise along x, about the line.
        along, first = max(self.both / slope, 1e-300) / self.freedom, self.noise[0] / self.freedom
        about = max(self.second - 2 * slope * self.both + slope**2 * self.first, 0.0) / self.freedom
        variance = (along * about + first * about - (slope * first) ** 2) / along**2 / self.freedom
        error = np.sqrt(max(variance, about / along / self.freedom))
        return StructuralLine(self.correlation, scatter, float(slope), float(error))


class Period(NamedTuple):
    """The strongest wave of a profile."""

    px: float  # its period
    amplitude_px: float
    chance: float  # probability of so strong a wave from noise, anywhere in the spectrum


def strongest_period(difference: F64, sigma: F64) -> Period | None:
    """Strongest wave of a profile (n,), px, given its errors; None if it is too short."""
    good = np.isfinite(difference) & np.isfinite(sigma) & (sigma > 0)
    n = len(difference)
    if good.sum() < 8:
        return None
    pull = np.where(good, difference / np.where(good, sigma, 1.0), 0.0)
    power = np.abs(np.fft.rfft(pull)[1 : (n + 1) // 2]) ** 2 / good.sum()
    order = int(np.argmax(power)) + 1
    wave = np.exp(-2j * np.pi * order * np.arange(n) / n)
    amplitude = 2 * abs(np.where(good, difference, 0.0) @ wave) / good.sum()
    chance = -np.expm1(len(power) * np.log(-np.expm1(-power.max()))) if power.max() > 0 else 1.0
    return Period(n / order, float(amplitude), float(chance))


def three_cornered_hat(
    pairs: Sequence[tuple[int, int]], excess: Sequence[VarianceEstimate]
) -> list[VarianceEstimate]:
    """Variance beyond noise of each of three or more maps, from all pairs."""
    # A difference's variance beyond noise (`Part.beyond_noise`) is the sum of those of its maps
    # (Gray and Allan 1974).
    values, errors = np.array(excess).T
    design = np.zeros((len(pairs), 1 + max(map(max, pairs))))
    np.put_along_axis(design, np.array(pairs), 1 / np.maximum(errors, 1e-300)[:, None], axis=1)
    inverse = np.linalg.pinv(design)
    variances, errors = inverse @ (values * design.max(axis=1)), np.hypot.reduce(inverse, axis=1)
    return [VarianceEstimate(float(v), float(e)) for v, e in zip(variances, errors, strict=True)]
