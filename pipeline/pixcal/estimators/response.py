"""From collected light to signal: boundaries that move with the charge, and a bent response.

The two are fitted together to what the fringe fit leaves, because both make a second harmonic of
the phase: a response the same for all fringes, moving boundaries (brighter-fatter) one that depends
on the fringes' spacing.
"""

from collections.abc import Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.distortions import fit_distortions
from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.kernels.boundaries import REACH, moved_charge

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

UNIT = 1e-7
"""Shift of boundaries (px per electron) that is fitted as one."""


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
