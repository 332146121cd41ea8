"""Electron multiplication before the output, from the third moment of the noise of flats.

The cumulants of n electrons that arrive by chance, each read as a random signal x, are ``n <x>``,
``n <x²>`` and ``n <x³>``. So ``<x³> <x> / <x²>²``, which needs no gain, is 1 if all electrons count
equally, and 3/2 after a multiplying register, where x is nearly exponential (Robbins & Hadwen 2003,
IEEE Trans. Electron Devices 50, 1227). Its noise, over that of the light, is ``F² = 2 - 1/G`` for a
multiplication G. Photon transfer alone cannot distinguish F² from a different gain.
"""

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np

from pixcal.model.arrays import F32, Mask

MIN_FRAMES = 3  # of a level; two have no third moment
EXCESS, EXCESS_ERROR = 2.0, 0.05  # F² of a large multiplication, and error if G is unknown

_SURE = 5.0  # errors by which the ratio must exceed 1
_RATIOS = (1.3, 1.7)  # of a register: a multiplication of 1.5 has 1.39
# samples that count: within so many standard deviations, and signals of single electrons
_CLIP, _ELECTRONS = 5.0, 15.0
_MIN_PIXELS = 1000


class Skew(NamedTuple):
    """Third cumulant of a sample at a level."""

    level: float  # ADU above the bias
    cumulant: float  # ADU³
    error: float


def skew(
    frames: F32, level: float, variance: float, slope: float, good: Mask, quantum: float = 0.0
) -> Skew | None:
    """Third cumulant of the noise of frames (t, y, x) of one scene, ADU; None with too few samples.

    level : ADU above the bias
    variance, slope : variance without light (ADU²), and how it rises with the level (ADU)
    good : (y, x) pixels to use
    quantum : step of the samples, ADU; rounding has a third cumulant where the noise is below it
    """
    count = len(frames)
    if count < MIN_FRAMES or variance + slope * level < quantum**2 / 2:
        return None
    used = frames[:, good]
    pattern = used.mean(axis=0)
    rest = used - pattern
    # A lamp that flickers changes bright pixels the more.
    pattern -= pattern.mean()
    rest -= np.outer(rest @ pattern, pattern / max(float(pattern @ pattern), 1e-30))
    limit = _CLIP * np.sqrt(variance + slope * max(level, 0.0)) + _ELECTRONS * slope
    away = np.abs(rest - np.median(rest, axis=1, keepdims=True))
    kept = (away < limit).all(axis=0)
    if kept.sum() < _MIN_PIXELS:
        return None
    rest = rest[:, kept]
    rest -= rest.mean(axis=1, keepdims=True)
    unbiased = count / ((count - 1) * (count - 2))
    # Three factors: a third power takes 80 times as long.
    cubes = unbiased * np.einsum("tp,tp,tp->p", rest, rest, rest, dtype=float)
    # Noise that a row or a column shares is one sample of it.
    mean = float(cubes.mean())
    lines = (np.arange(len(cubes)), *np.argwhere(good)[kept].T)
    squares = max(float((np.bincount(of, cubes - mean) ** 2).sum()) for of in lines)
    return Skew(level, mean, squares**0.5 / len(cubes))


def is_multiplied(points: Iterable[Skew], slope: float) -> bool:
    """Whether electrons were multiplied, from levels with and without light.

    ``slope``: rise of the variance with the level, ADU.
    """
    level, cumulant, error = np.array(list(points)).reshape(-1, 3).T
    if len(level) < 2:
        return False
    weight = error**-2
    away = level - np.average(level, weights=weight)
    information = float(weight @ away**2)
    if not information > 0:
        return False
    ratio = float((weight * away) @ cumulant) / information / slope**2
    return _RATIOS[0] < ratio < _RATIOS[1] and ratio - 1 > _SURE * information**-0.5 / slope**2
