"""Gain of the amplifier, changing from frame to frame."""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from pixcal.effects._level_change import LevelChange
from pixcal.effects.intensity_noise import IntensityNoise
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.light import gain_share
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F32
from pixcal.simulation.effect import Estimate, Stage
from pixcal.simulation.shot import Shot

WHY = "signal that varies from frame to frame, and noise that rises with it as with a gain"


@dataclass(frozen=True)
class GainDrift(LevelChange):
    """The gain scales the signal of a frame and its shot noise; the light is steady."""

    name = "gain_drift"
    title = "gain that varies from frame to frame"
    acts_at = Stage.SIGNAL
    order = 3
    domains = ("time", "noise")
    sources = (
        "Janesick, Scientific Charge-Coupled Devices (SPIE 2001), chapter 7: shot noise goes with "
        "the root of the light, and both with the gain",
    )

    def signal(self, signal: F32, shot: Shot) -> F32:
        # What flats and bias frames show of it is measured on them.
        if shot.recording.kind != "fringes":
            return signal
        change = self.changes(shot.recording)[shot.frame]
        return np.asarray(signal * np.float32(max(1 + change, 0.0)))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """That of `IntensityNoise`, where the noise is that of a gain."""
        estimate = IntensityNoise.estimate(evidence)
        if estimate is None:
            return None
        law = cast(IntensityNoise, estimate.effect)
        effect = cls(law.rms, law.correlation_s, law.line, law.line_hz)
        refused = "" if estimate.refused else "the noise does not rise as with a gain that varies"
        share, error = gain_share(evidence)
        if refused and 1 - share < SIGNIFICANT * error:
            refused = "the noise cannot tell it from intensity_noise"
        return replace(estimate, effect=effect, why=WHY, law="", refused=refused)
