"""Charge that comes too late. An invented effect: its forward model, and nothing else."""

from dataclasses import dataclass

import numpy as np

from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage


@dataclass(frozen=True)
class Deferred(Effect):
    """Charge that stays behind in a transfer and comes with the next row."""

    name, title, acts_at = "deferred", "charge deferred to the next row", Stage.CHARGE
    domains, strengths = ("space", "noise"), ("share",)
    sources = ("invented for the tests",)

    share: float = quantity(0.01, low=0, high=0.5, doc="of the charge of a pixel")

    @property
    def halo(self):
        return 1

    def charge(self, charge, shot):
        before = np.zeros_like(charge)
        before[1:] = charge[:-1]
        return charge + np.float32(self.share) * (before - charge)
