"""Levels of the outputs that read parts of the detector: each varies from frame to frame."""

import zlib
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.outputs import MIN_FRAMES, Outputs, find_outputs, output_numbers
from pixcal.kernels.processes import brownian
from pixcal.kernels.synthesis import Stream, generator
from pixcal.model.arrays import F32, F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

HOUR_S = 3600.0
_NAME, _WALK = zlib.crc32(b"output_jitter"), 1000  # keys of the walk's random numbers


@dataclass(frozen=True)
class OutputJitter(Effect):
    """Each of several outputs, which read rectangles of pixels, has a level that varies by itself.

    White noise from frame to frame and a random walk, independent in each output. What all outputs
    have in common beyond that is `bias_drift`; a constant difference belongs to the bias.
    """

    name = "output_jitter"
    title = "level of each output that varies from frame to frame"
    acts_at = Stage.READOUT
    order = 4
    domains = ("noise", "time")
    strengths = ("output_rms", "walk_e_h")
    left_because = "noise that is independent in each frame averages out"
    frames_needed = ("dark",)
    remedy = "subtract the level of each output in each frame, from dark or overscan pixels"
    sources = (
        "Rauscher 2015, PASP 127, 1144: the outputs of an infrared array have noise of their own "
        "beside what they share",
    )

    output_rms: float = quantity(
        2.0, unit="e-", low=0, high=1e5, doc="white noise of an output's level, rms"
    )
    walk_e_h: float = quantity(
        0.0, unit="e-/h^0.5", low=0, high=1e6, doc="random walk of an output's level, rms after an "
        "hour"
    )  # fmt: skip
    row_edges: tuple[int, ...] = quantity(
        (), unit="px", low=0, doc="first row of each output but the first, on the chip"
    )
    column_edges: tuple[int, ...] = quantity(
        (32,), unit="px", low=0, doc="first column of each output but the first, on the chip"
    )

    def readout(self, adu: F32, shot: Shot) -> F32:
        detector = shot.bench.detector
        rows = np.arange(*shot.rows) + detector.origin[0]
        columns = np.arange(detector.shape[1]) + detector.origin[1]
        numbers = output_numbers(self.row_edges, self.column_edges, rows, columns)
        return adu + (self._levels(shot) / detector.gain_e_per_adu).astype(np.float32)[numbers]

    def _levels(self, shot: Shot) -> F64:
        """Levels (n,) of the outputs in a frame, e-."""
        count = (len(self.row_edges) + 1) * (len(self.column_edges) + 1)
        levels = self.output_rms * shot.rng(self.name).standard_normal(count)
        if self.walk_e_h:
            walks = [brownian(shot.time_s, _normals(shot.bench.seed, n)) for n in range(count)]
            levels += self.walk_e_h * np.array(walks) / np.sqrt(HOUR_S)
        return np.asarray(levels)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Edges at which the means of lines part anew in each frame, and levels between them."""
        found = _outputs(evidence)
        if found is None:
            return None
        size, error = np.array([found.size, found.error]) * [1.0, HOUR_S]
        rms = np.sqrt(np.maximum(size, 0))
        above = np.sqrt(np.maximum(size, 0) + error) - rms
        rows, columns = (
            tuple(int(edge) + first for edge in edges)
            for edges, first in zip(
                (found.row_edges, found.column_edges), evidence.origin, strict=True
            )
        )
        return Estimate(
            cls(float(rms[0]), min(float(rms[1]), 1e6), rows, columns),
            dict(zip(cls.strengths, above.tolist(), strict=True)),
            found.sigmas,
            "means of rows or columns beside an edge part anew in each frame without light",
            {"white_e2": found.size[0], "walk_e2_s": found.size[1]},
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
    rests = [(s.adu - s.adu.mean(axis=0)) * gain for s in stacks]
    return find_outputs(rests, [s.time_s for s in stacks], evidence.good)


def _normals(seed: int, output: int) -> Callable[[int, int], float]:
    """Random numbers of the walk of an output, the same in all frames."""

    def normal(level: int, place: int) -> float:
        own = generator(seed, Stream.EFFECT, _NAME, _WALK + level, place, output)
        return float(own.standard_normal())

    return normal
