"""Estimate parameters of an effect on whole frames from the series of the frames.

Its changes of light, contrast and fringe vector follow from its forward model (`frame_changes`):
steady strengths are shapes, random ones parts of the covariance. Sizes are restricted
maximum-likelihood estimates, jointly with nuisance effects on frames (`FrameBasis`) and noise from
two halves of the pixels. Other parameters are profiled; one in Hz is set to the strongest line.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import log_ndtr

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.profiled import Profiled, best_shape
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
from pixcal.simulation.forward import ForwardModel, with_numbers
from pixcal.simulation.frame_basis import ALIKE, FrameBasis, _changes_of
from pixcal.simulation.frame_changes import LIGHT, Strength, strengths_of


@dataclass(frozen=True)
class FrameFit:
    """Estimate of an effect from the series of the frames."""

    model: Any
    errors: dict[str, float]
    significance: float
    why: str
    sets_differ: float = -np.inf  # significance (sigma) of different steady strengths in each set


def fit_frames(
    kind: type[ForwardModel], evidence: Evidence, leave: Sequence[str] = ()
) -> FrameFit | None:
    """Parameters of a model of whole frames, except ``leave``; None without evidence."""
    changes = _changes_of(evidence)
    every = changes.series(kind())
    strengths = strengths_of(every, kind(), leave)
    if not strengths:
        return None
    plain = [s for s in strengths if not s.of_line]
    fit = _StrengthFit(kind(), FrameBasis(changes, every, plain))
    for field in dict.fromkeys(s.field for s in sorted(plain, key=lambda s: s.steady)):
        fit.take([s for s in plain if s.field == field])
    model, errors = fit.values()
    for field in dict.fromkeys(s.field for s in strengths if s.of_line):
        of_field = [s for s in strengths if s.field == field]
        line = changes.line(of_field[0])
        fit.chances[field] = 0.0 if line is None else line.log_chance
        if line is not None and line.significant:
            model, of_line = _with_line(model, of_field, line, fit.basis)
            errors |= of_line
    kinds = {w.channels is LIGHT for w in fit.basis.every}
    names = {True: "intensity and contrast", False: "the fringe vector"}
    varying = [name for light, name in names.items() if light in kinds]
    return FrameFit(
        model,
        errors,
        sigmas(log_chance_of_any(list(fit.chances.values()))),
        f"changes of {' and '.join(varying)} from frame to frame, the same in two halves of the "
        f"pixels{ALIKE if False in kinds and not changes.crossed else ''}",
        fit.sets_differ(),
    )


class _StrengthFit:
    """Fit of a model's strengths, added field by field."""

    def __init__(self, start: ForwardModel, basis: FrameBasis) -> None:
        self.start, self.basis = start, basis
        self.taken: list[Strength] = []
        self.chances: dict[str, float] = {}  # log p-value of each field if its strength is zero
        # for each field with a shape: the profile, and the number of strengths fitted with it
        self.profiles: dict[str, tuple[Profiled, int]] = {}
        self.shapes: dict[str, float] = {}

    def take(self, strengths: Sequence[Strength]) -> None:
        """Add a field; after others, one with its own shape only if it is significant."""
        field, before = strengths[0].field, self.basis.components(self.taken, self.shapes)
        profile = None if strengths[0].shape is None else self._profiled(strengths, before)
        if profile is None:
            after = self.basis.components([*self.taken, *strengths], self.shapes)
            at = sum(s.steady == strengths[0].steady for s in self.taken)
            chance = _chance(strengths, at, before, after)
        else:
            after = profile.components
            chance = log_chance(_likelihood(strengths, after, before), (len(strengths) + 2) // 2)
        self.chances[field] = chance
        if profile is not None and self.taken and not strengths[0].steady:
            # Jointly: the part of one that another absorbs still belongs to the effect.
            growth = after.likelihood - self.basis.components((), {}).likelihood
            self.chances["all"] = log_chance(growth, (len(self.taken) + len(strengths) + 2) // 2)
        if profile is None or not self.taken or sigmas(chance) > SIGNIFICANT:
            self.taken += strengths
            if profile is not None:
                self.profiles[field] = profile, len(self.taken)
                self.shapes[field] = profile.value

    def _profiled(self, strengths: Sequence[Strength], before: Components) -> Profiled:
        """Best value of a field's shape parameter; zero if that is its default and suffices."""
        field, steady, every = strengths[0].field, strengths[0].steady, [*self.taken, *strengths]

        def fit(value: float, start: Components | None, steps: int = MAX_STEPS) -> Components:
            return self.basis.components(every, {**self.shapes, field: value}, start, steps)

        start, trials = before if steady else None, self.basis.trials(strengths[0])
        profile = best_shape(fit, trials, steady, start)
        if getattr(self.start, strengths[0].shape or "") == 0.0:
            plain = fit(0.0, None)
            if sigmas(log_chance(_likelihood(strengths, profile.components, plain))) < SIGNIFICANT:
                return Profiled(0.0, self.basis.step_s, plain, ())
        return profile

    def values(self) -> tuple[ForwardModel, dict[str, float]]:
        """The model with the fitted sizes, and errors by parameter."""
        fit = self.basis.components(self.taken, self.shapes)
        random = [s for s in self.taken if not s.steady]
        spread = fit.shape_covariance(self.basis.slow(random, self.shapes))
        model, errors = self.start.scaled(0.0), {}
        for field, (profile, _) in self.profiles.items():
            name = next(s.shape for s in self.taken if s.field == field) or ""
            model, errors[name] = with_numbers(model, {name: profile.value}), profile.error
        for number, s in enumerate(self.taken):
            n = self._place(s)
            if s.steady:
                error = abs(s.unit) * float(np.sqrt(spread[n, n]))
            else:
                size = max(float(fit.size[n]), 0.0)
                rough = size * self.basis.rough(s, self.shapes.get(s.field), fit)
                more = size + float(np.hypot(fit.above(n), rough))
                less = size - float(np.hypot(np.sqrt(fit.covariance[n, n]), rough))
                here = s.value(size)
                error = max(s.value(more) - here, here - s.value(max(less, 0.0)))
            # Errors from the shape parameters with which it was fitted.
            owed = [
                profile.slope([self._value(s, side) for side in profile.sides])
                for profile, fitted in self.profiles.values()
                if number < fitted
            ]
            errors[s.key] = float(np.hypot(error, np.linalg.norm(owed)))
            model = with_numbers(model, {s.key: self._value(s, fit)})
        return model, {key: error for key, error in errors.items() if error > 0}

    def sets_differ(self) -> float:
        """Significance (sigma) of different steady strengths in the sets."""
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

    def _value(self, of: Strength, fit: Components) -> float:
        sizes = fit.beta if of.steady else fit.size
        return of.value(float(sizes[self._place(of)]))


def _with_line(
    model: ForwardModel, strengths: Sequence[Strength], line: Line, basis: FrameBasis
) -> tuple[ForwardModel, dict[str, float]]:
    """The model with a line, with strengths set by its amplitude in the series."""
    name = strengths[0].shape or ""
    model, errors = with_numbers(model, {name: line.hz}), {name: line.hz_error}
    for s in strengths:
        # rms over draws of a random phase, in the channel of the line.
        drawn = [w.changes(s.at(line.hz), 8) for w in basis.every if w.recording is not None]
        rms = np.sqrt(np.mean([(v**2).mean(axis=(0, 1)) for v in drawn], axis=0))
        channel = int(np.argmax(rms * (line.amplitude_error > 0)))
        per = s.unit / max(float(np.sqrt(2) * rms[channel]), 1e-300)
        model = with_numbers(model, {s.key: per * float(line.amplitude[channel])})
        errors[s.key] = per * float(line.amplitude_error[channel])
    return model, errors


def _likelihood(strengths: Sequence[Strength], one: Components, other: Components) -> float:
    """Rise of the log-likelihood; not restricted if shapes differ."""
    if strengths[0].steady:
        return one.profile - other.profile
    return one.likelihood - other.likelihood


def _chance(strengths: Sequence[Strength], at: int, before: Components, after: Components) -> float:
    """Log p-value of a field's sizes, from index ``at`` on, if they are zero."""
    here, count = slice(at, at + len(strengths)), len(strengths)
    if strengths[0].steady:
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
