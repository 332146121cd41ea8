"""Amplifier glow: an effect of one's own, from outside pixcal."""

from dataclasses import dataclass

import numpy as np

from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage


@dataclass(frozen=True)
class Glow(Effect):
    """Light of the read-out amplifier beside the first pixel, in every frame."""

    name, title, acts_at = "glow", "amplifier glow", Stage.LIGHT
    domains, strengths = ("space", "intensity"), ("rate",)
    sources = ("a guess, to be measured",)

    rate: float = quantity(200.0, unit="e-/s", low=0, doc="at the first pixel")
    reach_px: float = quantity(15.0, unit="px", above=0, doc="where it has fallen to 1/e")

    def photons(self, mean, shot):
        """Mean electrons of a frame before shot noise: the glow is added."""
        y, x = np.ogrid[slice(*shot.rows), : mean.shape[1]]
        glow = self.rate * shot.recording.exptime_s * np.exp(-np.hypot(y, x) / self.reach_px)
        return mean + glow.astype(np.float32)
