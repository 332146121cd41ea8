"""Dark signal that differs from pixel to pixel, where no dark frames measure it."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.maps.visibility_scatter import mean_light, visibility_products
from pixcal.kernels.scene import TILE, DetectorMaps, Rows, chip_map
from pixcal.kernels.significance import root_with_error
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage

WHY = "pixel-to-pixel scatter of the visibility, the same in all sets, as dark charge causes"
SIZE = "scatter of the dark current between pixels"
_MIN_PIXELS = 200


@dataclass(frozen=True)
class DarkSignal(Effect):
    """Dark charge that cannot be distinguished from light without dark frames.

    Its mean acts like light that does not interfere. Its variation over pixels changes the
    visibility in all fringe sets, in inverse proportion to their light.
    """

    name = "dark_signal"
    title = "dark signal that no dark frames measure"
    acts_at = Stage.CHARGE
    order = 0
    domains = ("space",)
    strengths = ("scatter",)
    absorbed_because = "it changes the visibility of a pixel but not the phase; record dark frames"
    frames_needed = ("dark",)
    sources = (
        "EMVA Standard 1288, release 4.0 (2021): the dark signal grows with the exposure time",
        "Janesick, Scientific Charge-Coupled Devices (SPIE 2001), chapter 7: it differs between "
        "pixels by 10 % and more of its mean",
    )

    scatter: float = quantity(20.0, unit="e-/s", low=0, high=1e7)
    """rms of the dark current from pixel to pixel, half its mean"""

    def detector(self, maps: DetectorMaps, bench: Bench, rows: Rows) -> DetectorMaps:
        # Never negative: its mean is twice its scatter.
        drawn = chip_map(bench.detector, rows, self.name, lambda rng: rng.gamma(4.0, 0.5, TILE))
        return replace(maps, dark_rate=maps.dark_rate + np.float32(self.scatter) * drawn)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Common variation of the visibilities of all fringe sets, as charge per exposure time."""
        if not evidence.fringes:
            return None
        if evidence.of_kind("dark"):
            return Estimate(cls(0.0), {}, 0.0, WHY, refused="dark frames measure it")
        sets = [
            f
            for f in evidence.fringes.values()
            if np.count_nonzero(f.good) > _MIN_PIXELS and f.exptime_s > 0
        ]
        if not sets:
            return None
        pairs, products, errors = visibility_products(evidence, sets)
        scale = np.array([mean_light(f) / f.exptime_s for f in sets])
        # Within a set, pixels may differ in ways that other fringes do not share.
        some = [at for at, (m, n) in enumerate(pairs) if m != n or len(sets) == 1]
        by = np.array([scale[pairs[at][0]] * scale[pairs[at][1]] for at in some])
        weight = 1 / (by * errors[some]) ** 2
        variance = float(weight @ (by * products[some]) / weight.sum())
        error = float(weight.sum() ** -0.5)
        scatter, scatter_error = map(float, root_with_error(variance, error))
        errors_of = {"scatter": scatter_error}
        size = {"value": scatter, "error": scatter_error, "unit": "e-/s", "of": SIZE}
        return Estimate(cls(scatter), errors_of, variance / error, WHY, size=size)
