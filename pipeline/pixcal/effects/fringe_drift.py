"""Slow drift of the fringe vector."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.processes import HOUR_S
from pixcal.kernels.scene import FrameStates
from pixcal.model.arrays import F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage
from pixcal.simulation.recording import Recording
from pixcal.simulation.track import Track, moved, vector_tracks

TRACKS = ("along_x", "along_y")


@dataclass(frozen=True)
class FringeDrift(Effect):
    """Slow drift of the fringe vector: a ramp, a decay, a random walk."""

    name = "fringe_drift"
    title = "fringe vector that drifts"
    acts_at = Stage.LIGHT
    order = 3
    domains = ("time", "space")
    strengths = ("ramp", "settle", "walk", *TRACKS)
    absorbed_because = "the fit has a free fringe vector in each frame if the vector moves"
    frames_needed = ()
    sources = (
        "Rousset et al., sections 4.2, 4.3 and 5.2: thermal deformations move Kx, Ky; one of two "
        "data sets drifts after 30 minutes",
        "thermal expansion of aluminium 23e-6/K (CRC Handbook of Chemistry and Physics): two posts "
        "of 100 mm that differ by 0.1 K move the fibres against each other by 0.23 um, 2.5e-5 "
        "rad/px",
    )

    ramp: tuple[float, float] = quantity((2.5e-5, 2.5e-5), unit="rad/px/h", low=-10, high=10)
    """linear drift along x and y"""
    settle: tuple[float, float] = quantity((2.5e-5, 2.5e-5), unit="rad/px", low=-1, high=1)
    """amplitude of an exponential decay from the first frame on"""
    settle_s: float = quantity(600.0, unit="s", above=0, high=1e6)
    """time constant of the decay"""
    walk: tuple[float, float] = quantity((1e-5, 1e-5), unit="rad/px/h^0.5", low=0, high=10)
    """random walk along x and y, rms after an hour"""
    along_x: tuple[Track, ...] = quantity((), unit="rad/px")
    """measured slow change of kx"""
    along_y: tuple[Track, ...] = quantity((), unit="rad/px")
    """measured slow change of ky"""

    def vector_change(self, time_s: F64) -> F64:
        """Deterministic change (t, 2) of the fringe vector since the first frame, rad/px."""
        fade = np.exp(-time_s / self.settle_s) - 1
        return np.asarray(np.outer(time_s / HOUR_S, self.ramp) + np.outer(fade, self.settle))

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        time = recording.times_s
        steps = recording.rng(self.name).standard_normal((recording.count, 2))
        walk = np.cumsum(steps, axis=0) * np.sqrt(recording.period_s / HOUR_S)
        change = self.vector_change(time) + walk * self.walk
        return moved(states, recording, change, self.along_x, self.along_y)

    def replayed(self, evidence: Evidence) -> Self | None:
        """As in `Effect.replayed`: the slow part of the frames' fringe vectors."""
        x, y = vector_tracks(evidence, slow=True)
        return replace(self.scaled(0.0), along_x=x, along_y=y)
