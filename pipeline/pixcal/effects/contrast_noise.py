"""Visibility that varies from frame to frame."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.light import light_changes
from pixcal.kernels.processes import autoregression
from pixcal.kernels.scene import FrameStates
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage
from pixcal.simulation.recording import Recording
from pixcal.simulation.track import Track, at


@dataclass(frozen=True)
class ContrastNoise(Effect):
    """The fringe amplitude A varies from frame to frame; the intensity B does not."""

    name = "contrast_noise"
    title = "visibility that varies from frame to frame"
    acts_at = Stage.LIGHT
    order = 5
    domains = ("time",)
    strengths = ("vibration_rad", "polarisation", "tracks")
    absorbed_because = "the fit has a free fringe amplitude in each frame"
    frames_needed = ()
    quick = False
    sources = (
        "Rousset et al., section 4.2: micro-vibrations within a frame are still to be studied",
        "Colavita 1999, PASP 111, 111: the visibility falls by exp(-s²/2) for a phase of rms s "
        "within the integration; 20 nm of path are 0.2 rad at 633 nm",
        "Stowe, Moore & Priest 1982, IEEE Trans. MTT 30, 1632: polarisation in fibres that do not "
        "keep it follows temperature and handling, down to complete fading",
    )

    vibration_rad: float = quantity(0.2, unit="rad", low=0, high=2)
    """rms phase of a vibration within an exposure"""
    polarisation: float = quantity(0.005, low=0, high=0.5)
    """relative rms of a slow variation, such as of the polarisation"""
    polarisation_s: float = quantity(600.0, unit="s", low=0, high=1e6)
    """correlation time of the slow variation; 0: white"""
    tracks: tuple[Track, ...] = quantity(())
    """measured relative change of each frame, by fringe set"""

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        energy = recording.rng(self.name).standard_exponential(recording.count)
        drawn = recording.rng(self.name, 1).standard_normal(recording.count)
        keep = np.exp(-recording.period_s / self.polarisation_s) if self.polarisation_s else 0.0
        factor = np.exp(-energy * self.vibration_rad**2 / 2)
        factor *= np.maximum(1 + self.polarisation * autoregression(drawn, keep), 0.0)
        factor *= np.maximum(1 + at(self.tracks, recording.set_name, recording.times_s), 0.0)
        most = states.level / recording.bench.optics_of(recording.number).visibility
        return replace(states, amplitude=np.minimum(states.amplitude * factor, most))

    def replayed(self, evidence: Evidence) -> Self | None:
        courses = light_changes(evidence)
        tracks = tuple(Track.of(name, time, change) for name, time, _, change in courses)
        return replace(self, vibration_rad=0.0, polarisation=0.0, tracks=tracks)
