"""Changes of the series of the frames by a forward model: light, contrast, fringe vector.

A model of whole frames needs no simulated samples: its `ForwardModel.states` give the change of the
series for each draw. The part common to all draws is a known shape; their scatter is a part of the
covariance of the series' modes.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.fringe_motion import motion_of
from pixcal.estimators.frame_series.light import light_of
from pixcal.estimators.frame_series.series import FrameSeries
from pixcal.estimators.frame_series.spectral_line import Line
from pixcal.kernels.scene import FrameStates
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench
from pixcal.simulation.forward import STEPS, ForwardModel, field_of, numbers, with_numbers
from pixcal.simulation.recording import Recording
from pixcal.simulation.replica import set_recordings

DRAWS = 64
KEPT = 256  # parts cached for later simulations of the same frames
AROUND = 1.1  # ratio of frequencies over which the power of a change is nearly constant
UNIT = 1e-3  # trial size of a strength that is zero by default
# factor on parameters to test dependence on them, and on frequencies, in case an exposure is a
# whole number of periods
OTHER = 1 / np.sqrt(2)
LIGHT, MOTION = (0, 1), (2, 3)  # (B over its mean less one, log A/B), and (kx, ky)


@dataclass(frozen=True)
class AffectedSeries:
    """A series that a model may change."""

    series: FrameSeries = field(compare=False)
    channels: tuple[int, int]
    recording: Recording | None  # None: frames without light, which have no states
    frames: tuple[int, ...]  # indices of the series' values in the recording

    def changes(self, model: ForwardModel, draws: int) -> F64:
        """Change of the series by each draw (r, t, 2)."""
        changes = np.zeros((draws, len(self.series), 2))
        if self.recording is None:
            return changes
        bench, count = self.recording.bench, self.recording.count
        one, nothing = np.ones(count), np.zeros(count)
        still = FrameStates(nothing, one, one, nothing, nothing)
        for seed, out in enumerate(changes, start=1):
            s = model.states(still, replace(self.recording, bench=replace(bench, seed=seed)))
            contrast = np.log(np.maximum(s.amplitude, 1e-9) / np.maximum(s.level, 1e-9))
            every = np.stack([s.level - 1, contrast, s.dkx, s.dky], axis=1)
            out[:] = every[np.ix_(self.frames, self.channels)]
        return changes

    @lru_cache(maxsize=KEPT)  # noqa: B019
    def part(self, model: ForwardModel) -> F64:
        """Covariance (t - 1, 2, 2) of the modes by a random model; cached for equal frames."""
        modes = self.series.walk_modes.of(self.changes(model, DRAWS).transpose(1, 0, 2))
        modes -= modes.mean(axis=1, keepdims=True)
        power = np.einsum("kra,krb->kab", modes, modes) / (DRAWS - 1)
        order = np.arange(1, len(power) + 1)
        first = np.ceil(order / AROUND).astype(int) - 1
        last = np.minimum(np.floor(order * AROUND).astype(int), len(power))
        sums = np.concatenate([np.zeros((1, 2, 2)), np.cumsum(power, axis=0)])
        return np.asarray((sums[last] - sums[first]) / (last - first)[:, None, None])


@dataclass(frozen=True)
class Strength:
    """One number of a model's strengths, and how it changes the series."""

    model: ForwardModel  # of this strength alone
    key: str  # as errors name it
    unit: float  # the strength in `model`
    shape: str | None  # parameter, not a strength, that changes how it shows
    steady: bool  # whether all draws are equal: a shape instead of a part of a covariance
    power: float  # exponent of the strength to which the part is proportional

    @property
    def field(self) -> str:
        """Field that contains the number."""
        return field_of(self.key)

    @property
    def of_line(self) -> bool:
        """Whether it is the size of a line in the spectrum."""
        return self.shape is not None and unit_of(self.model, self.shape) == "Hz"

    def at(self, shape: float | None) -> ForwardModel:
        """The model with another value of the shape parameter."""
        if self.shape is None or shape is None:
            return self.model
        return replace(self.model, **{self.shape: shape})

    def value(self, size: float) -> float:
        """Value of the strength for a size of the part or shape."""
        if self.steady:
            return self.unit * size
        return float(self.unit * max(size, 0.0) ** (1 / self.power))


def strengths_of(
    every: Sequence[AffectedSeries], start: ForwardModel, leave: Sequence[str]
) -> list[Strength]:
    """Strengths of a model that change some series."""
    start, strengths = _off_resonance(start), []
    for key, value in numbers(start).items():
        field = field_of(key)
        if field in start.strengths and field not in leave:
            model = with_numbers(start.scaled(0.0), {key: value or UNIT})
            strengths += _strength(every, model, key, value or UNIT)
    return strengths


def _off_resonance(start: ForwardModel) -> ForwardModel:
    """The model with frequencies such that an exposure is no whole number of periods."""
    lines = [f.name for f in fields(start) if unit_of(start, f.name) == "Hz"]
    return replace(start, **{name: OTHER * getattr(start, name) for name in lines})


def _strength(
    every: Sequence[AffectedSeries], model: ForwardModel, key: str, unit: float
) -> list[Strength]:
    drawn = [w.changes(model, 2) for w in every]
    if not any(v.any() for v in drawn):
        return []
    shape = None
    for other in fields(model):
        value = getattr(model, other.name)
        if other.name not in model.strengths and isinstance(value, float):
            changed = replace(model, **{other.name: OTHER * value or 1.0})
            both = zip(drawn, every, strict=True)
            if any(not np.array_equal(v, w.changes(changed, 2)) for v, w in both):
                shape = other.name
                break
    steady, power = all(np.array_equal(*v) for v in drawn), 1.0
    if not steady:
        # With the same random numbers, two draws suffice.
        half = with_numbers(model, {key: unit / 2})
        less = [w.changes(half, 2) for w in every]
        whole, part = (sum(float(np.diff(v, axis=0).var()) for v in d) for d in (drawn, less))
        power = float(np.log2(whole / part))
    return [Strength(model, key, unit, shape, steady, power)]


class FrameChanges:
    """Series of an acquisition's frames, by their kind."""

    def __init__(self, evidence: Evidence) -> None:
        recordings = set_recordings(evidence)
        light, motion = light_of(evidence), motion_of(evidence)

        def affected(series: FrameSeries, channels: tuple[int, int]) -> AffectedSeries:
            recording = recordings[series.name]
            recording = replace(recording, bench=_rounded(recording.bench))
            return AffectedSeries(series, channels, recording, tuple(series.frame.tolist()))

        self.light, self.crossed = light, motion is not None and motion.crossed
        self._every = [[affected(s, MOTION) for s in motion.series]] if motion else []
        self._lines: list[Line | None] = [motion.line] if motion else []
        if light is not None:
            dark = [AffectedSeries(s, LIGHT, None, tuple(range(len(s)))) for s in light.dark]
            self._every.append([*(affected(s, LIGHT) for s in light.sets), *dark])
            self._lines.append(light.line)

    def series(self, start: ForwardModel) -> list[AffectedSeries]:
        """Series of the kinds that a strong model changes."""
        strong = _off_resonance(start)
        return [
            w
            for every in self._every
            if any(v.changes(strong, 1).any() for v in every)
            for w in every
        ]

    def line(self, of: Strength) -> Line | None:
        """Strongest line of the series that a strength changes."""
        for every, line in zip(self._every, self._lines, strict=True):
            if any(w.changes(of.model, 1).any() for w in every):
                return line
        return None


def _rounded(bench: Bench) -> Bench:
    """A bench that all simulations of an acquisition share; states need no electronics."""
    electronics: Any = {"gain_e_per_adu": 1.0, "read_noise_e": 0.0, "bias_adu": 0.0}
    sets = tuple(replace(s, peak_e=1.0) for s in bench.frames.fringes)
    return replace(
        bench,
        detector=replace(bench.detector, saturation_adu=None, **electronics),
        optics=replace(bench.optics, visibility=max(round(bench.optics.visibility, 2), 0.01)),
        frames=replace(bench.frames, fringes=sets),
    )


def unit_of(model: ForwardModel, name: str) -> str:
    """Unit of a parameter."""
    return str(next(f.metadata.get("unit", "") for f in fields(model) if f.name == name))


def acts_on_frames_alone(kind: type[ForwardModel]) -> bool:
    """Whether a model changes the states of frames, and nothing else."""
    return [s for s in STEPS if getattr(kind, s) is not getattr(ForwardModel, s)] == ["states"]
