"""Power of the laser, or of its coupling into the fibres, changing from frame to frame."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.light import ambient_shares, light_changes, separate_powers
from pixcal.kernels.processes import autoregression, mean_sine
from pixcal.kernels.scene import FrameStates
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording
from pixcal.simulation.track import Track, at

# share of ambient light above which contrast noise is more likely
MAX_AMBIENT = 0.3


@dataclass(frozen=True)
class IntensityNoise(Effect):
    """Intensity B and amplitude A of each frame vary by the same factor."""

    name = "intensity_noise"
    title = "intensity that varies from frame to frame"
    acts_at = Stage.LIGHT
    order = 2
    domains = ("time",)
    strengths = ("rms", "line", "tracks")
    absorbed_because = "the fit has a free intensity in each frame"
    frames_needed = ()
    quick = False
    sources = (
        "Rousset et al., section on simulations: 2 % fluctuations of the laser",
        "Thorlabs manual 12112-S01 (HRP350 He-Ne laser): modes that sweep through the gain curve "
        "change the power at below 1 Hz to some kHz, the mains at 50 and 100 Hz",
    )

    rms: float = quantity(0.02, low=0, high=0.5, doc="relative rms of the intensity")
    correlation_s: float = quantity(
        0.0, unit="s", low=0, high=1e6, doc="correlation time; 0: white"
    )
    line: float = quantity(0.0, low=0, high=0.5, doc="relative amplitude of a periodic variation")
    line_hz: float = quantity(
        100.0,
        unit="Hz",
        low=0,
        high=1e4,
        doc="frequency of the periodic variation, which averages out in exposures of whole periods",
    )
    ambient: tuple[float, ...] = quantity(
        (), low=0, high=0.9, doc="share of the light of each set that does not follow the laser"
    )
    separate: float = quantity(
        0.0,
        low=0,
        high=0.1,
        doc="relative rms of the contrast, white, if the powers of the two fibres vary separately",
    )
    tracks: tuple[Track, ...] = quantity(
        (), doc="measured relative change of each frame, by fringe set"
    )
    contrast_tracks: tuple[Track, ...] = quantity(
        (), doc="measured relative change of the contrast, if the fibres vary separately"
    )

    def scaled(self, factor: float) -> Self:
        along = tuple(track.scaled(factor) for track in self.contrast_tracks)
        return replace(
            super().scaled(factor), separate=factor * self.separate, contrast_tracks=along
        )

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        drawn = recording.rng(self.name).standard_normal(recording.count)
        keep = np.exp(-recording.period_s / self.correlation_s) if self.correlation_s else 0.0
        time = recording.times_s
        phase = 2 * np.pi * recording.rng(self.name, 1).random()
        change = self.rms * autoregression(drawn, keep)
        change += self.line * mean_sine(time, self.line_hz, phase, recording.exptime_s)
        change += at(self.tracks, recording.set_name, time)
        level = np.maximum(1 + (1 - self._ambient(recording.number)) * change, 0.0)
        contrast = self.separate * recording.rng(self.name, 2).standard_normal(recording.count)
        contrast += at(self.contrast_tracks, recording.set_name, time)
        fringe = np.maximum(1 + change, 0.0) * np.maximum(1 + contrast, 0.0)
        return replace(states, level=states.level * level, amplitude=states.amplitude * fringe)

    def replayed(self, evidence: Evidence) -> Self | None:
        courses = light_changes(evidence)
        share = {name: self._ambient(n) for n, name in enumerate(evidence.fringes)}
        tracks = tuple(
            Track.of(name, time, level / (1 - share[name])) for name, time, level, _ in courses
        )
        contrast = tuple(
            Track.of(name, time, change - level * share[name] / (1 - share[name]))
            for name, time, level, change in courses
            if self.separate
        )
        return replace(
            self, rms=0.0, line=0.0, separate=0.0, tracks=tracks, contrast_tracks=contrast
        )

    def _ambient(self, number: int) -> float:
        """Share of ambient light in a set; zero if not given."""
        return self.ambient[number] if number < len(self.ambient) else 0.0

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """As by `Effect`, with the change of contrast by ambient light or separate powers."""
        found = super().estimate(evidence)
        if found is None:
            return None
        assert isinstance(found.effect, cls)
        effect = found.effect
        shares = ambient_shares(evidence)
        if any(SIGNIFICANT * error < share < MAX_AMBIENT for share, error in shares):
            ambient = tuple(float(np.clip(share, 0, MAX_AMBIENT)) for share, _ in shares)
            effect = replace(effect, ambient=ambient)
        elif found.significance > SIGNIFICANT:
            effect = replace(effect, separate=separate_powers(evidence))
        law = "the powers of the two fibres vary separately" if effect.separate else found.law
        return replace(found, effect=effect, law=law)
