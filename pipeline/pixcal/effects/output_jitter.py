"""Levels of the outputs that read parts of the detector: each jumps from frame to frame."""

from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.outputs import MIN_FRAMES, Outputs, find_outputs, output_numbers
from pixcal.model.arrays import F32
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot


@dataclass(frozen=True)
class OutputJitter(Effect):
    """Each of several outputs, which read rectangles of pixels, has a level that jumps by itself.

    White noise from frame to frame, independent in each output. What all outputs have in common
    beyond that is `bias_drift`; a constant difference belongs to the bias.
    """

    name = "output_jitter"
    title = "level of each output that varies from frame to frame"
    acts_at = Stage.READOUT
    order = 4
    domains = ("noise", "time")
    strengths = ("output_rms",)
    left_because = "noise that is independent in each frame averages out"
    frames_needed = ("dark",)
    sources = (
        "Rauscher 2015, PASP 127, 1144: the outputs of an infrared array have noise of their own "
        "beside what they share",
    )

    output_rms: float = quantity(
        2.0, unit="e-", low=0, high=1e5, doc="white noise of an output's level, rms"
    )
    row_edges: tuple[int, ...] = quantity(
        (), unit="px", low=0, doc="first row of each output but the first, on the chip"
    )
    column_edges: tuple[int, ...] = quantity(
        (32,), unit="px", low=0, doc="first column of each output but the first, on the chip"
    )

    def readout(self, adu: F32, shot: Shot) -> F32:
        detector = shot.bench.detector
        count = (len(self.row_edges) + 1) * (len(self.column_edges) + 1)
        levels = self.output_rms * shot.rng(self.name).standard_normal(count)
        rows = np.arange(*shot.rows) + detector.origin[0]
        columns = np.arange(detector.shape[1]) + detector.origin[1]
        numbers = output_numbers(self.row_edges, self.column_edges, rows, columns)
        return adu + (levels / detector.gain_e_per_adu).astype(np.float32)[numbers]

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Edges at which the means of lines part anew in each frame, and levels between them."""
        found = _outputs(evidence)
        if found is None:
            return None
        rms = float(np.sqrt(max(found.variance, 0.0)))
        above = float(np.sqrt(max(found.variance, 0.0) + found.error))
        rows, columns = (
            tuple(int(edge) + first for edge in edges)
            for edges, first in zip(
                (found.row_edges, found.column_edges), evidence.origin, strict=True
            )
        )
        return Estimate(
            cls(rms, rows, columns),
            {"output_rms": above - rms},
            found.sigmas,
            "means of rows or columns beside an edge part anew in each frame without light",
            {"variance_e2": found.variance},
        )

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        """Significance of the clearest edge."""
        found = _outputs(evidence)
        return None if found is None else found.sigmas


def _outputs(evidence: Evidence) -> Outputs | None:
    """Outputs of the frames without light, edges in the window at hand."""
    stacks = [s for s in evidence.stacks if s.kind in ("bias", "dark") and len(s.adu) >= MIN_FRAMES]
    gain = np.float32(evidence.gain)
    return find_outputs([(s.adu - s.adu.mean(axis=0)) * gain for s in stacks], evidence.good)
