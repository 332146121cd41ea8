"""Noise of flats that grows with the level, over that expected, whatever the response."""

import numpy as np

from pixcal.estimators.detector.flat_ladder import ladder_response
from pixcal.estimators.detector.transfer_curve import (
    TransferCurve,
    read_known,
    shot_share,
    sums_of_stacks,
    transfer_curve,
)
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.arrays import F64

_CURVED = 3.0
_STEP = 1e-4  # step of the deviations of a response, for derivatives


def shot_share_of_flats(evidence: Evidence) -> tuple[float, float] | None:
    """Signal-dependent noise in flats over the expected noise; None without samples."""
    # A nonlinear response changes the noise in proportion to the level, a wrong gain by one factor.
    # The nonlinearity is corrected by the levels or, if the lamp was changed between them, by
    # extrapolation of the noise to level zero.
    pooled = shot_share(sums_of_stacks(evidence), known=read_known(evidence))
    curve = transfer_curve(evidence, whole=True)
    if pooled is None or curve is None:
        return pooled
    response = ladder_response(evidence, curve.top)
    straight = None if response is None else _straightened(curve, *response)
    # If the lamp was changed, its levels constrain the response less than noise does.
    if straight is not None and straight[1] < curve.error:
        return straight
    curved = abs(curve.slope) > _CURVED * curve.slope_error
    return (curve.share, curve.error) if curved else pooled


def _straightened(curve: TransferCurve, sizes: F64, covariance: F64) -> tuple[float, float]:
    """Share of noise, corrected for a response of relative deviations (2,) at the highest level."""
    u, weight = curve.levels / curve.top, curve.errors**-2

    def share(sizes: F64) -> float:
        rise = 1 + u * (2 * sizes[0] + 3 * u * sizes[1])
        straight = curve.shares * (1 + u * (sizes[0] + u * sizes[1])) / rise**2
        return float(np.average(straight, weights=weight))

    value = share(sizes)
    slope = np.array([share(sizes + step) - value for step in _STEP * np.eye(2)]) / _STEP
    slope[sizes == 0] = 0  # a power that few levels do not constrain
    return value, float(np.sqrt(1 / weight.sum() + slope @ covariance @ slope))
