"""Agreement of two maps of the same pixels, scale by scale: common signal and noise.

The window is cut into blocks of 1, 2, 4, ... pixels a side. The squares of a map's block means,
each block counting with its pixels, fall from side to side; what they lose from one to the next is
the part of the map at that scale: a nested analysis of variance (of Haar's wavelets, where no pixel
is missing). The parts add up to the whole, and for white noise each holds as much per degree of
freedom as a pixel does. Products of two maps are decomposed in the same way: the signal common
to both is their covariance at a scale.

Modes that neither map can know are fitted to both and taken off before anything is compared. It is
done on the sums: a map less its modes has sums that follow from those of the map and the modes. So
maps of any size are read once, tile by tile.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from pixcal.kernels.normal_matrix import inverse_normal

F64 = NDArray[np.float64]

RCOND = 1e-8  # modes of the two sides that are alike to this (in their squares) count as one
# relative error of the maps' own errors that a difference is allowed before it counts
SIGMA_ACCURACY = 0.02
UPPER = float(ndtri(0.95))


@dataclass(frozen=True)
class Blocks:
    """Sums over blocks of equal side."""

    values: F64  # (k, y, x) sums of the maps and of the modes
    noise: F64  # (2, y, x) sums of the variances of the two maps
    count: F64  # (y, x) good pixels

    def coarser(self) -> "Blocks":
        """Blocks of twice the side; those at the far edges may be smaller."""
        return Blocks(halve(self.values), halve(self.noise), halve(self.count))

    def along(self, axis: int) -> "Blocks":
        """Sums along y (axis 1) or x (axis 2), kept as an axis of length one."""
        return Blocks(
            self.values.sum(axis=axis, keepdims=True),
            self.noise.sum(axis=axis, keepdims=True),
            self.count.sum(axis=axis - 1, keepdims=True),
        )

    def grouping(self) -> "Grouping":
        """What these blocks add to the analysis."""
        there = self.count > 0
        root = np.sqrt(np.where(there, self.count, 1.0))
        flat = (np.where(there, self.values, 0.0) / root).reshape(len(self.values), -1)
        noise = np.where(there, self.noise, 0.0) / root**2
        return Grouping(int(there.sum()), flat @ flat.T, noise.sum(axis=(1, 2)))


def halve(sums: F64) -> F64:
    """Sums (..., y, x) over blocks together, two by two along each axis."""
    ny, nx = sums.shape[-2:]
    width = [(0, 0)] * (sums.ndim - 2) + [(0, ny % 2), (0, nx % 2)]
    even = np.pad(sums, width) if ny % 2 or nx % 2 else sums
    return np.asarray(
        even[..., ::2, ::2] + even[..., 1::2, ::2] + even[..., ::2, 1::2] + even[..., 1::2, 1::2]
    )


@dataclass(frozen=True)
class Grouping:
    """Sums of squares of the means of groups of pixels."""

    groups: int  # those with a good pixel
    products: F64  # (k, k) sum over groups of products of means, each times its pixels
    noise: F64  # (2,) what the variances of the maps let expect of their squares

    def __add__(self, other: "Grouping") -> "Grouping":
        """Together with the groups of another part of the window."""
        return Grouping(
            self.groups + other.groups, self.products + other.products, self.noise + other.noise
        )


@dataclass(frozen=True)
class Projection:
    """The modes taken off both maps."""

    coefficients: F64  # (mode, 2) to take off the maps
    # (mode, mode) inverse of the modes' normal matrix; of modes that are alike, one counts
    inverse: F64

    @classmethod
    def of(cls, pixels: Grouping) -> "Projection":
        """Least squares on all good pixels alike.

        Parameters
        ----------
        pixels : Grouping
            Blocks of one pixel; the first two values are the maps.
        """
        normal, right = pixels.products[2:, 2:], pixels.products[2:, :2]
        inverse = inverse_normal(normal, RCOND)
        return cls(inverse @ right, inverse)

    def residual(self, values: F64) -> F64:
        """The two maps (or sums of them) less their modes: (k, ...) to (2, ...)."""
        return np.asarray(values[:2] - np.tensordot(self.coefficients.T, values[2:], 1))

    def left(self, products: F64) -> F64:
        """Products (2, 2) of the maps less their modes."""
        change = np.concatenate([np.eye(2), -self.coefficients])
        return np.asarray(change.T @ products @ change)

    def taken(self, products: F64) -> float:
        """Degrees of freedom that the modes took from a grouping."""
        return float(np.sum(self.inverse * products[2:, 2:]))


@dataclass(frozen=True)
class Part:
    """The two maps at one scale, as sums of squares over the window's good pixels (px²)."""

    pixels: int  # good pixels of the window
    freedom: float  # degrees of freedom, those of the modes taken off
    first: float  # first, second, both: squares of the maps, and their product
    second: float
    both: float
    noise: tuple[float, float]  # squares that their errors let expect

    @property
    def difference(self) -> float:
        """Square of the difference."""
        return max(self.first + self.second - 2 * self.both, 0.0)

    @property
    def expected(self) -> float:
        """Square of the difference that noise alone gives."""
        return sum(self.noise)

    def __add__(self, other: "Part") -> "Part":
        """Both scales together."""
        return Part(
            self.pixels, self.freedom + other.freedom, self.first + other.first,
            self.second + other.second, self.both + other.both,
            (self.noise[0] + other.noise[0], self.noise[1] + other.noise[1]),
        )  # fmt: skip


def part(fine: Grouping, coarse: Grouping, projection: Projection, pixels: int) -> Part:
    """Part of the maps at the scale of ``fine``: its sums less those of ``coarse``."""
    between = fine.products - coarse.products
    squares = projection.left(between)
    raw = fine.groups - coarse.groups
    freedom = max(raw - projection.taken(between), 0.0)
    noise = (fine.noise - coarse.noise) * (freedom / raw if raw else 0.0)
    return Part(
        pixels, freedom, float(squares[0, 0]), float(squares[1, 1]), float(squares[0, 1]),
        (float(noise[0]), float(noise[1])),
    )  # fmt: skip


@dataclass(frozen=True)
class VarianceEstimate:
    """A variance (px²) that may come out negative, its 1-sigma error, and both as an rms (px)."""

    variance: float
    error: float

    @property
    def rms(self) -> float:
        """Zero where the variance is not positive."""
        return math.sqrt(max(self.variance, 0.0))

    @property
    def rms_error(self) -> float:
        """How far the rms moves when the variance grows by its error."""
        return math.sqrt(max(self.variance, 0.0) + self.error) - self.rms

    @property
    def upper(self) -> float:
        """Upper limit of the rms, 95 %."""
        return math.sqrt(max(self.variance, 0.0) + UPPER * self.error)


def common(p: Part) -> VarianceEstimate:
    """Common signal of both maps, from their covariance."""
    error = np.sqrt((p.first * p.second + p.both**2) / p.freedom)
    return VarianceEstimate(p.both / p.pixels, float(error) / p.pixels)


def beyond_noise(p: Part, accuracy: float = SIGMA_ACCURACY) -> VarianceEstimate:
    """Excess of the difference over noise.

    Parameters
    ----------
    accuracy : float
        Relative error of the maps' own errors.
    """
    chance = 2 / p.freedom * max(p.difference, p.expected) ** 2
    error = np.sqrt(chance + (2 * accuracy * p.expected) ** 2)
    return VarianceEstimate((p.difference - p.expected) / p.pixels, float(error) / p.pixels)


def own(p: Part, accuracy: float = SIGMA_ACCURACY) -> tuple[VarianceEstimate, VarianceEstimate]:
    """Signal of each map that is neither noise nor common."""
    estimates = []
    for square, noise in zip((p.first, p.second), p.noise, strict=True):
        chance = (square * p.difference + (square - p.both) ** 2) / p.freedom
        error = np.sqrt(chance + (2 * accuracy * noise) ** 2)
        estimates.append(
            VarianceEstimate((square - p.both - noise) / p.pixels, float(error) / p.pixels)
        )
    return estimates[0], estimates[1]


def significance(p: Part, accuracy: float = SIGMA_ACCURACY) -> float:
    """Significance of the difference beyond noise, sigma (Wilson and Hilferty's cube root)."""
    if p.freedom < 1 or p.expected <= 0:
        return 0.0
    chance = 2 / (9 * p.freedom)
    root = (p.difference / p.expected) ** (1 / 3)
    return float((root - (1 - chance)) / np.sqrt(chance + (2 * accuracy / 3) ** 2))


@dataclass(frozen=True)
class StructuralLine:
    """The second map against the first, errors in both."""

    # slope, error: None where there is nothing in common to draw a line through
    slope: float | None
    error: float | None
    correlation: float  # correlation, correlation_error: of the maps as they are
    correlation_error: float


SEEN = 5.0  # sigma at which a covariance is a signal that a line can be drawn through


def straight_line(p: Part) -> StructuralLine:
    """Structural relation with known error variances (Fuller, Measurement Error Models, 1.3)."""
    root = np.sqrt(max(p.first * p.second, 1e-300))
    correlation = p.both / root
    scatter = (1 - correlation**2) / np.sqrt(max(p.freedom, 1.0))
    signal = common(p)
    if signal.variance < SEEN * signal.error or min(p.noise) <= 0:
        return StructuralLine(None, None, float(correlation), float(scatter))
    ratio = p.noise[1] / p.noise[0]
    lead = p.second - ratio * p.first
    slope = (lead + np.sqrt(lead**2 + 4 * ratio * p.both**2)) / (2 * p.both)
    # Variances of one degree of freedom: of the signal, of the noise along x, about the line.
    along, first = max(p.both / slope, 1e-300) / p.freedom, p.noise[0] / p.freedom
    about = max(p.second - 2 * slope * p.both + slope**2 * p.first, 0.0) / p.freedom
    variance = (along * about + first * about - (slope * first) ** 2) / along**2 / p.freedom
    error = np.sqrt(max(variance, about / along / p.freedom))
    return StructuralLine(float(slope), float(error), float(correlation), float(scatter))


@dataclass(frozen=True)
class Period:
    """The strongest wave of a profile."""

    px: float  # its period
    amplitude: float  # px
    chance: float  # of noise making one as strong, anywhere in the spectrum


def strongest_period(difference: F64, sigma: F64) -> Period | None:
    """The strongest wave of a profile (n,) whose errors are known; None where it is too short.

    Parameters
    ----------
    difference, sigma : (n,) float64
        px; NaN where there is no value.
    """
    good = np.isfinite(difference) & np.isfinite(sigma) & (sigma > 0)
    n = len(difference)
    if good.sum() < 8:
        return None
    pull = np.where(good, difference / np.where(good, sigma, 1.0), 0.0)
    power = np.abs(np.fft.rfft(pull)[1 : (n + 1) // 2]) ** 2 / good.sum()
    order = int(np.argmax(power)) + 1
    wave = np.exp(-2j * np.pi * order * np.arange(n) / n)
    amplitude = 2 * abs(np.where(good, difference, 0.0) @ wave) / good.sum()
    chance = -np.expm1(len(power) * np.log1p(-np.exp(-power.max()))) if power.max() > 0 else 1.0
    return Period(n / order, float(amplitude), float(chance))


def three_cornered_hat(
    pairs: Sequence[tuple[int, int]], excess: Sequence[VarianceEstimate]
) -> list[VarianceEstimate]:
    """Own errors of three or more maps, from the differences of all pairs.

    A difference's variance beyond noise is the sum of what its two maps hold (Gray and Allan 1974).

    Parameters
    ----------
    pairs : sequence of (int, int)
        Numbers of the maps of each pair.
    excess : sequence of VarianceEstimate
        From `beyond_noise`, of each pair.
    """
    design = np.zeros((len(pairs), 1 + max(map(max, pairs))))
    for row, pair in zip(design, pairs, strict=True):
        row[list(pair)] = 1.0
    weight = 1 / np.array([max(e.error, 1e-300) for e in excess]) ** 2
    inverse = np.linalg.inv(design.T @ (design * weight[:, None]))
    values = inverse @ (design.T @ (weight * np.array([e.variance for e in excess])))
    errors = np.sqrt(np.diag(inverse))
    return [VarianceEstimate(float(v), float(e)) for v, e in zip(values, errors, strict=True)]
