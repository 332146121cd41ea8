"""Maps less the smooth surfaces that the nominal bench may contain, and the noise of such maps."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pixcal.estimators.maps.structure import flattened
from pixcal.kernels.medians import SIGMA_OF_MAD, robust_sigma
from pixcal.model.arrays import F64

# degree of the smooth surfaces that maps of the nominal bench may contain
DEGREES = {"offset": 3, "contrast": 2, "light": 3}
MAPS = tuple(DEGREES)
WILD_STEP = 5.0  # robust deviations above which a step between neighbours is an outlier
AROUND = 5  # side (pixels) of a pixel's surroundings
# share of the pixels' changes by which they may differ from those of their surroundings
ALONE = 0.5


@dataclass(frozen=True)
class Deviation:
    """Differences from nominal values, and inverse variances."""

    value: NDArray[Any]
    weight: NDArray[Any]


def weighed(maps: F64) -> Deviation:
    """Maps less smooth surfaces, with weights from differences of neighbours; NaN: weight 0."""
    flat, weight = without_smooth(maps), np.zeros(maps.shape)
    for values, out in zip(maps, weight, strict=True):
        steps = np.diff(values, axis=1)
        if np.isfinite(steps).any():
            spread = robust_sigma(steps) / np.sqrt(2)
            out[np.isfinite(values)] = 1 / max(spread**2, 1e-30)
    return Deviation(flat, weight)


def common_precision(maps: F64) -> F64:
    """Inverse covariance (m, m) of the noise of maps (m, y, x) of the same pixels."""
    # From steps between neighbours along both axes, without outliers (`WILD_STEP`).
    steps = np.concatenate([np.diff(maps, axis=a).reshape(len(maps), -1) for a in (1, 2)], axis=1)
    steps = steps[:, np.isfinite(steps).all(axis=0)]
    usual = SIGMA_OF_MAD * np.median(np.abs(steps), axis=1, keepdims=True)
    scaled = steps / np.maximum(usual, 1e-30)
    scaled = scaled[:, (np.abs(scaled) < WILD_STEP).all(axis=0)]
    size = np.sqrt(2) / np.maximum(usual[:, 0], 1e-30)
    correlation = np.atleast_2d(np.corrcoef(scaled))
    return np.asarray(np.linalg.pinv(correlation, hermitian=True) * np.outer(size, size))


def is_smooth(maps: F64, weight: F64) -> bool:
    """Whether maps (m, y, x) change less from pixel to pixel than at large scales."""
    around = np.stack([median_filter(own, AROUND, mode="reflect") for own in maps])
    rough, whole = (float((weight * v**2).sum()) for v in (maps - around, maps))
    return rough <= ALONE**2 * whole


def change_of_maps(maps: F64, measured: Deviation) -> F64:
    """Change of maps less smooth surfaces, on the measured pixels."""
    return without_smooth(np.where(measured.weight > 0, maps, np.nan))


def without_smooth(maps: F64) -> F64:
    """Maps less their smooth surfaces; zero where maps are undefined."""
    degrees = [DEGREES[name] for name in MAPS] if len(maps) == len(MAPS) else [DEGREES["light"]]
    return np.nan_to_num(
        np.stack([flattened(own, degree) for own, degree in zip(maps, degrees, strict=True)])
    )
