"""Waves of one length and random direction in the power that two maps share: a ring.

Each scale, the wavelength over 2 pi, gives a template of such waves on the window, less a
parabola; with white power beside it, it is fitted to the cross power of two maps of independent
noise.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import j0

from pixcal.estimators.maps.map_fit import polynomial, without
from pixcal.model.arrays import F64

SHORTEST = 1.25  # shortest scale, px: crests of shorter waves are a few pixels apart
# ratio of the window's width to the longest scale: longer waves resemble parabolas
WIDEST = 4
STEP = 0.1  # step of the logarithm of the trial scales
# ratio of the window's width to a scale above which the removed parabola does not matter
NARROW = 12
# error of a wave's phase across the window, rad; larger in windows below `FEW` scales, where it
# depends on the position of few crests, and a parabola absorbs much
APART, FEW_APART, FEW = 0.5, 2.0, 10
DIRECTIONS = 16  # directions of longer waves, whose ring has few resolution elements
EDGE = 0.02  # power at the edge of the ring, over the template's highest power
_PARABOLA = 2


@dataclass(frozen=True)
class Ring:
    """Waves of one length common to two maps."""

    # variance, noise: of the waves in this window, with the part that a parabola absorbs; error
    variance: float
    noise: float
    # error of the variance as that of all waves of the kind, as a window holds few modes
    error: float
    # scale, scale_error: wavelength over 2 pi, px; the error is infinite without waves
    scale: float
    scale_error: float


def ring_power(power: F64) -> Ring:
    """Fit a ring to the cross power (y, x) of two maps: ``fft2(a) * conj(fft2(b))`` over px²."""
    shape = (power.shape[0], power.shape[1])
    scales, templates = _templates(shape)
    white = np.full(power.size, 1 / power.size)
    data = power.ravel()
    fits = [np.linalg.lstsq(np.stack([white, t], axis=1), data, rcond=None)[0] for t in templates]
    # Waves with negative power count as zero.
    both = zip(fits, templates, strict=True)
    left = [np.sum((data - c[0] * white - max(c[1], 0.0) * t) ** 2) for c, t in both]
    best = int(np.clip(np.argmin(left), 1, len(scales) - 2))
    variance, noise, modes = _sum_of_ring(data, templates[best])
    if variance <= 0:
        return Ring(variance, noise, noise, float(scales[best]), np.inf)
    slope = (templates[best + 1] - templates[best - 1]) / (2 * STEP)
    design = np.stack([white, templates[best], float(fits[best][1]) * slope], axis=1)
    unit = np.sqrt((design**2).sum(axis=0)) + 1e-300
    rows = np.linalg.pinv(design / unit, rcond=1e-8) / unit[:, None]
    projected = rows @ data
    # Waves fill the ring unevenly, so their scatter about it gives the error (Huber's sandwich),
    # which the resolution of the window limits.
    width = float(np.sqrt(2 * ((rows[2] * (data - design @ projected)) ** 2).sum()))
    scale = float(scales[best] * np.exp(np.clip(projected[2], -STEP, STEP)))
    apart = FEW_APART if scale * FEW > min(shape) else APART
    width = min(float(np.hypot(width, apart * scale / min(shape))), 0.75)
    # Error of the wavelength, larger towards longer wavelengths.
    width /= 1 - width
    # Relative to the expected variance, which may be larger than the measured one.
    draws = min(float(np.sqrt(2 / modes)), 0.75)
    error = float(np.hypot(noise, variance * draws / (1 - draws)))
    # A parabola absorbs more of longer waves.
    places = np.clip([best - width / STEP, best + width / STEP], 0, len(scales) - 1)
    ends = [_sum_of_ring(data, templates[int(n)])[0] for n in np.rint(places)]
    error = float(np.hypot(error, np.mean(np.abs(np.array(ends) - variance))))
    return Ring(variance, noise, error, scale, scale * width)


def _sum_of_ring(data: F64, template: F64) -> tuple[float, float, float]:
    """Variance of the waves from the ring's total power, its error by noise, number of modes."""
    # Waves fill the ring unevenly, which does not affect the sum. Modes k and -k of a real map
    # are equal.
    inside = template > EDGE * template.max()
    white, noise = float(data[~inside].mean()), float(data[~inside].var())
    power, share = float((data[inside] - white).sum()), float(template[inside].sum())
    # The waves' own power beats with the noise.
    spread = 2 * np.count_nonzero(inside) * noise + max(power, 0.0) * np.sqrt(2 * noise)
    modes = share**2 / float((template[inside] ** 2).sum())
    return power / share, max(float(np.sqrt(spread)) / share, 1e-300), modes


@lru_cache(maxsize=4)
def _templates(shape: tuple[int, int]) -> tuple[F64, F64]:
    """Scales (n,) and the mean power (n, y * x) of waves of unit variance on a window."""
    longest = max(min(shape) / WIDEST, SHORTEST * np.exp(4 * STEP))
    scales = np.exp(np.arange(np.log(SHORTEST), np.log(longest), STEP))
    short = [_of_short_waves(shape, s) for s in scales if s < min(shape) / NARROW]
    long = [_of_long_waves(shape, s) for s in scales[len(short) :]]
    return scales, np.stack([*short, *long]).reshape(len(scales), -1)


def _of_short_waves(shape: tuple[int, int], scale: float) -> F64:
    """Mean power (y, x) of all directions: the transform of a Bessel function."""
    ny, nx = shape
    dy, dx = np.arange(1 - ny, ny)[:, None], np.arange(1 - nx, nx)
    products = (1 - abs(dy) / ny) * (1 - abs(dx) / nx) * j0(np.hypot(dy, dx) / scale)
    wrapped = np.zeros(shape)
    np.add.at(wrapped, (dy % ny, dx % nx), products)
    return np.asarray(np.fft.fft2(wrapped).real / wrapped.size)


def _of_long_waves(shape: tuple[int, int], scale: float) -> F64:
    """Mean power (y, x) of waves of several directions, each minus its fitted parabola."""
    free = polynomial(shape, _PARABOLA).reshape(-1, shape[0] * shape[1]).T
    y, x = np.mgrid[: shape[0], : shape[1]].reshape(2, -1).astype(float)
    angle = np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    phase = (np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle))) / scale
    waves = without(np.sqrt(2) * np.hstack([np.cos(phase), np.sin(phase)]), free)
    power = np.abs(np.fft.fft2(waves.T.reshape(-1, *shape))) ** 2
    return np.asarray(power.mean(axis=0) / y.size**2)
