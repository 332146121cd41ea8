"""How the charge that stays behind depends on the level, without a law.

A share that is the same at all levels only changes amplitude and phase of the frames, which the fit
takes up. One that depends on the level leaves harmonics of the last frame's phase in the residuals.
They are fitted with the charge of the last frames in bands of the level, beside the same bands of
the frame itself: a bent response has those.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.distortions import distortion_sums
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.normal_matrix import inverse_normal

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

BANDS = (0.0, 0.125, 0.25, 0.5)  # where bands of the level begin, over the full scale

# of the mean share, which the contrast tells far better than its dependence on the level
EXACT = 1e-3


def in_bands(level: F32, level_e: float) -> list[F32]:
    """Electrons of a signal in each band; their sum is the signal, where it is positive."""
    begins = [np.float32(b * level_e) for b in BANDS]
    ends = [*begins[1:], np.float32(np.inf)]
    return [np.clip(level, b, e) - b for b, e in zip(begins, ends, strict=True)]


def shares_by_level(
    evidence: Evidence, share: float, releases: F64, level_e: float
) -> tuple[F64, F64, float]:
    """Share of the charge in each band that stays behind.

    Parameters
    ----------
    evidence : Evidence
        With fringes.
    share : float
        On the mean, as the fringe amplitude has it.
    releases : (k,) float64
        Part of what stays behind that comes out 1, 2, ... frames later.
    level_e : float
        Full scale, e-.

    Returns
    -------
    shares : (band,) float64
    covariance : (band, band) float64
    against : float
        Chi-square by which the same share in all bands is worse.
    """
    n = len(BANDS)
    slopes, weights = np.zeros(n), 0.0

    def distortion(fringes: FringeEvidence, signal: F32, sizes: F64) -> tuple[F32, Iterator[F32]]:
        nonlocal slopes, weights
        level = evidence.level(fringes, signal)
        flat = evidence.flat.astype(np.float32)
        moving = level - level.mean(axis=0)
        weights += float(np.vdot(moving, moving))

        def terms() -> Iterator[F32]:
            nonlocal slopes
            for number, band in enumerate(in_bands(level, level_e)):
                slopes[number] += float(np.vdot(moving, band))
                late = np.zeros_like(band)
                for back, release in enumerate(releases, start=1):
                    late[back:] += np.float32(release) * band[:-back]
                # Of the first frames it is not known what was before them.
                late[: len(releases)] = level[: len(releases)]
                yield late / flat
            yield from (band / flat for band in in_bands(level, level_e)[1:])

        return np.zeros_like(signal), terms()

    sets = tuple(evidence.fringes.values())
    normal, right = distortion_sums(sets, distortion, 2 * n - 1)
    slopes /= max(weights, 1e-30)
    # What the mean share is, the fit has taken up.
    error = EXACT * max(abs(share), 1e-9)
    normal[:n, :n] += np.outer(slopes, slopes) / error**2
    right[:n] += slopes * share / error**2
    inverse = inverse_normal(normal)
    covariance, shares = inverse[:n, :n], (inverse @ right)[:n]
    away = shares - share
    against = float(away @ np.linalg.pinv(covariance, hermitian=True) @ away)
    return shares, covariance, against
