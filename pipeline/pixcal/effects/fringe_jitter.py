"""Fibres that shake from one frame to the next: a fringe vector of its own in every frame."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.fringe_motion import motion_of, ramps
from pixcal.estimators.frame_series.variance_components import joint_log_chance, sigmas
from pixcal.kernels.scene import FrameStates
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording


@dataclass(frozen=True)
class FringeJitter(Effect):
    """A random change of the fringe vector in every frame, white, of its own along x and y.

    Two fibre tips that move against each other by d change the vector by ``2 pi pitch d /
    (wavelength distance)``, whatever the baseline and the window: 1.1e-4 rad/px a micrometre on the
    paper's bench. The phase at the window's centre stays; the modulator makes it random anyway.
    Nothing of it is constant in time, so maps alone do not tell of it, and there is nothing to undo
    on them: the fit leaves the vector free in each frame where it moves.
    """

    name = "fringe_jitter"
    title = "fringe vector changing from frame to frame"
    acts_at = Stage.LIGHT
    domains = ("time", "space")
    strengths = ("rms",)
    absorbed_because = "the fit has a free fringe vector in each frame where it moves"
    frames_needed = ()
    sources = (
        "Rousset et al., sections 4.2 and 5.2: fringe residuals are laid to changing Kx, Ky",
        "C. G. Gordon 1992, Proc. SPIE 1619, 71: laboratory floors of 12 to 50 um/s rms (curves "
        "VC-C to VC-A), which at 30 Hz is 0.07 to 0.27 um",
    )

    rms: tuple[float, float] = quantity(
        (2.5e-5, 2.5e-5), unit="rad/px", low=0, high=0.1, doc="of the vector along x and y"
    )

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """As in `Effect.states`."""
        drawn = recording.rng(self.name).standard_normal((recording.count, 2))
        change = drawn * np.array(self.rms)
        return replace(states, dkx=states.dkx + change[:, 0], dky=states.dky + change[:, 1])

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """White part of the frames' own vectors beyond the noise, beside what drifts or swings.

        The noise is measured, from two halves of the pixels (`FringeEvidence.halves`).
        """
        motion = motion_of(evidence)
        if motion is None:
            return None
        parts = ["jitter_x", "jitter_y", "walk_x", "walk_y"] + ["walk_k"] * motion.crossed
        full = motion.components(parts, ramps)
        less = motion.components(parts, ramps, absent=("jitter_x", "jitter_y"))
        (x, x_error), (y, y_error) = full.root(0), full.root(1)
        return Estimate(
            cls((min(x, 0.1), min(y, 0.1))),
            {"rms[0]": x_error, "rms[1]": y_error},
            sigmas(joint_log_chance(full, less, full.size[:2])),
            "scatter of the fringe vector from frame to frame beyond drift, correlated between two "
            "halves of the pixels",
            {"frames": sum(map(len, motion.series))},
        )
