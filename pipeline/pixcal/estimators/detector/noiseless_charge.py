"""Whether charge that an effect adds to the samples has shot noise of its own."""

from collections.abc import Callable, Iterable

import numpy as np

from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F32, F64

_LEAST_LEFT = 0.1  # share of the variance of a sample that a fit leaves at least
HARMONICS = 3  # of the phase that do not count as noise
_CLIP = 25.0  # squared residuals over their variance from which they are excluded (particles)


def missing_noise(
    evidence: Evidence, added: Callable[[FringeEvidence, F32], F32]
) -> tuple[float, float]:
    """Part of the shot noise of ``added`` charge (t, y, x), e-, that residuals lack; its error."""
    # Squared residuals are fitted with the expected variance, a constant and the added charge, so a
    # wrong gain or read noise does not pass for it.
    flat = evidence.flat.astype(np.float32)

    def terms(fringes: FringeEvidence, variance: F32) -> list[F32]:
        charge = added(fringes, fringes.model * flat)[:, fringes.good]
        return [variance, np.ones_like(variance), -charge]

    return _last_of(evidence, [(f, Freedom(f)) for f in evidence.fringes.values()], terms)


def noiseless_level(evidence: Evidence, fringes: FringeEvidence) -> tuple[float, float]:
    """Constant part (e-, before the flat) of a signal without shot noise: an offset; its error."""
    # Late charge and a nonlinear response leave residuals that are not noise.
    free = Freedom(fringes, HARMONICS, before=(1.0,))
    return _last_of(evidence, [(fringes, free)], lambda _, v: [v, -np.ones_like(v)])


def _last_of(
    evidence: Evidence,
    sets: Iterable[tuple[FringeEvidence, Freedom]],
    terms: Callable[[FringeEvidence, F32], list[F32]],
) -> tuple[float, float]:
    """The last of some terms (t, n) of squared residuals, e-² before the flat, and its error."""
    normal: F64 | float = 0.0
    right: F64 | float = 0.0
    for fringes, free in sets:
        flat = evidence.flat[fringes.good].astype(np.float32)
        variance = fringes.variance[:, fringes.good] * flat**2
        # The fit of a pixel takes most of the variance of dark samples, which weigh most: an offset
        # of the signal by 3 / t of its harmonic mean would change the variances alike.
        left = np.maximum(1 - free.absorbed_by_pixels(), _LEAST_LEFT)
        square = (free.left_over(free.of_good(fringes.residual)) * flat) ** 2 / left
        kept = square < _CLIP * variance
        square, weight = np.where(kept, square, 0), np.where(kept, 0.5 / variance**2, 0)
        own = terms(fringes, variance)
        normal = normal + np.array([[np.vdot(weight * a, b) for b in own] for a in own], float)
        right = right + np.array([np.vdot(weight * a, square) for a in own], float)
    covariance = inverse_normal(np.asarray(normal))
    return float(covariance[-1] @ right), float(np.sqrt(covariance[-1, -1]))
