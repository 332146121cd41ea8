"""Noise of groups of columns. An invented effect: its forward model, and nothing else."""

from dataclasses import dataclass

import numpy as np

from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage


@dataclass(frozen=True)
class GroupNoise(Effect):
    """Noise common to all columns of a read-out group, in every row."""

    name, title, acts_at = "group_noise", "noise of read-out groups", Stage.READOUT
    domains, strengths = ("noise",), ("rms",)
    sources = ("invented for the tests",)

    rms: float = quantity(2.0, unit="ADU", low=0, doc="of a row of a group")
    columns: int = quantity(16, unit="px", low=1, doc="of a group")

    def readout(self, adu, shot):
        first, after = shot.rows
        groups = -(-adu.shape[1] // self.columns)
        rows = shot.bench.detector.shape[0]
        noise = shot.rng(self.name).standard_normal((rows, groups))[first:after]
        spread = np.repeat(noise, self.columns, axis=1)[:, : adu.shape[1]]
        return adu + (self.rms * spread).astype(np.float32)
