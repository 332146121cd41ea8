"""Estimate parameters of an effect on whole frames from the series of the frames.

Its changes of light, contrast and fringe vector follow from its forward model (`frame_changes`):
steady strengths are shapes, random ones parts of the covariance. Sizes are restricted
maximum-likelihood estimates, jointly with nuisance effects on frames (`FrameBasis`) and noise from
two halves of the pixels. Other parameters are profiled; one in Hz is set to the strongest line.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.special import log_ndtr

from pixcal.estimators.diagnosis.evidence import Evidence, cached_on_evidence
from pixcal.estimators.frame_series.fringe_motion import motion_part, ramps
from pixcal.estimators.frame_series.light import LIGHT_PARTS
from pixcal.estimators.frame_series.profiled import Profiled, best_shape
from pixcal.estimators.frame_series.series import assemble
from pixcal.estimators.frame_series.spectral_line import Line
from pixcal.estimators.frame_series.variance_components import (
    MAX_STEPS,
    Components,
    estimate_components,
    joint_log_chance,
    log_chance,
    log_chance_of_any,
    sigmas,
    signed_sigmas,
)
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64
from pixcal.simulation.forward import ForwardModel, with_numbers
from pixcal.simulation.frame_changes import (
    DRAWS,
    LIGHT,
    AffectedSeries,
    FrameChanges,
    Strength,
    strengths_of,
    unit_of,
)

MOTION_PARTS = ("jitter_x", "jitter_y", "walk_x", "walk_y", "walk_k")
SAME = 0.8  # share of a nuisance explained by the effect above which it is part of the effect
# shortest time constant tried (frames), for random and for steady changes; number of trials
FASTEST, QUICKEST, TRIALS = 0.3, 3.0, 9
SLOW = 0.1  # share of the modes, the lowest, that hold most of a slow change
ROUGH = 0.5  # relative excess scatter of draws above which they are not normal
ALIKE = (
    "; with fringes of one direction, motion of the fibres along the fringe axis and drift of the "
    "wavelength look the same"
)


class FrameBasis:
    """Parts and shapes of strengths and nuisances in the series."""

    def __init__(
        self, changes: FrameChanges, every: Sequence[AffectedSeries], strengths: Sequence[Strength]
    ) -> None:
        self.every = every
        self._made: dict[tuple[Strength, float | None], list[F64]] = {}
        self._number = {id(w.series): n for n, w in enumerate(every)}
        own = {
            steady: [v for s in strengths if s.steady == steady for v in self._extremes(s)]
            for steady in (False, True)
        }
        roots = [np.diag(np.diag(w.series.noise) ** -0.5) for w in every]

        def whole(values: Sequence[F64], steady: bool) -> F64:
            """All series as a vector, in units of the noise."""
            if steady:
                scaled = [(v - v.mean(axis=0)) @ r for v, r in zip(values, roots, strict=True)]
            else:
                scaled = [r @ v @ r for v, r in zip(values, roots, strict=True)]
            return np.concatenate([v.ravel() for v in scaled])

        def is_own(values: Sequence[F64], steady: bool) -> bool:
            vector = rest = whole(values, steady)
            if own[steady]:
                basis = np.stack([whole(v, steady) for v in own[steady]], axis=1)
                basis /= np.maximum(np.linalg.norm(basis, axis=0), 1e-300)
                rest = vector - basis @ np.linalg.lstsq(basis, vector, rcond=1e-6)[0]
            return bool(rest @ rest <= (1 - SAME) * (vector @ vector))

        parts = {name: _nuisance_parts(changes, name, every) for name in _names(changes, every)}
        self._nuisances = {n: part for n, part in parts.items() if not is_own(part, False)}
        shapes = [
            ramps(w.series, colour=changes.crossed) * (w.channels is not LIGHT) for w in every
        ]
        kept = [
            q for q in range(shapes[0].shape[2]) if not is_own([v[..., q] for v in shapes], True)
        ]
        self._shapes = [v[..., kept] for v in shapes]

    def trials(self, of: Strength) -> F64:
        """Values of a strength's shape parameter to try."""
        assert of.shape is not None
        series = [w.series for w in self.every if w.recording is not None]
        step, longest = self.step_s, max(float(np.ptp(s.time_s)) for s in series)
        first, last = (QUICKEST, 1.0) if of.steady else (FASTEST, 2.0)
        times = np.geomspace(first * step, last * longest, TRIALS)
        unit, value = unit_of(of.model, of.shape), getattr(of.model, of.shape)
        if unit in ("s", "1/h"):
            return np.asarray(times if unit == "s" else 3600 / times[::-1])
        return np.asarray((value or 1.0) * np.geomspace(1 / 9, 9, TRIALS))

    @property
    def step_s(self) -> float:
        """Time between frames, s."""
        return min(w.series.step_s for w in self.every if w.recording is not None)

    def own(self, of: Strength, shape: float | None) -> list[F64]:
        """Parts or shapes of a strength in all series."""
        if (of, shape) not in self._made:
            model = of.at(shape)
            self._made[of, shape] = [
                w.changes(model, 1)[0] if of.steady else w.part(model) for w in self.every
            ]
        return self._made[of, shape]

    def _extremes(self, of: Strength) -> list[list[F64]]:
        ends = [] if of.shape is None else [float(v) for v in self.trials(of)[[0, -1]]]
        return [self.own(of, shape) for shape in (None, *ends)]

    def components(
        self,
        strengths: Sequence[Strength],
        shapes: Mapping[str, float],
        start: Components | None = None,
        steps: int = MAX_STEPS,
        *,
        by_set: bool = False,
    ) -> Components:
        """Sizes of strengths: random ones first in ``size``, steady ones first in ``beta``.

        ``shapes``: shape parameters by the field of the strength. With ``by_set``, the differences
        of each later set from the first follow in ``beta``.
        """
        by_strength = [(s.steady, self.own(s, shapes.get(s.field))) for s in strengths]
        parts = [*(v for steady, v in by_strength if not steady), *self._nuisances.values()]
        known = [v for steady, v in by_strength if steady]
        if by_set:
            later = [n for n, w in enumerate(self.every) if w.recording is not None][1:]
            known += [
                [w * (n == one) for n, w in enumerate(v)] for v in list(known) for one in later
            ]
        modes = assemble(
            [w.series for w in self.every],
            lambda s: np.stack([part[self._number[id(s)]] for part in parts]),
            lambda s: np.concatenate(
                [
                    *(v[self._number[id(s)]][..., None] for v in known),
                    self._shapes[self._number[id(s)]],
                ],
                axis=2,
            ),
        )
        if start is not None and len(start.size) != len(modes.start):
            start = None
        return estimate_components(modes, (), start, steps)

    def slow(self, random: Sequence[Strength], shapes: Mapping[str, float]) -> list[int]:
        """Indices of the parts with few modes, whose sizes are poorly determined."""
        indices = []
        parts = [*(self.own(s, shapes.get(s.field)) for s in random), *self._nuisances.values()]
        for n, part in enumerate(parts):
            power = [np.einsum("kaa->k", v) for v in part]
            low = sum(float(p[: max(int(SLOW * len(p)), 1)].sum()) for p in power)
            if low > sum(float(p.sum()) for p in power) / 2:
                indices.append(n)
        return indices

    def rough(self, of: Strength, shape: float | None, fit: Components) -> float:
        """Relative scatter of a strength's size in excess of normal draws."""
        normal = square = seen = 0.0
        sizes = np.maximum(fit.size, 0.0)
        covariance = (sizes @ fit.modes.flat).reshape(fit.modes.parts.shape[1:])
        at = 0
        for w, part in zip(self.every, self.own(of, shape), strict=True):
            weight = np.linalg.inv(covariance[at : at + len(part)])
            weighed = weight @ part @ weight
            both = weighed @ part
            modes = w.series.walk_modes.of(w.changes(of.at(shape), DRAWS).transpose(1, 0, 2))
            seen += float(np.einsum("kra,kab,krb->r", modes, weighed, modes).var(ddof=1))
            normal += 2 * float(np.einsum("kab,kba->", both, both))
            square += float(np.einsum("kaa->", both))
            at += 2 * len(part)
        more = seen - normal
        return float(np.sqrt(more)) / square if more > ROUGH * normal else 0.0


_changes_of = cached_on_evidence(FrameChanges)


def _names(changes: FrameChanges, every: Sequence[AffectedSeries]) -> list[str]:
    kinds = {w.channels is LIGHT for w in every}
    motion = MOTION_PARTS if changes.crossed else MOTION_PARTS[:-1]
    return [*(LIGHT_PARTS if True in kinds else ()), *(motion if False in kinds else ())]


def _nuisance_parts(changes: FrameChanges, name: str, every: Sequence[AffectedSeries]) -> list[F64]:
    """Covariance (t - 1, 2, 2) of the modes of each series by a nuisance."""
    parts = []
    for w in every:
        if (w.channels is LIGHT) != (name in LIGHT_PARTS):
            parts.append(np.zeros((len(w.series) - 1, 2, 2)))
        elif w.channels is LIGHT and changes.light is not None:
            parts.append(changes.light.part(name, w.series))
        else:
            parts.append(motion_part(name, w.series))
    return parts


@dataclass(frozen=True)
class FrameFit:
    """Estimate of an effect from the series of the frames."""

    model: Any
    errors: dict[str, float]
    significance: float
    why: str
    # significance (sigma) of different steady strengths in each set
    sets_differ: float = -np.inf


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
    fit = _Fit(kind(), FrameBasis(changes, every, plain))
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


class _Fit:
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
