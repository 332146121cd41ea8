"""Telegraph noise: the signs of it, the population of pixels and the time, found together."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.detector.telegraph.classes import Stays
from pixcal.estimators.detector.telegraph.dwell import LitSeries, find_stays
from pixcal.estimators.detector.telegraph.levels import OwnLevels, find_upper, own_levels
from pixcal.estimators.detector.telegraph.moments import (
    NOISY,
    Moments,
    Series,
    Signs,
    moments_of,
    signs,
    thinned,
)
from pixcal.estimators.detector.telegraph.population import (
    Population,
    find_population,
    find_switching,
    off_later,
)
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import Indices

ROUNDS = 3  # most, in which population and time are found, each with the other known
# decades over which stays differ where they do, and the chi-square by which frames further apart
# must say so (equal stays: at most 1.9 in eight draws of 3-sigma jumps in 3 % of 16,000 pixels)
SPREAD, DIFFER = 1.5, 2.0
MOST_OWN = 3000  # pixels that are measured one by one: a millisecond each
DARKER = 1.5  # variance of fringes over that of frames without light, at least
SETTLED = 0.5  # change of the time, over its error, after which no other round is needed


@dataclass(frozen=True)
class Telegraph:
    """What was found."""

    # share, amplitude, shape, switching_s: of the pixels; mean, e-; of the amplitudes' gamma
    # distribution; mean stay in a level, s (0: no longer than a frame)
    share: float
    amplitude: float
    shape: float
    switching_s: float
    switching_decades: float  # range of the pixels' times, even in the logarithm
    upper: float  # share of the time in the upper level
    share_error: float
    amplitude_error: float
    shape_error: float
    switching_error: float
    signs: Signs  # that noisy pixels jump
    # own, faintest: levels of single pixels, where the fringes tell; of jumps of so many electrons
    own: OwnLevels | None = None
    faintest: float = 0.0


def find_telegraph(
    series: Sequence[Series],
    lit: Callable[[Indices], Sequence[LitSeries]] = lambda _: (),
    noisy: Indices | None = None,
) -> Telegraph | None:
    """Telegraph noise from one or several series of the same pixels; None without samples.

    Parameters
    ----------
    series
    lit : gives the frames of fringes of some pixels, which tell how long they stay
    noisy : pixels that are noisy in these
    """
    parts = [m for s in series if (m := moments_of(s)) is not None]
    if not parts:
        return None
    told = signs(parts)
    longest, upper, known = max(parts, key=lambda m: m.frames), 0.5, None
    single: OwnLevels | None = None
    faintest = 0.0
    if told.significance > SIGNIFICANT and told.noisy:
        own = max(series, key=lambda s: len(s.noise))
        upper = _upper(lit, own, longest, told)
        if upper != 0.5:
            # What looks like a hit is the rarer level.
            parts = [m for s in series if (m := moments_of(s, hits=True)) is not None]
            longest = max(parts, key=lambda m: m.frames)
            upper = _upper(lit, own, longest, told)
        known = find_stays(lit(_chosen(longest)), longest, upper)
        clear = NOISY * float(np.sqrt(2 / longest.dof)) / (upper * (1 - upper))
        faintest = longest.sigma * clear**0.5
        single = _single(lit, own, longest, noisy, faintest)
    parts = thinned(parts)
    if known is not None:
        found = _Found(find_population(parts, known[0]), *known, 0.0)
    else:
        found = _likeliest(parts, upper)
    p = found.population
    return Telegraph(
        p.share, p.amplitude, p.shape, found.stays.mean_s, found.stays.decades, found.stays.upper,
        p.share_error, p.amplitude_error, p.shape_error, found.error, told, single, faintest,
    )  # fmt: skip


def significance(series: Sequence[Series]) -> float | None:
    """Of the signs that noisy pixels jump; None without samples."""
    parts = [m for s in series if (m := moments_of(s)) is not None]
    return signs(parts).significance if parts else None


def _chosen(m: Moments) -> Indices:
    return m.pixel[m.excess > 0]


def _upper(
    lit: Callable[[Indices], Sequence[LitSeries]], own: Series, seen: Moments, told: Signs
) -> float:
    """Share of the time in the upper level: by the fringes, else by the frames without light."""
    pixels = _chosen(seen)
    upper = find_upper(lit(pixels), seen.sigma)
    if upper != 0.5 or abs(told.one_sided) < SIGNIFICANT:
        return upper
    # Pixels were chosen for what they do in these, so a rare level is taken for a less rare one.
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
    faintest: float,
) -> OwnLevels | None:
    """Levels of each pixel that jumps so far; None where the fringes do not tell."""
    pixels = _chosen(seen) if noisy is None else np.union1d(_chosen(seen), noisy)
    bright = lit(pixels) if len(pixels) <= MOST_OWN else ()
    if not bright:
        return None
    # Without dark frames the series is one of the fringes, which are there already.
    darker = own.sigma**-2 > DARKER * float(np.mean(bright[0].weight))
    dark = [_in_the_dark(own, pixels)] if darker else []
    found = own_levels([*dark, *bright], seen.sigma)
    far = found.amplitude >= faintest
    return OwnLevels(found.pixel[far], found.amplitude[far], found.upper[far])


@dataclass(frozen=True)
class _Found:
    """A population, and how long its pixels stay."""

    population: Population
    stays: Stays
    error: float  # of the mean stay, s
    later: float  # what frames further apart have in common beyond that, in errors


def _likeliest(parts: Sequence[Moments], upper: float) -> _Found:
    """Population and stays, of equal stays or of such that differ, by the same frames."""
    even = _of_stays(parts, 0.0, upper)
    if even.stays.mean_s > 0:
        # Times of traps differ widely, where frames further apart say so.
        spread = _of_stays(parts, SPREAD, upper)
        if even.later**2 - spread.later**2 > DIFFER:
            return spread
    return even


def _of_stays(parts: Sequence[Moments], decades: float, upper: float) -> _Found:
    """The likeliest population with stays that differ by so many decades."""
    # A pixel's variance is high by telegraph noise or by chance: how much is which, the population
    # tells; how much of it a few frames hold, the time.
    found = find_population(parts, Stays(0.0, upper=upper))
    switching, error = find_switching(parts, found, decades, upper)
    for _ in range(ROUNDS):
        before = switching
        if before == 0:
            break
        found = find_population(parts, Stays(switching, decades, upper))
        switching, error = find_switching(parts, found, decades, upper)
        if abs(switching - before) < SETTLED * error:
            break
    stays = Stays(switching, decades, upper)
    return _Found(found, stays, error, off_later(parts, found, stays))
