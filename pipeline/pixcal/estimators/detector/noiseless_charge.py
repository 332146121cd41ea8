"""Whether charge that an effect adds to the samples has shot noise of its own."""

from collections.abc import Callable

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F32

_CLIP = 25.0  # squares of residuals, over their variance, that are left to particles and the like


def missing_noise(
    evidence: Evidence, added: Callable[[FringeEvidence, F32], F32]
) -> tuple[float, float]:
    """Part of the shot noise of an added charge that the residuals lack.

    Squared residuals are fitted by weighted least squares with the expected variance, a constant
    and the added charge. So a gain or a read noise that is off does not pass for it: only the
    frames before tell how much was added to samples of the same level.

    Parameters
    ----------
    evidence : Evidence
        With fringes.
    added : callable
        Added charge (t, y, x), e-, of a fringe set and its signal (t, y, x), e- before the flat.

    Returns
    -------
    part, error : float
        Zero where every added electron came by its own chance, one where none did.
    """
    normal, right = np.zeros((3, 3)), np.zeros(3)
    flat = evidence.flat.astype(np.float32)
    for fringes in evidence.fringes.values():
        charge = added(fringes, fringes.model * flat)
        square = (fringes.residual[:, fringes.good] * flat[fringes.good]) ** 2
        variance = fringes.variance[:, fringes.good] * flat[fringes.good] ** 2
        weight = np.where(square < _CLIP * variance, 0.5 / variance**2, 0)
        terms = [variance, np.ones_like(variance), -charge[:, fringes.good]]
        for i, one in enumerate(terms):
            right[i] += float(np.vdot(weight * one, square))
            for j in range(i, 3):
                normal[i, j] += float(np.vdot(weight * one, terms[j]))
    normal = np.triu(normal) + np.triu(normal, 1).T
    covariance = inverse_normal(normal)
    return float(covariance[2] @ right), float(np.sqrt(covariance[2, 2]))


def noiseless_level(evidence: Evidence, fringes: FringeEvidence) -> tuple[float, float]:
    """Constant part of the signal of a fringe set that has no shot noise: an offset.

    Squared residuals are fitted with the expected variance, times a gain, less a constant. The read
    noise is that of the bias frames.

    Parameters
    ----------
    fringes : FringeEvidence
        One of its sets.

    Returns
    -------
    level, error : float
        e-, before the flat.
    """
    flat = evidence.flat[fringes.good].astype(np.float32)
    square = (fringes.residual[:, fringes.good] * flat) ** 2
    variance = fringes.variance[:, fringes.good] * flat**2
    weight = np.where(square < _CLIP * variance, 0.5 / variance**2, 0)
    terms = [variance, -np.ones_like(variance)]
    normal = np.array([[float(np.vdot(weight * a, b)) for b in terms] for a in terms])
    right = np.array([float(np.vdot(weight * a, square)) for a in terms])
    covariance = np.linalg.inv(normal)
    return float(covariance[1] @ right), float(np.sqrt(covariance[1, 1]))
