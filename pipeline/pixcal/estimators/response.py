"""From collected light to signal: boundaries that move with the charge, and a bent response.

The two are fitted together to what the fringe fit leaves, because both make a second harmonic of
the phase: a response the same for all fringes, moving boundaries (brighter-fatter) one that depends
on the fringes' spacing.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.distortions import distortion_sums, fit_distortions
from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.kernels.boundaries import REACH, boundary_shifts, moved_charge

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

UNIT = 1e-7
"""Shift of boundaries (px per electron) that is fitted as one."""
FALLOFFS_PX = (0.25, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
"""In equal steps of the logarithm, nearly; what the boundaries' shift may fall by is looked for
among these."""
TOLD = 0.5
"""Error of the falloff's logarithm with which it is told from others."""


def fit_response(
    evidence: Evidence,
    level_e: float,
    powers: int,
    shifts: F64,
    known_shift: tuple[float, float] | None = None,
) -> tuple[F64, F64]:
    """Coefficients of the response and the shift of the boundaries, from all fringe sets.

    Parameters
    ----------
    evidence : Evidence
        With fringes.
    level_e : float
        Electrons for which u is one.
    powers : int
        Terms of the relative response 1 + c_1 u + c_2 u² + ...
    shifts : float64 array
        `pixcal.kernels.boundaries.boundary_shifts`, of size one.
    known_shift : (float, float), optional
        Shift by an electron (px) and its variance as they are known from the noise of neighbours.

    Returns
    -------
    sizes : (powers + 1,) float64
        c_1, c_2, ...; the shift by an electron, px.
    covariance : (powers + 1, powers + 1) float64
    """

    def distortion(fringes: FringeEvidence, signal: F32, sizes: F64) -> tuple[F32, Iterable[F32]]:
        level = evidence.level(fringes, signal)
        gained = np.stack([moved_charge(frame, UNIT * shifts) for frame in level])
        charge = level + np.float32(sizes[-1]) * gained
        flat = evidence.flat.astype(np.float32)
        response = [np.float32(size) for size in sizes[:-1]]

        def slopes() -> Iterator[F32]:
            u = charge / np.float32(level_e)
            power, steepness = charge / flat, np.float32(1) / flat
            to_the_n = np.ones_like(u)
            for n, size in enumerate(response, start=1):
                power = power * u
                yield np.asarray(power, np.float32)
                to_the_n *= u
                steepness = steepness + (size * np.float32(n + 1) / flat) * to_the_n
            yield np.asarray(steepness * gained, np.float32)

        # Horner's scheme of c_1 u + c_2 u² + ...
        bend = np.zeros_like(charge)
        for size in reversed(response):
            bend += size
            bend *= charge / np.float32(level_e)
        return (charge * (1 + bend) - level) / flat, slopes()

    prior = None
    if known_shift is not None:
        value, information = np.zeros(powers + 1), np.zeros(powers + 1)
        value[-1], information[-1] = known_shift[0] / UNIT, UNIT**2 / known_shift[1]
        prior = value, information
    sizes, covariance = fit_distortions(
        tuple(evidence.fringes.values()), distortion, powers + 1, margin=REACH, prior=prior
    )
    scale = np.ones(powers + 1)
    scale[-1] = UNIT
    return sizes * scale, covariance * np.outer(scale, scale)


@dataclass(frozen=True)
class Boundaries:
    """Moving boundaries without a bent response, as the second harmonics of all sets show them.

    Attributes
    ----------
    falloff_px, falloff_error : float
        The error infinite where one falloff does about as well as another.
    shift, shift_error : float
        By an electron, px, for this falloff.
    with_falloff : float
        By how much the shift changes with the falloff's error, px.
    against : float
        Chi-square by which a bent response beside them would fit better.
    """

    falloff_px: float
    falloff_error: float
    shift: float
    shift_error: float
    with_falloff: float
    against: float


def boundaries_alone(
    evidence: Evidence, level_e: float, powers: int, otherwise_px: float
) -> Boundaries:
    """Boundaries that explain the harmonics by themselves, with the falloff that does it best.

    Parameters
    ----------
    evidence : Evidence
        With fringes.
    level_e, powers
        Of the response that may be beside them, as of `fit_response`.
    otherwise_px : float
        Falloff where the harmonics do not tell it; one of `FALLOFFS_PX`.
    """
    every = [UNIT * boundary_shifts(falloff) for falloff in FALLOFFS_PX]

    def distortion(fringes: FringeEvidence, signal: F32, sizes: F64) -> tuple[F32, Iterable[F32]]:
        level = evidence.level(fringes, signal)
        flat = evidence.flat.astype(np.float32)

        def slopes() -> Iterator[F32]:
            u = level / np.float32(level_e)
            power = level / flat
            for _ in range(powers):
                power = power * u
                yield np.asarray(power, np.float32)
            for shifts in every:
                yield np.stack([moved_charge(frame, shifts) for frame in level]) / flat

        return np.zeros_like(signal), slopes()

    normal, right = distortion_sums(
        tuple(evidence.fringes.values()), distortion, powers + len(every), margin=REACH
    )
    found = [_alone(normal, right, powers, powers + n) for n in range(len(every))]
    return _best_falloff(found, FALLOFFS_PX.index(otherwise_px))


def _alone(normal: F64, right: F64, powers: int, at: int) -> tuple[float, float, float, float]:
    """Shift, its variance, the chi-square it explains, and what a bent response would beside it."""
    size, variance = right[at] / normal[at, at], 1 / normal[at, at]
    both = [*range(powers), at]
    scale = 1 / np.sqrt(np.diag(normal)[both])
    own = normal[np.ix_(both, both)] * np.outer(scale, scale)
    scaled = right[both] * scale
    gain = size * right[at]
    beside = float(scaled @ np.linalg.pinv(own, rcond=1e-9, hermitian=True) @ scaled) - gain
    return UNIT * float(size), UNIT**2 * float(variance), float(gain), beside


def _best_falloff(found: Sequence[tuple[float, float, float, float]], otherwise: int) -> Boundaries:
    """By a parabola through the best of all and those beside it."""
    sizes, variances, gains, beside = np.array(found).T
    best = int(np.clip(np.argmax(gains), 1, len(gains) - 2))
    at = np.log(FALLOFFS_PX[best - 1 : best + 2])
    bend, slope, _ = np.polyfit(at - at[1], gains[best - 1 : best + 2], 2)
    error = 1 / np.sqrt(-bend) if bend < 0 else np.inf
    if error > TOLD:
        size, variance, _, against = found[otherwise]
        return Boundaries(FALLOFFS_PX[otherwise], np.inf, size, variance**0.5, 0.0, against)
    top = float(at[1] - slope / (2 * bend))
    # Not beyond what was tried; how far that is from the best is not known then.
    there = float(np.clip(top, *np.log([FALLOFFS_PX[0], FALLOFFS_PX[-1]])))
    error = float(np.hypot(error, top - there))
    near = slice(best - 1, best + 2)
    bends = [np.polyfit(at - at[1], values[near], 2) for values in (sizes, variances, beside)]
    own = [float(np.polyval(coefficients, there - at[1])) for coefficients in bends]
    rise = float(np.polyval(np.polyder(bends[0]), there - at[1]))
    falloff = float(np.exp(there))
    return Boundaries(falloff, falloff * error, own[0], own[1] ** 0.5, rise * error, own[2])
