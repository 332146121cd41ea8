"""Maps less their smooth surfaces, as deviations from the nominal bench."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from pixcal.estimators.maps.structure import flattened
from pixcal.model.arrays import F64

# of the smooth surface that maps of the nominal bench may have
DEGREES = {"offset": 3, "contrast": 2, "light": 3}
MAPS = tuple(DEGREES)
AROUND = 5  # pixels along the side of a pixel's surroundings
# share of the changes of pixels by which they may differ from those of their surroundings
ALONE = 0.5


@dataclass(frozen=True)
class Deviation:
    """Values that differ from what is nominal, and one over their variance."""

    value: NDArray[Any]
    weight: NDArray[Any]


def weighed(maps: F64) -> Deviation:
    """Maps less their smooth surfaces, weighed by what neighbours differ by; NaN by nothing."""
    flat, weight = without_smooth(maps), np.zeros(maps.shape)
    for own, out in zip(maps, weight, strict=True):
        steps = np.diff(own, axis=1)
        if np.isfinite(steps).any():
            spread = 1.4826 * float(np.nanmedian(np.abs(steps))) / np.sqrt(2)
            out[np.isfinite(own)] = 1 / max(spread**2, 1e-30)
    return Deviation(flat, weight)


def is_smooth(maps: F64, weight: F64) -> bool:
    """Whether maps (m, y, x) change from pixel to pixel by less than they do at large.

    Of others, the noise of the maps that were measured may decide.
    """
    around = np.stack([median_filter(own, AROUND, mode="reflect") for own in maps])
    rough, whole = (float((weight * v**2).sum()) for v in (maps - around, maps))
    return rough <= ALONE**2 * whole


def change_of_maps(maps: F64, measured: Deviation) -> F64:
    """Change of maps less smooth surfaces, on the pixels that were measured."""
    return without_smooth(np.where(measured.weight > 0, maps, np.nan))


def without_smooth(maps: F64) -> F64:
    """Maps less their smooth surfaces; zero where there are none."""
    degrees = [DEGREES[name] for name in MAPS] if len(maps) == len(MAPS) else [DEGREES["light"]]
    return np.nan_to_num(
        np.stack([flattened(own, degree) for own, degree in zip(maps, degrees, strict=True)])
    )
