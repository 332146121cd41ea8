"""Trails of charge behind hot pixels, which grow with the number of transfers.

A transfer that is not complete leaves charge to the next pixel of the column (or row), so a trail
points away from the output, and holds a share of the charge that grows with the distance to it.
Crosstalk does not depend on the place of the output.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.crosstalk.hot_pixels import HotPixels, hot_pixels
from pixcal.estimators.crosstalk.links import REACH
from pixcal.estimators.diagnosis.evidence import Evidence, cached_on_evidence
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_best
from pixcal.model.arrays import F64, Indices

LEAST = 10  # least number of hot pixels
SURE = 5.0  # significance beyond which trails are no crosstalk

LINKS = (*((n, 0) for n in range(1, REACH + 1)), *((0, n) for n in range(1, REACH + 1)))
_CLEAR = 5.0  # errors of a trail from which its dependence on the charge is fitted
_ALIKE = 1 - 1e-9  # largest correlation of ranks
_TURNS = 2  # of the fits of the power and of the place of the output
_FAR = 1 << 14  # most pixels from the first hot pixel to the output
_LEAST_RATIO, _MOST_RATIO = 0.05, 0.95  # of the trail from one pixel to the next


@dataclass(frozen=True)
class Trail:
    """Trails along an axis of the array."""

    significance: float  # of the rise of the trails with the distance to the output
    loss: tuple[float, float]  # per transfer of a charge of ``level_e``, and its error
    power: tuple[float, float]  # of the charge that the loss goes with, and error
    level_e: float
    ratio: float  # of the trail from one pixel to the next
    output: int  # row or column next to the output, in the window


@cached_on_evidence
def trails(evidence: Evidence) -> tuple[Trail, Trail] | None:
    """Trails along the columns and along the rows; None with few hot pixels in darks."""
    hot = hot_pixels(evidence, LINKS)
    return None if hot is None else trails_of(hot, evidence.good.shape, evidence.origin)


def trails_of(
    hot: HotPixels, shape: tuple[int, ...], origin: tuple[int, int]
) -> tuple[Trail, Trail] | None:
    """The same of hot pixels with shares at `LINKS`, of a window of that shape and origin."""
    rows, columns = (_along(hot, shape[axis], origin[axis], axis) for axis in (0, 1))
    return None if rows is None or columns is None else (rows, columns)


def trailing(evidence: Evidence) -> float:
    """Significance of trails along either axis; 0 without enough hot pixels."""
    both = trails(evidence)
    return 0.0 if both is None else sigmas_of_best(*(one.significance for one in both))


def _along(hot: HotPixels, size: int, start: int, axis: int) -> Trail | None:
    links = slice(axis * REACH, (axis + 1) * REACH)
    value, sigma = hot.value[:, links], hot.sigma[:, links]
    whole = np.isfinite(sigma).all(axis=(1, 2))
    value, sigma, charge = value[whole], sigma[whole, 0, 0], hot.charge[whole] * 1e3
    if len(value) < LEAST:
        return None
    at = (hot.y, hot.x)[axis][whole] + start
    apart = (value[:, :, 0] - value[:, :, 1]).sum(axis=1)
    back = bool(np.median(apart) < 0)
    trail = value[:, :, int(back)]
    few = len(trail) // 10
    near = np.sort(trail, axis=0)[few : len(trail) - few].mean(axis=0)
    ratio = float(np.clip(near[1:].sum() / max(near[:-1].sum(), 1e-12), _LEAST_RATIO, _MOST_RATIO))
    shares, noise = trail.sum(axis=1), np.sqrt(REACH) * sigma
    level, power = float(np.median(charge)), (1.0, 1.0)
    output = start + size - 1 if back else start
    for _ in range(_TURNS):
        transfers = np.maximum(output - at if back else at - output, 0) + 1
        clear = shares > _CLEAR * noise
        if clear.sum() >= LEAST:
            logs = np.log(shares[clear] / transfers[clear])
            slope, error = _slope(np.log(charge[clear] / level), logs)
            power = float(np.clip(1 + slope, 0.0, 1.5)), error
        pattern = (charge / level) ** (power[0] - 1)
        weight = pattern**2 / (noise**2 + (0.5 * _scatter(shares)) ** 2)
        output = _zero(at, shares / pattern, weight, back)
    rise = np.corrcoef(_ranks(at), _ranks(apart / pattern))[0, 1]
    transfers = np.maximum(output - at if back else at - output, 0) + 1
    total = float((weight * transfers) @ transfers)
    loss = float((weight * transfers) @ (shares / pattern)) / total
    rest = weight * transfers * (shares / pattern - loss * transfers)
    whole_trail = 1 - ratio**REACH
    error = float(np.sqrt(rest @ rest)) / total
    losses = max(loss, 0.0) / whole_trail, error / whole_trail
    sigmas = float(np.arctanh(np.clip(rise, -_ALIKE, _ALIKE))) * np.sqrt(len(at) - 3)
    first = at < np.median(at)
    signs = [np.sign(apart[half]).sum() / np.sqrt(half.sum()) for half in (first, ~first)]
    if signs[0] * signs[1] < 0 and min(np.abs(signs)) > SIGNIFICANT:
        # Charge trails away from the output, not both ways, as signals of two outputs do.
        sigmas = 0.0
    return Trail(sigmas, losses, power, level, ratio, output)


def _zero(at: Indices, values: F64, weight: F64, back: bool) -> int:
    """Row or column where a line through values meets zero, before the first or after the last."""
    sign = -1 if back else 1
    first = int((sign * at).min())
    slope, value = np.polyfit(sign * at - first, values, 1, w=np.sqrt(weight))
    beyond = value / slope if slope > 0 else 0.0
    return sign * (first - int(np.clip(beyond, 0, _FAR)))


def _ranks(values: NDArray[Any]) -> F64:
    """Ranks, the mean of them for equal values; not from scipy.stats, which is slow to import."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((counts.cumsum() - (counts - 1) / 2)[places])


def _scatter(values: F64) -> float:
    return float(1.4826 * np.median(np.abs(values - np.median(values))))


def _slope(x: F64, y: F64) -> tuple[float, float]:
    """Slope of a line through points with outliers, and its error."""
    weight = np.ones_like(x)
    for _ in range(10):
        away = x - np.average(x, weights=weight)
        slope = float((weight * away) @ y / max(float((weight * away) @ away), 1e-12))
        rest = y - slope * x
        rest -= np.average(rest, weights=weight)
        weight = 1 / np.maximum(1, np.abs(rest) / max(1.5 * _scatter(rest), 1e-9))
    spread = weight * away * rest
    return slope, float(np.sqrt(spread @ spread) / max(float((weight * away) @ away), 1e-12))
