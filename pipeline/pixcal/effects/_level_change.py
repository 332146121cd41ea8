"""Signal of whole frames that varies: power of the light, or gain of the amplifier."""

from dataclasses import dataclass, replace
from typing import ClassVar, Self

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.light import light_changes
from pixcal.kernels.processes import autoregression, mean_sine
from pixcal.model.arrays import F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import Recording
from pixcal.simulation.track import Track, at


@dataclass(frozen=True)
class LevelChange(Effect):
    """Base of effects that scale the signal of each frame."""

    domains: ClassVar[tuple[str, ...]] = ("time",)
    strengths = ("rms", "line", "tracks")
    absorbed_because = "the fit has a free intensity in each frame"
    frames_needed = ()
    quick = False

    rms: float = quantity(0.02, low=0, high=0.5)
    """relative rms"""
    correlation_s: float = quantity(0.0, unit="s", low=0, high=1e6)
    """correlation time; 0: white"""
    line: float = quantity(0.0, low=0, high=0.5)
    """relative amplitude of a periodic variation"""
    line_hz: float = quantity(100.0, unit="Hz", low=0, high=1e4)
    """frequency of the periodic variation, which averages out in exposures of whole periods"""
    tracks: tuple[Track, ...] = quantity(())
    """measured relative change of each frame, by fringe set"""

    def changes(self, recording: Recording) -> F64:
        """Relative change (t,) of the signal."""
        drawn = recording.rng(self.name).standard_normal(recording.count)
        keep = np.exp(-recording.period_s / self.correlation_s) if self.correlation_s else 0.0
        time = recording.times_s
        phase = 2 * np.pi * recording.rng(self.name, 1).random()
        change = self.rms * autoregression(drawn, keep)
        change += self.line * mean_sine(time, self.line_hz, phase, recording.exptime_s)
        return change + at(self.tracks, recording.set_name, time)

    def replayed(self, evidence: Evidence) -> Self | None:
        courses = light_changes(evidence)
        tracks = tuple(Track.of(name, time, level) for name, time, level, _ in courses)
        return replace(self, rms=0.0, line=0.0, tracks=tracks)
