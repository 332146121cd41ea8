"""Trails of charge behind hot pixels, which grow with the number of transfers.

A transfer that is not complete leaves charge to the next pixel of the column (or row), so a trail
points away from the output, and holds a share of the charge that grows with the distance to it.
Crosstalk does not depend on the place of the output.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from pixcal.estimators.crosstalk.hot_pixels import HotPixels, hot_pixels
from pixcal.estimators.crosstalk.links import REACH
from pixcal.estimators.diagnosis.evidence import Evidence, cached_on_evidence
from pixcal.kernels.medians import median_and_sigma
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_best
from pixcal.model.arrays import F64

LEAST = 10  # least number of hot pixels
SURE = 5.0  # significance beyond which trails are no crosstalk

LINKS = (*((n, 0) for n in range(1, REACH + 1)), *((0, n) for n in range(1, REACH + 1)))
_ALIKE = 1 - 1e-9  # largest correlation of ranks
_FAR = 1 << 14  # most pixels from the window to the output
_HIGHEST = 1.5  # power of the charge
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
    whole = np.isfinite(hot.sigma[:, links]).all(axis=(1, 2))
    value, charge = hot.value[whole, links], hot.charge[whole] * 1e3
    if len(value) < LEAST:
        return None
    at = (hot.y, hot.x)[axis][whole] + start
    apart = (value[:, :, 0] - value[:, :, 1]).sum(axis=1)
    back = bool(np.median(apart) < 0)
    trail, sign = value[:, :, int(back)], -1 if back else 1
    few = len(trail) // 10
    near = np.sort(trail, axis=0)[few : len(trail) - few].mean(axis=0)
    ratio = float(np.clip(near[1:].sum() / max(near[:-1].sum(), 1e-12), _LEAST_RATIO, _MOST_RATIO))
    shares, place, level = trail.sum(axis=1), sign * at, float(np.median(charge))
    edge = min(sign * start, sign * (start + size - 1))
    noise = np.sqrt(REACH) * hot.sigma[whole, axis * REACH, 0]
    spread = np.hypot(noise, 0.5 * median_and_sigma(shares)[1])

    def rest(trial: F64) -> F64:
        loss, power, beyond = trial
        transfers = place - edge + 1 + size * beyond
        return np.asarray((loss * (charge / level) ** (power - 1) * transfers - shares) / spread)

    start_at = max(float(np.median(shares / (place - edge + 1))), 1e-9), 1.0, 0.0
    lowest, highest = (0.0, 0.0, (edge - place.min()) / size), (1.0, _HIGHEST, _FAR / size)
    fit = least_squares(
        rest, start_at, bounds=(lowest, highest), x_scale=(start_at[0], 1.0, 1.0), loss="soft_l1"
    )
    variance = 2 * fit.cost / max(len(at) - 3, 1)
    errors = np.sqrt(np.diag(inverse_normal(fit.jac.T @ fit.jac)) * variance)
    loss, power, beyond = fit.x.tolist()
    rise = np.corrcoef(_ranks(at), _ranks(apart * (charge / level) ** (1 - power)))[0, 1]
    sigmas = float(np.arctanh(np.clip(rise, -_ALIKE, _ALIKE))) * np.sqrt(len(at) - 3)
    first = at < np.median(at)
    signs = [np.sign(apart[half]).sum() / np.sqrt(half.sum()) for half in (first, ~first)]
    if signs[0] * signs[1] < 0 and min(np.abs(signs)) > SIGNIFICANT:
        # Charge trails away from the output, not both ways, as signals of two outputs do.
        sigmas = 0.0
    part = 1 - ratio**REACH  # of a trail
    losses = loss / part, float(errors[0]) / part
    output = sign * (edge - round(size * beyond))
    return Trail(sigmas, losses, (power, float(errors[1])), level, ratio, output)


def _ranks(values: NDArray[Any]) -> F64:
    """Ranks, the mean of them for equal values; not from scipy.stats, which is slow to import."""
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((counts.cumsum() - (counts - 1) / 2)[places])
