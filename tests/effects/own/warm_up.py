"""A laser that warms up. An invented effect: its forward model, and nothing else."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage


@dataclass(frozen=True)
class WarmUp(Effect):
    """A laser that warms up in the first minutes of every fringe set."""

    name, title, acts_at = "warm_up", "laser that warms up", Stage.LIGHT
    domains, strengths = ("time",), ("lack",)
    sources = ("invented for the tests",)

    lack: float = quantity(0.01, low=-0.9, high=0.9, doc="of the light of the first frame")
    settling_s: float = quantity(20.0, unit="s", above=0, doc="in which the lack falls to 1/e")

    def states(self, states, recording):
        time_s = recording.period_s * np.arange(recording.count)
        light = 1 - self.lack * np.exp(-time_s / self.settling_s)
        return replace(states, level=states.level * light, amplitude=states.amplitude * light)
