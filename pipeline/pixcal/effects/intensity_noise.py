"""Power of the laser, or of its coupling into the fibres, changing from frame to frame."""

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.effects._level_change import LevelChange
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series import light
from pixcal.kernels.scene import FrameStates
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.config import quantity
from pixcal.simulation.effect import Estimate, Stage
from pixcal.simulation.recording import Recording
from pixcal.simulation.track import Track, at

# share of ambient light above which contrast noise is more likely
MAX_AMBIENT = 0.3


@dataclass(frozen=True)
class IntensityNoise(LevelChange):
    """Intensity B and amplitude A of each frame vary by the same factor."""

    name = "intensity_noise"
    title = "intensity that varies from frame to frame"
    acts_at = Stage.LIGHT
    order = 2
    domains = ("time",)
    sources = (
        "Rousset et al., section on simulations: 2 % fluctuations of the laser",
        "Thorlabs manual 12112-S01 (HRP350 He-Ne laser): modes that sweep through the gain curve "
        "change the power at below 1 Hz to some kHz, the mains at 50 and 100 Hz",
    )

    ambient: tuple[float, ...] = quantity((), low=0, high=0.9)
    """share of the light of each set that does not follow the laser"""
    separate: float = quantity(0.0, low=0, high=0.1)
    """relative rms of the contrast, white, if the powers of the two fibres vary separately"""
    contrast_tracks: tuple[Track, ...] = quantity(())
    """measured relative change of the contrast, if the fibres vary separately"""

    def scaled(self, factor: float) -> Self:
        along = tuple(track.scaled(factor) for track in self.contrast_tracks)
        return replace(
            super().scaled(factor), separate=factor * self.separate, contrast_tracks=along
        )

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        change, time = self.changes(recording), recording.times_s
        level = np.maximum(1 + (1 - self._ambient(recording.number)) * change, 0.0)
        contrast = self.separate * recording.rng(self.name, 2).standard_normal(recording.count)
        contrast += at(self.contrast_tracks, recording.set_name, time)
        fringe = np.maximum(1 + change, 0.0) * np.maximum(1 + contrast, 0.0)
        return replace(states, level=states.level * level, amplitude=states.amplitude * fringe)

    def replayed(self, evidence: Evidence) -> Self | None:
        courses = light.light_changes(evidence)
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
        estimate = super().estimate(evidence)
        if estimate is None:
            return None
        of_gain, of_gain_error = light.gain_share(evidence)
        if of_gain > max(0.5, SIGNIFICANT * of_gain_error):
            return replace(estimate, refused="its noise rises as that of a gain that varies")
        assert isinstance(estimate.effect, cls)
        effect = estimate.effect
        shares = light.ambient_shares(evidence)
        if any(SIGNIFICANT * error < share < MAX_AMBIENT for share, error in shares):
            ambient = tuple(float(np.clip(share, 0, MAX_AMBIENT)) for share, _ in shares)
            effect = replace(effect, ambient=ambient)
        elif estimate.significance > SIGNIFICANT:
            effect = replace(effect, separate=light.separate_powers(evidence))
        law = "the powers of the two fibres vary separately" if effect.separate else estimate.law
        return replace(estimate, effect=effect, law=law)
