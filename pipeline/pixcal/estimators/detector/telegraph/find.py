"""Telegraph noise: its signs, the population of pixels and their dwell time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, log_softmax, logit, logsumexp, softmax

from pixcal.estimators.detector.telegraph import moments
from pixcal.estimators.detector.telegraph.dwell import Dwell, PixelSeries, find_stays
from pixcal.estimators.detector.telegraph.moments import NOISY, Moments, Series, Signs
from pixcal.estimators.detector.telegraph.population import Population, Stays, find_population
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F32, F64, Indices

MOST_OWN = 3000  # most pixels measured one by one: a millisecond each
DARKER = 1.5  # least variance of fringes over that of frames without light
# for single pixels: shares of the time in the upper level, amplitudes over the noise of dark
# frames, and by how much the log-likelihood of two levels must exceed that of one
_RARER = np.array([0.02, 0.035, 0.06, 0.1, 0.18, 0.32])
SHARES = np.concatenate([_RARER, [0.5], 1 - _RARER[::-1]])
AMPLITUDES = np.geomspace(1.0, 60.0, 28)
TWO_LEVELS = 8.0
_OVERFLOW = np.float32(80.0)  # logarithm below which float32 numbers do not overflow
# log-likelihood by which a common share must be likelier than one half: in all, and per pixel
CLEAR, CLEAR_A_PIXEL = 10.0, 0.1
# least excess of pixels that are rarely, or mostly, in the upper level, over all measured ones
MOST = 0.5
Lit = Callable[[Indices], Sequence[PixelSeries]]


@dataclass(frozen=True)
class OwnLevels:
    """The two levels of single pixels."""

    pixel: Indices  # (n,)
    amplitude: F64  # (n,) difference of the two, e-
    upper: F64  # (n,) share of the time in the upper one

    # share of the time in the upper level that most pixels have in common; 0.5 unless clear
    common_upper: float


@dataclass(frozen=True)
class Telegraph(Population):
    """Telegraph noise found: the population, how its pixels jump, and single pixels."""

    stays: Stays
    switching_error: float  # of the mean dwell time, s
    signs: Signs  # that noisy pixels jump
    # own, smallest_jump: levels of single pixels, from fringes; smallest jump measured, e-
    own: OwnLevels | None = None
    smallest_jump: float = 0.0


def find_telegraph(
    series: Sequence[Series], lit: Lit = lambda _: (), noisy: Sequence[int] | Indices = ()
) -> Telegraph | None:
    """Telegraph noise from one or several series of the same pixels; None without samples.

    ``lit``: gives the fringe frames of given pixels. ``noisy``: other pixels to measure.
    """
    parts = moments.all_moments(series)
    if not parts:
        return None
    signs, own, smallest_jump = moments.signs(parts), None, 0.0
    seen = max(parts, key=lambda m: m.frames)
    none = Stays(0.0)
    dwell = Dwell(none, seen.period_s, none)
    if signs.significance > SIGNIFICANT and signs.noisy:
        upper, own = _levels(series, seen, lit, noisy, signs)
        if upper != 0.5:
            # Apparent hits are the rarer level.
            parts = moments.all_moments(series, hits=True)
            seen = max(parts, key=lambda m: m.frames)
            upper, own = _levels(series, seen, lit, noisy, signs)
        clear = NOISY * float(np.sqrt(2 / seen.dof)) / (upper * (1 - upper))
        smallest_jump = seen.sigma * clear**0.5
        pixels = seen.pixel[seen.excess > 0]
        dark, bright = _frames(series, seen, lit, pixels)
        none = replace(none, upper=upper)
        found_dwell = find_stays([*dark, *bright], seen, upper)
        dwell = found_dwell or dwell._replace(stays=none, other=none)
    parts = moments.thinned(parts)
    jumps = find_population(parts, dwell.stays)
    if dwell.other != dwell.stays:
        # Pixels with long times jump in none of few frames.
        change = find_population(parts, dwell.other).share - jumps.share
        jumps = replace(jumps, share_error=float(np.hypot(jumps.share_error, change)))
    if own is not None:
        far = own.amplitude >= smallest_jump
        own = replace(own, pixel=own.pixel[far], amplitude=own.amplitude[far], upper=own.upper[far])
    return Telegraph(
        **vars(jumps),
        stays=dwell.stays,
        switching_error=dwell.error,
        signs=signs,
        own=own,
        smallest_jump=smallest_jump,
    )


def significance(series: Sequence[Series]) -> float | None:
    """Of the signs that noisy pixels jump; None without samples."""
    parts = moments.all_moments(series)
    return moments.signs(parts).significance if parts else None


def _levels(
    series: Sequence[Series], seen: Moments, lit: Lit, noisy: Sequence[int] | Indices, signs: Signs
) -> tuple[float, OwnLevels | None]:
    """Share of the time in the upper level, and levels of single pixels; None without fringes."""
    pixels = np.union1d(seen.pixel[seen.excess > 0], np.asarray(noisy, int))
    each = -(-len(pixels) // MOST_OWN)
    dark, bright = _frames(series, seen, lit, pixels[::each])
    if not bright and abs(signs.one_sided) < SIGNIFICANT:
        return 0.5, None
    levels = own_levels([*dark, *bright], seen.sigma)
    return levels.common_upper, levels if bright and each == 1 else None


def _frames(
    series: Sequence[Series], seen: Moments, lit: Lit, pixels: Indices
) -> tuple[list[PixelSeries], Sequence[PixelSeries]]:
    """Frames without light, and of fringes."""
    bright = lit(pixels)
    # Without dark frames the series are of fringes, already in ``bright``.
    if bright and series[0].sigma ** -2 < DARKER * float(np.mean(bright[0].weight)):
        return [], bright
    dark = []
    for one in series:
        some = np.isin(one.pixel, pixels)
        noise = np.nan_to_num(one.noise[:, some]) * one.sigma
        noise -= noise.mean(axis=0)
        weight, mean = np.full(noise.shape, one.sigma**-2), np.ones((len(noise), 1))
        which = one.frame, one.period_s, one.pixel[some]
        dark.append(PixelSeries(noise, weight, *which, mean, len(one.frame) == seen.frames))
    return dark, bright


def own_levels(series: Sequence[PixelSeries], noise: float) -> OwnLevels:
    """Levels of the pixels that have two, from all frames, lit or not.

    The share of time is the mean of its posterior: where no series shows it, one half. ``noise``:
    of frames without light, e-.
    """
    pixels = np.unique(np.concatenate([s.pixel for s in series]))
    likely = np.zeros((len(AMPLITUDES), len(pixels)))
    of_share = np.zeros((2, len(SHARES), *likely.shape), np.float32)
    for one in series:
        at = np.searchsorted(pixels, one.pixel)
        each = _two_levels(one.charge.astype(np.float32), one.weight.astype(np.float32), noise)
        # Or it stayed in one level all along.
        likely[:, at] += np.logaddexp(logsumexp(each, axis=0), 0) - np.log(len(SHARES) + 1)
        of_share[int(one.chosen)][:, :, at] += np.logaddexp(each, 0)
    # Selection of pixels biases the share of a rare level high: other frames give it, at the
    # amplitudes that all frames give.
    elsewhere = of_share[int(all(s.chosen for s in series))] + log_softmax(likely, axis=0)
    best = np.clip(likely.argmax(axis=0), 1, len(AMPLITUDES) - 2)
    number = np.arange(len(pixels))
    low, middle, high = likely[best[None] + np.array([-1, 0, 1])[:, None], number]
    # The top of a parabola through the best and its neighbours.
    off = (high - low) / np.maximum(2 * (2 * middle - low - high), 1e-9)
    step = AMPLITUDES[1] / AMPLITUDES[0]
    amplitude = noise * AMPLITUDES[best] * step ** np.clip(off, -1, 1)
    upper = SHARES @ softmax(of_share.sum(axis=0)[:, best, number], axis=0)
    two = likely.max(axis=0) > TWO_LEVELS
    common = _common(logsumexp(elsewhere, axis=1))
    return OwnLevels(pixels[two], amplitude[two], upper[two], common)


def _common(likely: F64) -> float:
    """Share that most pixels have in common, from their log-likelihoods (share, n); or 0.5."""
    # Half of the pixels may have any share.
    chance = softmax(likely, axis=0)
    total = np.log1p(len(SHARES) * chance).sum(axis=1)
    rarely = np.sign(0.5 - SHARES) @ chance
    if abs(rarely.sum()) < MOST * np.abs(rarely).sum():
        return 0.5
    best, even = int(np.argmax(total)), len(SHARES) // 2
    if total[best] - total[even] < CLEAR + CLEAR_A_PIXEL * likely.shape[1]:
        return 0.5
    # The top of a parabola through it and its neighbours.
    near = np.clip(best, 1, len(SHARES) - 2) + np.arange(-1, 2)
    curve = np.polyfit(logit(SHARES[near]), likely[near].sum(axis=1), 2)
    return float(np.clip(expit(-curve[1] / (2 * curve[0])), *SHARES[near[[0, 2]]]))


def _two_levels(charge: F32, weight: F32, noise: float) -> F32:
    """Logarithms (share, amplitude, n) of the likelihoods of two levels relative to one."""
    ratios = np.empty((len(SHARES), len(AMPLITUDES), charge.shape[1]), np.float32)
    for of_share, upper in zip(ratios, SHARES.astype(np.float32), strict=True):
        for ratio, a in zip(of_share, (noise * AMPLITUDES).astype(np.float32), strict=True):
            # Of the lower level, and by how much the upper one is likelier.
            lower = -(upper * a * charge + (upper * a) ** 2 / 2) * weight
            more = (a * charge + (upper - np.float32(0.5)) * a**2) * weight
            low = np.minimum(more, _OVERFLOW)
            mixed = np.log(1 - upper + upper * np.exp(low))
            ratio[:] = (lower + mixed + (more - low)).sum(axis=0)
    return ratios
