"""Telegraph noise: the signs of it, the population of pixels and the time, found together."""

from collections.abc import Sequence
from dataclasses import dataclass

from pixcal.estimators.detector.telegraph.moments import Series, moments_of, signs
from pixcal.estimators.detector.telegraph.population import find_population, find_switching
from pixcal.kernels.significance import sigmas_of_best

ROUNDS = 3  # most, in which population and time are found, each with the other known
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
    share_error: float
    amplitude_error: float
    shape_error: float
    switching_error: float
    significance: float  # that noisy pixels jump
    flat_top: float  # flat_top, staying: its two signs, in sigmas
    staying: float
    noisy: int  # pixels that stand out


def find_telegraph(series: Sequence[Series]) -> Telegraph | None:
    """Telegraph noise from one or several series of the same pixels; None without samples."""
    parts = [m for s in series if (m := moments_of(s)) is not None]
    if not parts:
        return None
    flat_top, staying, noisy = signs(parts)
    # A pixel's variance is high by telegraph noise or by chance: how much is which, the population
    # tells; how much of it a few frames hold, the time.
    found = find_population(parts, 0.0)
    switching, switching_error = find_switching(parts, found)
    for _ in range(ROUNDS):
        before = switching
        if before == 0:
            break
        found = find_population(parts, switching)
        switching, switching_error = find_switching(parts, found)
        if abs(switching - before) < SETTLED * switching_error:
            break
    return Telegraph(
        found.share, found.amplitude, found.shape, switching,
        found.share_error, found.amplitude_error, found.shape_error, switching_error,
        sigmas_of_best(flat_top, staying), flat_top, staying, noisy,
    )  # fmt: skip
