"""Nonlinear response from the noise of flats (photon transfer)."""

import numpy as np
from scipy.optimize import least_squares

from pixcal.estimators.detector.transfer_curve import TransferCurve, transfer_curve
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64

_OTHER_ORDER = 4
_NOT_TOLD = 1e-3
_INVERSIONS = 12  # of the response
_WITH_CUBIC = 6  # fewest levels of flats whose noise shows a cubic term
_LOWEST, _HIGHEST = (-0.3, -0.3), (0.3, 0.3)


def full_scale(evidence: Evidence, usual: float) -> float:
    """Reference level of the deviations: the usual one, unless fringes are of another order."""
    brightest = [float(np.nanquantile(f.electrons[::7], 0.99)) for f in evidence.fringes.values()]
    for stack in evidence.of_kind("flat"):
        brightest.append(float(np.median(stack.adu[0] - evidence.bias)) * evidence.gain)
    top = max(brightest, default=usual)
    alike = evidence.fringes and usual / _OTHER_ORDER < top < usual * _OTHER_ORDER
    return usual if alike else float(f"{top:.1g}")


def response_of_noise(evidence: Evidence, level_e: float) -> tuple[F64, F64] | None:
    """(quadratic, cubic) and covariance from photon transfer; None with too few levels."""
    # A signal ``S (1 + q u)`` has variance ``S (1 + 2 q u)²``; their ratio rises as 1 + 3 q u. The
    # cubic term is zero unless the ratio bends significantly.
    curve = transfer_curve(evidence)
    if curve is None:
        return None
    if (bent := _bent_by_noise(curve)) is not None:
        scales = (level_e / curve.top) ** np.arange(1, 3)
        return bent[0] * scales, bent[1] * np.outer(scales, scales)
    scale = level_e / (3 * curve.top * curve.share)
    error = scale * curve.slope_error
    return np.array([scale * curve.slope, 0.0]), np.diag([error**2, _NOT_TOLD**2])


def _bent_by_noise(curve: TransferCurve) -> tuple[F64, F64] | None:
    """Quadratic and cubic term at the highest level, and covariance; None without a bend."""
    signal = curve.levels / curve.top

    def rest(sizes: F64) -> F64:
        share, quadratic, cubic, read = sizes
        u = signal
        for _ in range(_INVERSIONS):
            u = signal / (1 + quadratic * u + cubic * u**2)
        rise = 1 + 2 * quadratic * u + 3 * cubic * u**2
        ratio = share * rise**2 * u / signal + read * curve.common / curve.levels
        return np.append((ratio - curve.shares) / curve.errors, read)

    if len(signal) < _WITH_CUBIC:
        return None
    bounds = [0.0, *_LOWEST, -np.inf], [np.inf, *_HIGHEST, np.inf]
    fit = least_squares(rest, [curve.share, 0.0, 0.0, 0.0], bounds=bounds)
    covariance = np.linalg.inv(fit.jac.T @ fit.jac)[1:3, 1:3]
    if abs(fit.x[2]) < SIGNIFICANT * np.sqrt(covariance[1, 1]):
        return None
    return fit.x[1:3], covariance
