"""Parameters of an effect that acts on whole frames, from the series of the frames.

What the effect does to light, contrast and fringe vector follows from its forward model
(`frame_changes`): steady strengths are shapes, random ones parts of the covariance. Their sizes are
those of restricted maximum likelihood beside all else that moves frames (`frame_basis`) and the
noise that two halves of the pixels show. A parameter that is no strength is profiled; one in Hz is
that of the strongest line of the spectrum.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import log_ndtr

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.profiled import HALVINGS, Profiled, best_shape
from pixcal.estimators.frame_series.spectral_line import Line
from pixcal.estimators.frame_series.variance_components import (
    MAX_STEPS,
    Components,
    joint_log_chance,
    log_chance,
    log_chance_of_any,
    sigmas,
    signed_sigmas,
)
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.simulation.forward import ForwardModel
from pixcal.simulation.frame_basis import FrameBasis
from pixcal.simulation.frame_changes import LIGHT, FrameChanges, Strength, strengths_of
from pixcal.simulation.numbers import with_numbers

ALIKE = (
    "; with fringes of one direction, motion of the fibres along the fringe axis and drift of the "
    "wavelength look the same"
)


@dataclass(frozen=True)
class FrameFit:
    """What the series of the frames let know of an effect."""

    model: Any
    errors: dict[str, float]
    significance: float
    why: str
    details: dict[str, float]  # standard deviations by which each field is there
    # standard deviations by which each set has strengths of its own, of those that are steady
    sets_differ: float = -np.inf


def fit_frames(
    kind: type[ForwardModel], evidence: Evidence, leave: Sequence[str] = ()
) -> FrameFit | None:
    """Parameters of a model of whole frames, but strengths to ``leave``; None without evidence."""
    found = _taken(kind, evidence, leave)
    if found is None:
        return None
    fit, changes = found.fit, found.changes
    model, errors = fit.values()
    for own, line in found.lines:
        if line is not None and line.sure:
            model, of_line = _swung(model, own, line, fit.basis)
            errors |= of_line
    kinds = {w.channels is LIGHT for w in fit.basis.every}
    told = ["intensity and contrast"] * (True in kinds) + ["the fringe vector"] * (False in kinds)
    return FrameFit(
        model,
        errors,
        found.significance,
        f"changes of {' and '.join(told)} from frame to frame, the same in two halves of the "
        f"pixels{ALIKE if False in kinds and not changes.crossed else ''}",
        {f"{field}_sigmas": sigmas(chance) for field, chance in found.chances.items()},
        fit.sets_differ(),
    )


def detect_in_frames(
    kind: type[ForwardModel], evidence: Evidence, leave: Sequence[str] = ()
) -> float | None:
    """Significance that `fit_frames` gives, without sizes and errors."""
    found = _taken(kind, evidence, leave, halvings=1)
    return None if found is None else found.significance


@dataclass(frozen=True)
class _Taken:
    """Strengths of a model as the series of the frames show them."""

    fit: "_Fit"
    changes: FrameChanges
    lines: list[tuple[list[Strength], Line | None]]  # strengths of each line of the spectrum

    @property
    def chances(self) -> dict[str, float]:
        """Logarithm of the chance of each field where there is none of it."""
        of_lines = {
            own[0].field: 0.0 if line is None else line.log_chance for own, line in self.lines
        }
        return self.fit.chances | of_lines

    @property
    def significance(self) -> float:
        """Of all fields, sigma."""
        return sigmas(log_chance_of_any(list(self.chances.values())))


def _taken(
    kind: type[ForwardModel], evidence: Evidence, leave: Sequence[str], halvings: int = HALVINGS
) -> _Taken | None:
    changes = evidence.once("changes of frames", make=lambda: FrameChanges(evidence))
    every = changes.series(kind())
    strengths = strengths_of(every, kind(), leave)
    if not strengths:
        return None
    plain = [s for s in strengths if not s.of_line]
    fit = _Fit(kind(), FrameBasis(changes, every, plain), halvings)
    for field in dict.fromkeys(s.field for s in sorted(plain, key=lambda s: s.steady)):
        fit.take([s for s in plain if s.field == field])
    fields = dict.fromkeys(s.field for s in strengths if s.of_line)
    lines = [[s for s in strengths if s.field == field] for field in fields]
    return _Taken(fit, changes, [(own, changes.line(own[0])) for own in lines])


class _Fit:
    """Strengths of a model, taken in field by field."""

    def __init__(self, start: ForwardModel, basis: FrameBasis, halvings: int) -> None:
        self.start, self.basis, self._halvings = start, basis, halvings
        self.taken: list[Strength] = []
        self.chances: dict[str, float] = {}  # logarithm, of each field where there is none of it
        # of each field with a shape: the profile, and how many strengths were fitted with it
        self.profiles: dict[str, tuple[Profiled, int]] = {}
        self.shapes: dict[str, float] = {}

    def take(self, own: Sequence[Strength]) -> None:
        """Take in a field; beside others, one of a shape of its own only where it is sure."""
        field, before = own[0].field, self.basis.components(self.taken, self.shapes)
        profile = None if own[0].shape is None else self._profiled(own, before)
        if profile is None:
            after = self.basis.components([*self.taken, *own], self.shapes)
            at = sum(s.steady == own[0].steady for s in self.taken)
            chance = _chance(own, at, before, after)
        else:
            after = profile.found
            chance = log_chance(_likelihood(own, after, before), (len(own) + 2) // 2)
        self.chances[field] = chance
        if profile is not None and self.taken and not own[0].steady:
            # Together: what one of them takes of another is the effect's all the same.
            growth = after.likelihood - self.basis.components((), {}).likelihood
            self.chances["all"] = log_chance(growth, (len(self.taken) + len(own) + 2) // 2)
        if profile is None or not self.taken or sigmas(chance) > SIGNIFICANT:
            self.taken += own
            if profile is not None:
                self.profiles[field] = profile, len(self.taken)
                self.shapes[field] = profile.value

    def _profiled(self, own: Sequence[Strength], before: Components) -> Profiled:
        """Best value of a field's shape parameter; zero where that is its default and does."""
        field, steady, every = own[0].field, own[0].steady, [*self.taken, *own]

        def fit(value: float, start: Components | None, steps: int = MAX_STEPS) -> Components:
            return self.basis.components(every, {**self.shapes, field: value}, start, steps)

        start, trials = before if steady else None, self.basis.trials(own[0])
        found = best_shape(fit, trials, steady, start, self._halvings)
        if getattr(self.start, own[0].shape or "") == 0.0:
            plain = fit(0.0, None)
            if sigmas(log_chance(_likelihood(own, found.found, plain))) < SIGNIFICANT:
                return Profiled(0.0, self.basis.step_s, plain, ())
        return found

    def values(self) -> tuple[ForwardModel, dict[str, float]]:
        """The model of the sizes found, and errors by parameter."""
        found = self.basis.components(self.taken, self.shapes)
        random = [s for s in self.taken if not s.steady]
        spread = found.shape_covariance(self.basis.slow(random, self.shapes))
        model, errors = self.start.scaled(0.0), {}
        for field, (profile, _) in self.profiles.items():
            name = next(s.shape for s in self.taken if s.field == field) or ""
            model, errors[name] = with_numbers(model, {name: profile.value}), profile.error
        for number, s in enumerate(self.taken):
            n = self._place(s)
            if s.steady:
                error = abs(s.unit) * float(np.sqrt(spread[n, n]))
            else:
                size = max(float(found.size[n]), 0.0)
                rough = size * self.basis.rough(s, self.shapes.get(s.field), found)
                error = s.value(size + float(np.hypot(found.above(n), rough))) - s.value(size)
            # What it owes to shape parameters that it was found with.
            owed = [
                profile.slope([self._value(s, side) for side in profile.sides])
                for profile, fitted in self.profiles.values()
                if number < fitted
            ]
            errors[s.key] = float(np.hypot(error, np.linalg.norm(owed)))
            model = with_numbers(model, {s.key: self._value(s, found)})
        return model, {key: error for key, error in errors.items() if error > 0}

    def sets_differ(self) -> float:
        """Standard deviations by which sets have steady strengths of their own."""
        steady = sum(s.steady for s in self.taken)
        sets = sum(w.recording is not None for w in self.basis.every)
        if not steady or sets < 2:
            return -np.inf
        together, apart = (
            self.basis.components(self.taken, self.shapes, by_set=own) for own in (False, True)
        )
        more = steady * (sets - 1)
        return sigmas(log_chance(apart.profile - together.profile, (more + 1) // 2))

    def _place(self, of: Strength) -> int:
        return [s for s in self.taken if s.steady == of.steady].index(of)

    def _value(self, of: Strength, found: Components) -> float:
        sizes = found.beta if of.steady else found.size
        return of.value(float(sizes[self._place(of)]))


def _swung(
    model: ForwardModel, own: Sequence[Strength], line: Line, basis: FrameBasis
) -> tuple[ForwardModel, dict[str, float]]:
    """The model with a line, whose strengths are those of its amplitude in the series."""
    name = own[0].shape or ""
    model, errors = with_numbers(model, {name: line.hz}), {name: line.hz_error}
    for s in own:
        # rms over draws of a random phase, in the channel that the line is in.
        drawn = [w.changes(s.at(line.hz), 8) for w in basis.every if w.recording is not None]
        rms = np.sqrt(np.mean([(v**2).mean(axis=(0, 1)) for v in drawn], axis=0))
        channel = int(np.argmax(rms * (line.amplitude_error > 0)))
        per = s.unit / max(float(np.sqrt(2) * rms[channel]), 1e-300)
        model = with_numbers(model, {s.key: per * float(line.amplitude[channel])})
        errors[s.key] = per * float(line.amplitude_error[channel])
    return model, errors


def _likelihood(own: Sequence[Strength], one: Components, other: Components) -> float:
    """Growth of the logarithm, not restricted where shapes differ."""
    if own[0].steady:
        return one.profile - other.profile
    return one.likelihood - other.likelihood


def _chance(own: Sequence[Strength], at: int, before: Components, after: Components) -> float:
    """Logarithm of the chance of a field's sizes, from a place on, where there is nothing of it."""
    here, count = slice(at, at + len(own)), len(own)
    if own[0].steady:
        beta, spread = after.beta[here], after.beta_covariance[here, here]
        if count == 1:
            return float(np.log(2) + log_ndtr(-abs(beta[0]) / np.sqrt(spread[0, 0])))
        return log_chance(float(beta @ np.linalg.pinv(spread) @ beta) / 2, (count + 1) // 2)
    growth = after.likelihood - before.likelihood
    if count == 1:
        return float(log_ndtr(-signed_sigmas(growth, float(after.size[at]))))
    if count == 2:
        return joint_log_chance(after, before, after.size[here])
    return log_chance(growth, (count + 1) // 2)
