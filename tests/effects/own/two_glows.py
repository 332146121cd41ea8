"""Two read-out amplifiers that glow: strengths that are a tuple."""

from dataclasses import dataclass

import numpy as np

from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage


@dataclass(frozen=True)
class TwoGlows(Effect):
    """Light of an amplifier at the left and of one at the right end of the first row."""

    name, title, acts_at = "two_glows", "glow of two amplifiers", Stage.LIGHT
    domains, strengths = ("space", "intensity"), ("rates",)
    sources = ("invented for the tests",)

    rates: tuple[float, float] = quantity((200.0, 200.0), unit="e-/s", low=0, doc="left and right")
    reach_px: float = quantity(15.0, unit="px", above=0, doc="where it has fallen to 1/e")

    def photons(self, mean, shot):
        """Mean electrons of a frame before shot noise: both glows are added."""
        y, x = np.ogrid[slice(*shot.rows), : mean.shape[1]]
        seconds, last = shot.recording.exptime_s, mean.shape[1] - 1
        for rate, at in zip(self.rates, (0, last), strict=True):
            glow = rate * seconds * np.exp(-np.hypot(y, x - at) / self.reach_px)
            mean = mean + glow.astype(np.float32)
        return mean
