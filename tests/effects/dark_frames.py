"""Bias and dark frames made anew, with given effects."""

from dataclasses import replace

import numpy as np
from all_frames import frames_of

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import recordings


def in_the_dark(evidence: Evidence, bench: Bench, *on: Effect) -> Evidence:
    """The same evidence with bias and dark frames made anew, and no others."""
    made = {r.kind: r for r in recordings(bench)}
    stacks = [s for s in evidence.stacks if s.kind in ("bias", "dark")]
    frames = [frames_of(bench, made[s.kind], on).astype(np.float32) for s in stacks]
    remade = tuple(replace(s, adu=a) for s, a in zip(stacks, frames, strict=True))
    return replace(evidence, stacks=remade, fringes={})
