"""Measured light of the flats: lamps are never quite steady, and not part of the detector."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from pixcal.estimators.detector.flat_ladder import LAMP, flicker, ladder, rise_of, straight_line
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.model.arrays import F64
from pixcal.model.bench import SimulatedDetector
from pixcal.simulation.effect import Effect
from pixcal.simulation.recording import Recording
from pixcal.stages.diagnose.fitted_set import levels_before

SERIES = 8  # least frames of a series to use the measured light of each; otherwise it is drawn

_FLICKER, _RISE = 103, 104  # keys of random numbers


@dataclass(frozen=True)
class FlatLight:
    """Light of the flats."""

    # flicker, wander: relative rms from frame to frame, and of levels about a straight line in
    # exposure time
    flicker: float = 0.0
    wander: float = 0.0
    # relative rise of the light from frame to frame of each level, and its error
    rise: tuple[float, float] = (0.0, 0.0)
    # whether all levels are of one lamp; otherwise the measured levels are used
    one_lamp: bool = False
    off: frozenset[float] = frozenset()  # exposure times (s) of levels from another lamp
    freedom: float = math.inf  # degrees of freedom of ``flicker``
    # by the number of a recording, the light (t,) of each frame over the mean; NaN for frames that
    # are drawn: the first, which may lack what stayed behind, and those not looked at
    frames: Mapping[int, F64] = field(default_factory=dict)
    # for the same recordings, the light of the first frame that the next ones let expect, and its
    # scatter over the flicker
    firsts: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, evidence: Sequence[Evidence], light: Mapping[int, F64]) -> "FlatLight":
        """From parts of the frames; ``light`` of frames (t,) by recording, NaN if not measured."""
        found = [ladder(one) for one in evidence]
        frames, firsts = {}, {}
        for number, own in light.items():
            if np.isfinite(own).sum() >= SERIES:
                frames[number] = own / np.nanmean(own)
                frames[number][0] = np.nan
                firsts[number] = _first(frames[number])
        flickers, freedoms = zip(*map(flicker, evidence), strict=True)
        return cls(
            float(np.mean(flickers)),
            float(np.mean([LAMP if one is None else one.wander for one in found])),
            # From all frames of a level: a part may have only two.
            rise_of(list(light.values())),
            all(one is not None for one in found),
            frozenset(float(t) for one in found if one is not None for t in one.off),
            min(freedoms),
            frames,
            firsts,
        )

    def factor(self, recording: Recording, frame: int) -> float:
        """Light of a frame over that of its recording."""
        level = 1.0
        if self.one_lamp and recording.exptime_s not in self.off:
            level += self.wander * float(recording.rng("lamp").standard_normal())
        known = self.frames.get(recording.number)
        if known is not None and np.isfinite(known[frame]):
            return level * float(known[frame])
        flicker = self._flicker(recording.bench.seed)
        if frame == 0 and recording.number in self.firsts:
            expected, scatter = self.firsts[recording.number]
            drawn = float(recording.rng("lamp", frame).standard_normal())
            return level * (expected + scatter * flicker * drawn)
        flicker *= float(recording.rng("lamp", frame).standard_normal())
        rise = self._rise(recording.bench.seed) * (frame - (recording.count - 1) / 2)
        return level * (1 + flicker + rise)

    def _rise(self, seed: int) -> float:
        """Rise of the light in a simulation, drawn within its error."""
        rise, error = self.rise
        return float(rise + error * np.random.default_rng([seed, _RISE]).standard_normal())

    def _flicker(self, seed: int) -> float:
        """Flicker in a simulation, drawn within its error."""
        if math.isinf(self.freedom):
            return self.flicker
        square = np.random.default_rng([seed, _FLICKER]).chisquare(self.freedom) / self.freedom
        return self.flicker / math.sqrt(square)

    def levels(
        self, recordings: Sequence[Recording], effects: Sequence[Effect], d: SimulatedDetector
    ) -> dict[int, float]:
        """Electrons of each flat, by number, before effects; linear in time if of one lamp."""
        flats = [r for r in recordings if r.kind == "flat" and r.electrons > 0]
        if not flats:
            return {}
        times = np.array([r.exptime_s for r in flats])
        levels = levels_before(np.array([r.electrons for r in flats]), effects)
        if self.one_lamp:
            below = levels < (d.top_adu - d.bias_adu) * d.gain_e_per_adu
            own = np.isin(times, list(self.off), invert=True)
            below = below & own if (below & own).any() else own
            levels = np.where(own, straight_line(times[below], levels[below], times), levels)
        return {r.number: float(level) for r, level in zip(flats, levels, strict=True)}


def _first(light: F64) -> tuple[float, float]:
    """Light of frame 0 from a parabola through the next frames (t,), and its relative scatter."""
    time = np.flatnonzero(np.isfinite(light))[: SERIES - 1]
    design = np.vander(time, 3, increasing=True).astype(float)
    value = float(np.linalg.lstsq(design, light[time])[0][0])
    return value, float(np.sqrt(1 + np.linalg.inv(design.T @ design)[0, 0]))
