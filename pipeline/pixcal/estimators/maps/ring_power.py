"""Power that two maps share at one distance from the origin of wave numbers.

Waves of random direction and one length make a ring there. Each scale, the wavelength over 2 pi,
has the mean power of such waves on the window as a template, less what a parabola takes of them;
with white power beside it the template is fitted to the cross power of two maps whose noise is not
the same, which therefore has none.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import j0

from pixcal.estimators.maps.map_fit import polynomial, without
from pixcal.model.arrays import F64

SHORTEST = 1.25  # scale, px: a shorter wave is no more than two or three pixels from crest to crest
# windows are this many times as wide as the longest scale: longer waves are parabolas there
WIDEST = 4
STEP = 0.1  # of the logarithm of the scales that are tried
# windows are this many times as wide as scales of which a parabola takes nothing that matters
NARROW = 12
DIRECTIONS = 16  # of longer waves, whose ring has no more places
EDGE = 0.02  # of the template's highest power, beyond which the ring ends
_PARABOLA = 2


@dataclass(frozen=True)
class Ring:
    """Waves of one length that two maps share."""

    # variance, noise: of the waves in this window, whatever a parabola takes of them, and its error
    variance: float
    noise: float
    # of the same as that of all waves of the kind, of which few beat with each other in a window
    error: float
    # scale, scale_error: wavelength over 2 pi, px; the error is infinite where nothing is there
    scale: float
    scale_error: float


def ring_power(power: F64) -> Ring:
    """Fit a ring to the cross power (y, x) of two maps from which parabolas were taken.

    That is the real part of ``fft2(a) * conj(fft2(b))`` over pixels squared: its sum is the mean
    product.
    """
    shape = (power.shape[0], power.shape[1])
    scales, templates = _templates(shape)
    white = np.full(power.size, 1 / power.size)
    data = power.ravel()
    fits = [np.linalg.lstsq(np.stack([white, t], axis=1), data, rcond=None)[0] for t in templates]
    # Waves that take power away are none.
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
    # Waves fill the ring unevenly: their scatter about it counts (Huber's sandwich), and no wave
    # is longer or shorter than the window tells.
    width = float(np.sqrt(2 * ((rows[2] * (data - design @ projected)) ** 2).sum()))
    scale = float(scales[best] * np.exp(np.clip(projected[2], -STEP, STEP)))
    width = float(np.hypot(width, scale / (2 * min(shape))))
    # Of the variance that there should be, and that may well be the larger.
    draws = min(float(np.sqrt(2 / modes)), 0.75)
    error = float(np.hypot(noise, variance * draws / (1 - draws)))
    return Ring(variance, noise, error, scale, scale * width)


def _sum_of_ring(data: F64, template: F64) -> tuple[float, float, float]:
    """Variance of the waves from all of the ring's power, its error by noise, modes in the ring."""
    # Waves fill the ring unevenly; their sum does not mind. The modes k and -k of a real map are
    # one.
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
    """Mean power (y, x) of all directions: transform of the Bessel function that products follow.

    A parabola takes next to nothing of them.
    """
    ny, nx = shape
    dy, dx = np.arange(1 - ny, ny)[:, None], np.arange(1 - nx, nx)
    products = (1 - abs(dy) / ny) * (1 - abs(dx) / nx) * j0(np.hypot(dy, dx) / scale)
    wrapped = np.zeros(shape)
    np.add.at(wrapped, (dy % ny, dx % nx), products)
    return np.asarray(np.fft.fft2(wrapped).real / wrapped.size)


def _of_long_waves(shape: tuple[int, int], scale: float) -> F64:
    """Mean power (y, x) of waves of some directions, less what a parabola takes of each."""
    free = polynomial(shape, _PARABOLA).reshape(-1, shape[0] * shape[1]).T
    y, x = np.mgrid[: shape[0], : shape[1]].reshape(2, -1).astype(float)
    angle = np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    phase = (np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle))) / scale
    waves = without(np.sqrt(2) * np.hstack([np.cos(phase), np.sin(phase)]), free)
    power = np.abs(np.fft.fft2(waves.T.reshape(-1, *shape))) ** 2
    return np.asarray(power.mean(axis=0) / y.size**2)
