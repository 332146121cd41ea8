"""Frame-to-frame jitter of the fringe vector."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.processes import mean_sine
from pixcal.kernels.scene import FrameStates
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Stage
from pixcal.simulation.recording import Recording
from pixcal.simulation.track import Track, moved, vector_tracks


@dataclass(frozen=True)
class FringeJitter(Effect):
    """White noise of the fringe vector from frame to frame along x and y, and a vibration."""

    name = "fringe_jitter"
    title = "fringe vector that varies from frame to frame"
    acts_at = Stage.LIGHT
    order = 4
    domains = ("time", "space")
    strengths = ("rms", "vibration", "along_x", "along_y")
    absorbed_because = "the fit has a free fringe vector in each frame if the vector moves"
    frames_needed = ()
    sources = (
        "Rousset et al., sections 4.2 and 5.2: fringe residuals come from changing Kx, Ky, and "
        "these from low-frequency vibrations",
        "C. G. Gordon 1992, Proc. SPIE 1619, 71: laboratory floors of 12 to 50 um/s rms (curves "
        "VC-C to VC-A), which at 30 Hz is 0.07 to 0.27 um",
    )

    rms: tuple[float, float] = quantity((2.5e-5, 2.5e-5), unit="rad/px", low=0, high=0.1)
    """white noise along x and y, rms"""
    vibration: tuple[float, float] = quantity((0.0, 0.0), unit="rad/px", low=0, high=0.1)
    """amplitude of the vibration along x and y"""
    vibration_hz: float = quantity(20.3, unit="Hz", low=0, high=1e4)
    """frequency of the vibration; aliased below half the frame rate"""
    along_x: tuple[Track, ...] = quantity((), unit="rad/px")
    """measured fast change of kx"""
    along_y: tuple[Track, ...] = quantity((), unit="rad/px")
    """measured fast change of ky"""

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        drawn = recording.rng(self.name).standard_normal((recording.count, 2))
        time = recording.times_s
        phase = 2 * np.pi * recording.rng(self.name, 1).random()
        swung = mean_sine(time, self.vibration_hz, phase, recording.exptime_s)
        change = drawn * np.array(self.rms) + np.outer(swung, self.vibration)
        return moved(states, recording, change, self.along_x, self.along_y)

    def replayed(self, evidence: Evidence) -> Self | None:
        """As in `Effect.replayed`: the frames' fringe vectors without slow changes."""
        x, y = vector_tracks(evidence, slow=False)
        return replace(self.scaled(0.0), along_x=x, along_y=y)
