"""Statistics across configurations: how far fringe sets agree on the detector."""

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from pixcal.estimators.diagnosis.test_statistics import Curve, statistic
from pixcal.estimators.diagnosis.test_statistics.look import Look
from pixcal.estimators.maps.structure import flattened
from pixcal.model.arrays import F64

SAME = 0.98  # cosine of the angle below which two sets measure along the same axis


@statistic(
    "space", "correlation of maps between sets", x="contrast, light of each pair", together=True
)
def alike(looks: Sequence[Look]) -> Curve | None:
    """Correlation of the maps of each pair of sets."""
    values = [
        _correlation(flattened(one.maps[name]), flattened(other.maps[name]))
        for one, other in combinations(looks, 2)
        for name in ("contrast", "light")
    ]
    return Curve(np.arange(len(values), dtype=float), np.array(values)) if values else None


def _correlation(one: F64, other: F64) -> float:
    good = np.isfinite(one) & np.isfinite(other)
    return float(np.corrcoef(one[good], other[good])[0, 1])


@statistic(
    "space", "difference of offsets between sets", unit="px", x="pair", power=True, together=True
)
def apart(looks: Sequence[Look]) -> Curve | None:
    """Mean square of the difference of the offsets along one axis, by two baselines."""
    values = []
    for one, other in combinations(looks, 2):
        a, b = np.array(one.found.k), np.array(other.found.k)
        cosine = float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))
        if abs(cosine) > SAME:
            other_map = np.sign(cosine) * other.maps["offset"]
            values.append(float(np.nanmean(flattened(one.maps["offset"] - other_map) ** 2)))
    return Curve(np.arange(len(values), dtype=float), np.array(values)) if values else None
