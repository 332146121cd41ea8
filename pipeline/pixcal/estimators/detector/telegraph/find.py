"""Telegraph noise: its signs, the population of pixels and their dwell time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from scipy.special import logit, logsumexp, softmax

from pixcal.estimators.detector.telegraph import moments, population
from pixcal.estimators.detector.telegraph.classes import Stays
from pixcal.estimators.detector.telegraph.dwell import FEWEST_PIXELS, LitSeries, find_stays
from pixcal.estimators.detector.telegraph.moments import NOISY, Moments, Series, Signs
from pixcal.estimators.detector.telegraph.population import Population
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F32, F64, Indices

Reals = TypeVar("Reals", F32, F64)

ROUNDS = 3  # most iterations between population and dwell time
# range (decades) of unequal dwell times, and the chi-square by which frames further apart must
# favour it (equal times: at most 1.9 in eight draws of 3-sigma jumps in 3 % of 16,000 pixels)
SPREAD, DIFFER = 1.5, 2.0
MOST_OWN = 3000  # most pixels measured one by one: a millisecond each
DARKER = 1.5  # least variance of fringes over that of frames without light
SETTLED = 0.5  # change of the time, over its error, that ends the iteration
_RARER = np.array([0.02, 0.035, 0.06, 0.1, 0.17, 0.28])
SHARES = np.concatenate([_RARER, [0.5], 1 - _RARER[::-1]])  # of the time in the upper level
AMPLITUDES = np.geomspace(1.0, 60.0, 14)  # over the noise of dark frames
# log-likelihood by which unequal levels must be likelier, in all and per pixel: correlated frames
# raise it more than independent ones
CLEAR, CLEAR_A_PIXEL = 10.0, 0.1
MOST_PIXELS = 400
_TURNS = 60  # of the maximisation
# for single pixels: shares and amplitudes as above, and by how much the log-likelihood of two
# levels must exceed that of one
OWN_SHARES = np.array([0.03, 0.08, 0.2, 0.35, 0.5, 0.65, 0.8, 0.92, 0.97])
OWN_AMPLITUDES = np.geomspace(1.0, 60.0, 28)
TWO_LEVELS = 8.0


@dataclass(frozen=True)
class OwnLevels:
    """The two levels of single pixels."""

    pixel: Indices  # (n,)
    amplitude: F64  # (n,) difference of the two, e-
    upper: F64  # (n,) share of the time in the upper one


@dataclass(frozen=True)
class Telegraph(Population):
    """Telegraph noise found: the population, how its pixels jump, and single pixels."""

    switching_s: float  # mean dwell time, s; 0: no longer than a frame
    switching_decades: float  # range of the pixels' times, uniform in the logarithm
    upper: float  # share of the time in the upper level
    switching_error: float
    signs: Signs  # that noisy pixels jump
    # own, smallest_jump: levels of single pixels, from fringes; smallest jump measured, e-
    own: OwnLevels | None = None
    smallest_jump: float = 0.0


def find_telegraph(
    series: Sequence[Series],
    lit: Callable[[Indices], Sequence[LitSeries]] = lambda _: (),
    noisy: Indices | None = None,
) -> Telegraph | None:
    """Telegraph noise from one or several series of the same pixels; None without samples.

    ``lit``: gives the fringe frames of given pixels, which constrain dwell times.
    """
    parts = [m for s in series if (m := moments.moments_of(s)) is not None]
    if not parts:
        return None
    jump_signs = moments.signs(parts)
    longest, upper, known = max(parts, key=lambda m: m.frames), 0.5, None
    single: OwnLevels | None = None
    smallest_jump = 0.0
    if jump_signs.significance > SIGNIFICANT and jump_signs.noisy:
        own = max(series, key=lambda s: len(s.noise))
        upper = _upper(lit, own, longest, jump_signs)
        if upper != 0.5:
            # Apparent hits are the rarer level.
            parts = [m for s in series if (m := moments.moments_of(s, hits=True)) is not None]
            longest = max(parts, key=lambda m: m.frames)
            upper = _upper(lit, own, longest, jump_signs)
        known = find_stays(lit(_chosen(longest)), longest, upper)
        clear = NOISY * float(np.sqrt(2 / longest.dof)) / (upper * (1 - upper))
        smallest_jump = longest.sigma * clear**0.5
        single = _single(lit, own, longest, noisy, smallest_jump)
    parts = moments.thinned(parts)
    if known is not None:
        found = _Found(population.find_population(parts, known[0]), *known, 0.0)
    else:
        found = _likeliest(parts, upper)
    stays = found.stays
    return Telegraph(
        **vars(found.population),
        switching_s=stays.mean_s,
        switching_decades=stays.decades,
        upper=stays.upper,
        switching_error=found.error,
        signs=jump_signs,
        own=single,
        smallest_jump=smallest_jump,
    )


def significance(series: Sequence[Series]) -> float | None:
    """Of the signs that noisy pixels jump; None without samples."""
    parts = [m for s in series if (m := moments.moments_of(s)) is not None]
    return moments.signs(parts).significance if parts else None


def _chosen(m: Moments) -> Indices:
    return m.pixel[m.excess > 0]


def _upper(
    lit: Callable[[Indices], Sequence[LitSeries]], own: Series, seen: Moments, jump_signs: Signs
) -> float:
    """Share of the time in the upper level: from fringes, else from frames without light."""
    pixels = _chosen(seen)
    upper = find_upper(lit(pixels), seen.sigma)
    if upper != 0.5 or abs(jump_signs.one_sided) < SIGNIFICANT:
        return upper
    # Pixels were selected in these frames, which biases the share of a rare level high.
    return find_upper([_in_the_dark(own, pixels)], seen.sigma)


def _in_the_dark(own: Series, pixels: Indices) -> LitSeries:
    some = np.isin(own.pixel, pixels)
    noise = np.nan_to_num(own.noise[:, some]) * own.sigma
    noise -= noise.mean(axis=0)
    weight = np.full(noise.shape, own.sigma**-2)
    mean = np.ones((len(noise), 1))
    return LitSeries(noise, weight, own.frame, own.period_s, own.pixel[some], mean)


def _single(
    lit: Callable[[Indices], Sequence[LitSeries]],
    own: Series,
    seen: Moments,
    noisy: Indices | None,
    smallest_jump: float,
) -> OwnLevels | None:
    """Levels of each pixel that jumps by ``smallest_jump`` or more; None without fringes."""
    pixels = _chosen(seen) if noisy is None else np.union1d(_chosen(seen), noisy)
    bright = lit(pixels) if len(pixels) <= MOST_OWN else ()
    if not bright:
        return None
    # Without dark frames the series is one of fringes, already in ``bright``.
    darker = own.sigma**-2 > DARKER * float(np.mean(bright[0].weight))
    dark = [_in_the_dark(own, pixels)] if darker else []
    found = own_levels([*dark, *bright], seen.sigma)
    far = found.amplitude >= smallest_jump
    return OwnLevels(found.pixel[far], found.amplitude[far], found.upper[far])


@dataclass(frozen=True)
class _Found:
    """A population, and its dwell times."""

    population: Population
    stays: Stays
    error: float  # of the mean stay, s
    later: float  # excess covariance of frames further apart, in errors


def _likeliest(parts: Sequence[Moments], upper: float) -> _Found:
    """Population with equal or with unequal dwell times, from the same frames."""
    even = _of_stays(parts, 0.0, upper)
    if even.stays.mean_s > 0:
        # Unequal dwell times only where frames further apart favour them.
        spread = _of_stays(parts, SPREAD, upper)
        favoured = even.later**2 - spread.later**2
        if favoured > DIFFER:
            return spread
        if favoured > -DIFFER:
            # Few frames do not tell, and pixels with long times jump in none of them.
            own, other = even.population, spread.population
            share_error = float(np.hypot(own.share_error, other.share - own.share))
            return replace(even, population=replace(own, share_error=share_error))
    return even


def _of_stays(parts: Sequence[Moments], decades: float, upper: float) -> _Found:
    """The likeliest population with dwell times over a range of ``decades``."""
    # The population separates telegraph noise and chance in a pixel's variance; the dwell time
    # gives the part of it that few frames show.
    found = population.find_population(parts, Stays(0.0, upper=upper))
    switching, error = population.find_switching(parts, found, decades, upper)
    for _ in range(ROUNDS):
        before = switching
        if before == 0:
            break
        found = population.find_population(parts, Stays(switching, decades, upper))
        switching, error = population.find_switching(parts, found, decades, upper)
        if abs(switching - before) < SETTLED * error:
            break
    stays = Stays(switching, decades, upper)
    return _Found(found, stays, error, population.off_later(parts, found, stays))


# Levels, and the share of the time in the upper one


def find_upper(lit: Sequence[LitSeries], noise: float) -> float:
    """Share of the time in the upper level that all pixels have in common; 0.5 unless it is clear.

    ``lit``: fringe frames, one series per set. ``noise``: of dark frames, e-.
    """
    used = [s for s in lit if s.charge.shape[1] >= FEWEST_PIXELS]
    if not used:
        return 0.5
    jumps = np.hstack([_by_share(s, noise * AMPLITUDES) for s in used])
    even = len(_RARER)
    plain = _mixed(jumps[[even]])[0]
    found = [
        _mixed(jumps[[even, n]]) if n != even else (plain, 0.0, 1.0) for n in range(len(SHARES))
    ]
    likely, parts, others = np.array(found).T
    best = int(np.argmax(likely))
    gain = likely[best] - plain
    if gain < CLEAR + CLEAR_A_PIXEL * parts[best] * jumps.shape[1] or parts[best] < others[best]:
        return 0.5
    # The top of a parabola through it and its neighbours.
    near = np.clip(np.arange(best - 1, best + 2), 0, len(SHARES) - 1)
    if len(set(near.tolist())) < 3:
        return float(SHARES[best])
    curve = np.polyfit(logit(SHARES[near]), likely[near] - likely[best], 2)
    return float(1 / (1 + np.exp(curve[1] / (2 * curve[0]))))


def own_levels(series: Sequence[LitSeries], noise: float) -> OwnLevels:
    """Levels of the pixels that have two, from all frames, lit or not.

    The share of time is the mean of its posterior: where no series shows it, one half. ``noise``:
    of frames without light, e-.
    """
    pixels = np.unique(np.concatenate([s.pixel for s in series]))
    likely = np.zeros((len(OWN_AMPLITUDES), len(pixels)))
    of_share = np.zeros((len(OWN_SHARES), *likely.shape))
    for one in series:
        at = np.searchsorted(pixels, one.pixel)
        charge, weight = one.charge.astype(np.float32), one.weight.astype(np.float32)
        each = _two_levels(charge, weight, OWN_SHARES, noise * OWN_AMPLITUDES)
        # Or it stayed in one level all along.
        likely[:, at] += np.logaddexp(logsumexp(each, axis=0), 0) - np.log(len(OWN_SHARES) + 1)
        of_share[:, :, at] += np.logaddexp(each, 0)
    best = np.clip(likely.argmax(axis=0), 1, len(OWN_AMPLITUDES) - 2)
    number = np.arange(len(pixels))
    low, middle, high = likely[best[None] + np.array([-1, 0, 1])[:, None], number]
    # The top of a parabola through the best and its neighbours.
    off = (high - low) / np.maximum(2 * (2 * middle - low - high), 1e-9)
    step = OWN_AMPLITUDES[1] / OWN_AMPLITUDES[0]
    amplitude = noise * OWN_AMPLITUDES[best] * step ** np.clip(off, -1, 1)
    upper = OWN_SHARES @ softmax(of_share[:, best, number], axis=0)
    two = likely.max(axis=0) > TWO_LEVELS
    return OwnLevels(pixels[two], amplitude[two], upper[two])


def _two_levels(charge: Reals, weight: Reals, shares: F64, amplitudes: F64) -> Reals:
    """Logarithms (share, amplitude, n) of the likelihoods of two levels relative to one."""
    # ``charge, weight``: as in `LitSeries`, of the type to compute in.
    kind = charge.dtype.type
    found = np.empty((len(shares), len(amplitudes), charge.shape[1]), kind)
    for of_share, upper in zip(found, shares.astype(kind), strict=True):
        for own, a in zip(of_share, amplitudes.astype(kind), strict=True):
            # Of the lower level, and by how much the upper one is likelier.
            lower = -(upper * a * charge + (upper * a) ** 2 / 2) * weight
            more = (a * charge + (upper - kind(0.5)) * a**2) * weight
            own[:] = (lower + np.logaddexp(np.log1p(-upper), np.log(upper) + more)).sum(axis=0)
    return found


def _by_share(series: LitSeries, amplitudes: F64) -> F64:
    """Logarithms (share, n) of the likelihoods of some pixels with any of the amplitudes."""
    each = -(-series.charge.shape[1] // MOST_PIXELS)
    some = _two_levels(series.charge[:, ::each], series.weight[:, ::each], SHARES, amplitudes)
    return np.asarray(logsumexp(some, axis=1) - np.log(len(amplitudes)))


def _mixed(jumps: F64) -> tuple[float, float, float]:
    """Likelihood of pixels, quiet or of kinds (kind, n); shares of the last kind, and before it."""
    every = np.vstack([np.zeros(jumps.shape[1]), jumps])
    log_share = np.full(len(every), -np.log(len(every)))
    for _ in range(_TURNS):
        joint = every + log_share[:, None]
        own = joint - logsumexp(joint, axis=0)
        log_share = logsumexp(own, axis=1) - np.log(own.shape[1])
    total = logsumexp(every + log_share[:, None], axis=0)
    last, before = np.exp(log_share[[-1, -2]])
    return float(total.sum()), float(last), float(before)
