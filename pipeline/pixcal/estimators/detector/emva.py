"""Figures of merit of a detector after EMVA 1288 (release 4.0), in electrons.

Spatial nonuniformity is measured from two averages of independent frames, such as the even and the
odd ones: their common part belongs to the detector, their difference is noise, and no noise model
is needed. Analysis of variance splits it into rows, columns and pixels (Searle, Casella and
McCulloch, *Variance Components*, 1992, section 4.3).
"""

import math
from dataclasses import dataclass

import numpy as np

from pixcal.model.arrays import F64, Mask

Measure = tuple[float, float]  # a value and its 1-sigma error

# variance over its maximum below which samples saturate: noise alone does not fall so far
_FALL = 0.8
# the same for full pixels, which have only read noise
_FULL = 0.1
_BLOCKS = 16


@dataclass(frozen=True)
class Nonuniformity:
    """Standard deviations over the detector, each with its error."""

    # total, row, column, pixel: of the map; of the part common to each row, to each column; of
    # the rest. Zero where the variance is negative by chance, with the detectable standard
    # deviation
    total: Measure
    row: Measure
    column: Measure
    pixel: Measure


def nonuniformity(a: F64, b: F64, lost: int) -> Nonuniformity:
    """Nonuniformity that two averages of independent frames have in common.

    ``a, b``: (y, x) averages of as many frames, in any unit, as `without_gaps` gives them.
    ``lost``: number of bad pixels.
    """
    ny, nx = a.shape
    dofs = np.array([ny - 1, nx - 1, max((ny - 1) * (nx - 1) - lost, 1)], float)
    own = np.array([_squares(a, a), _squares(b, b)]) / dofs
    shared = _squares(a, b) / dofs
    # Variance of a sample covariance of normal variables.
    spread = (shared**2 + own[0] * own[1]) / dofs
    pixel = float(shared[2])
    row, column = float(shared[0] - pixel) / nx, float(shared[1] - pixel) / ny
    errors = np.sqrt([(spread[0] + spread[2]) / nx**2, (spread[1] + spread[2]) / ny**2, spread[2]])
    total_error = math.sqrt(spread[0] / nx**2 + spread[1] / ny**2 + spread[2])
    each = map(_root, (row, column, pixel), errors)
    return Nonuniformity(_root(row + column + pixel, total_error), *each)


def without_gaps(values: F64, good: Mask) -> F64:
    """The map (y, x) less its mean; bad pixels are filled in from their rows and columns."""
    count = np.maximum(good.sum(axis=1), 1), np.maximum(good.sum(axis=0), 1)
    values = np.where(good, values - values[good].mean(), 0.0)
    rows = values.sum(axis=1) / count[0]
    columns = (values - np.where(good, rows[:, None], 0.0)).sum(axis=0) / count[1]
    return np.where(good, values, rows[:, None] + columns)


def _squares(a: F64, b: F64) -> F64:
    """Sums of products between rows, between columns, and of what is left."""
    ny, nx = a.shape
    a, b = a - a.mean(), b - b.mean()
    row = nx * float(a.mean(axis=1) @ b.mean(axis=1))
    column = ny * float(a.mean(axis=0) @ b.mean(axis=0))
    return np.array([row, column, float((a * b).sum()) - row - column])


def _root(variance: float, error: float) -> Measure:
    value = math.sqrt(max(variance, 0.0))
    return (value, error / (2 * value)) if variance > error else (value, math.sqrt(error))


def alternation(a: F64, b: F64, *, axis: int) -> Measure:
    """Excess of every second row (axis 0) or column (axis 1) over the others."""
    # Twice the amplitude at the Nyquist frequency; the error is from the scatter over the lines.
    means = (a.mean(axis=1 - axis) + b.mean(axis=1 - axis)) / 2
    # Slow structure differs little between neighbours; only pairs of lines are compared.
    steps = np.diff(means)
    signed = steps * (-1.0) ** np.arange(len(steps))
    # Neighbouring steps share a line: blocks of them are independent, or nearly so.
    size = max(len(signed) // _BLOCKS, 2)
    blocks = signed[: len(signed) // size * size].reshape(-1, size).mean(axis=1)
    if len(blocks) < 2:
        return 0.0, math.inf
    return abs(float(blocks.mean())), float(blocks.std(ddof=1)) / math.sqrt(len(blocks))


def without_trend(values: F64, good: Mask) -> F64:
    """Signal (y, x) above bias and dark over a surface of second degree through the good pixels."""
    powers = [np.linspace(-1, 1, n)[:, None] ** np.arange(5) for n in values.shape]
    relative = np.where(good, values / values[good].mean(), 0.0)
    # Sums of x^m y^n over the good pixels are products with these matrices.
    of_y, of_x = (p[:, :3] for p in powers)
    moments, right = powers[0].T @ good @ powers[1], of_y.T @ relative @ of_x
    y, x = np.nonzero(np.add.outer(np.arange(3), np.arange(3)) < 3)
    normal = moments[np.add.outer(y, y), np.add.outer(x, x)]
    terms = np.zeros((3, 3))
    terms[y, x] = np.linalg.lstsq(normal, right[y, x])[0]
    trend = of_y @ terms @ of_x.T
    return relative - trend


def spectrogram(a: F64, b: F64, *, axis: int) -> tuple[F64, F64, float]:
    """Spectrum of the mean of two averages (y, x), as for `nonuniformity`, along an axis (1: rows).

    Returns the frequencies (n,), cycles per pixel without zero; the roots (n,) of the mean power of
    all rows or columns, which are s everywhere for white noise of rms s; and the same for the noise
    of the map.
    """
    n = a.shape[axis]
    scale = 1 / math.sqrt(n)
    power = np.abs(np.fft.rfft((a + b) / 2, axis=axis) * scale) ** 2
    noise = np.abs(np.fft.rfft((a - b) / 2, axis=axis) * scale) ** 2
    mean = power.mean(axis=1 - axis)[1:]
    frequency: F64 = np.fft.rfftfreq(n)[1:].astype(float)
    return frequency, np.sqrt(mean), math.sqrt(noise.mean())


def transfer_points(sums: F64, most: int = 60) -> F64:
    """Photon-transfer curve (point, 3): level (ADU), variance of a sample (ADU²) and its error.

    ``sums``: (bin, 3 or more) of `photon_transfer.bin_pairs`; neighbouring bins are merged into at
    most ``most`` points.
    """
    filled = sums[sums[:, 0] > 0]
    if not len(filled):
        return np.empty((0, 3))
    size = -(-len(filled) // most)
    dof, level, variance = np.add.reduceat(filled[:, :3], np.arange(0, len(filled), size)).T
    level, variance = level / dof, variance / dof
    return np.stack([level, variance, variance * np.sqrt(2 / dof)], axis=1)


def saturation(points: F64) -> Measure | None:
    """Level (ADU) at which pixels become full, if the variance falls.

    Halfway from the photon-transfer curve's maximum to the level where the variance has fallen, and
    half their distance. ``points``: (point, 3) of `transfer_points`. None where the curve rises to
    its end: saturation was not reached.
    """
    if len(points) < 2:
        return None
    # The variance of few pixels may be high by chance.
    peak = int((points[:, 1] - 2 * points[:, 2]).argmax())
    fallen = _fallen(points, peak, _FALL)
    if not len(fallen):
        return None
    ends = float(points[peak, 0]), float(fallen[0])
    return sum(ends) / 2, (ends[1] - ends[0]) / 2


def full_level(points: F64) -> float:
    """Lowest level (ADU) of full pixels, which have only read noise; infinite without any."""
    # With few levels the curve's maximum may lie far below.
    full = _fallen(points, int(points[:, 1].argmax()), _FULL) if len(points) else points
    return float(full[0]) if len(full) else math.inf


def _fallen(points: F64, peak: int, share: float) -> F64:
    """Levels beyond a peak where the variance is below ``share`` of it, and not by chance."""
    level, variance, error = points[peak + 1 :].T
    # 3-sigma limit of a chi-square (Wilson and Hilferty 1931), without scatter where it is zero.
    part = error / np.maximum(variance, 1e-30)
    return np.asarray(level[variance < share * points[peak, 1] * (1 - part - part**2 / 9) ** 3])


def dynamic_range(full_well: Measure, read_noise: Measure) -> tuple[float, float, float]:
    """Saturation over the least detectable signal (signal-to-noise ratio of one).

    Arguments are values with errors (e-); returns the ratio, its error, and decibels.
    """
    # Signal whose shot noise and read noise together equal it: n² = n + σ².
    root = math.sqrt(read_noise[0] ** 2 + 0.25)
    least, least_error = root + 0.5, read_noise[0] / root * read_noise[1]
    ratio = full_well[0] / least
    error = ratio * math.hypot(full_well[1] / full_well[0], least_error / least)
    return ratio, error, 20 * math.log10(ratio)


def dark_slope(times: F64, means: F64) -> Measure | None:
    """Dark signal (per second) from the means of frames, with an error from their scatter.

    A black level that is reset at each exposure time moves the means off the line; that scatter is
    used if larger. ``times``: (frame,) s. None with fewer than three frames or a single exposure
    time.
    """
    if len(times) < 3:
        return None
    lever = times - times.mean()
    square = float(lever @ lever)
    if square <= 0:
        return None
    slope = float(lever @ means) / square
    rest = means - means.mean() - slope * lever
    variance = float(rest @ rest) / (len(times) - 2)
    every, group = np.unique(times, return_inverse=True)
    if len(every) > 2:
        count = np.bincount(group)
        off = np.bincount(group, rest) / count
        variance = max(variance, float(count @ off**2) / (len(every) - 2))
    return slope, math.sqrt(variance / square)
