"""Charge of earlier exposures that dark frames after light release: its share and decay."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import NamedTuple

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, Stack, soon_after
from pixcal.kernels.sample_sums import frame_means
from pixcal.kernels.separable import SeparableFit, fit_terms
from pixcal.model.arrays import F64, Indices

_SURE = 5.0  # standard errors of the share
_PARAMETERS = 2  # share and decay of a kind of traps
_SHORTEST, LONGEST = 0.1, 15.0  # decay, in frames or median periods
_DECAYS = 12  # that are tried before the best is refined
_OF_MODEL = 2e-3  # least relative error: the light of a series is not quite steady
_ROUNDS = 4  # of the fit, each with the light that the last one gives
_DRIFTS = 40  # time constants of a drift that are tried before the best is refined
_SLOWEST, _FASTEST = 10.0, 1e-3  # of them, in durations of the session

# series of frames, and the mean above bias of each frame, e-
Levels = Sequence[tuple[Stack, F64]]
# places in the sequence of some frames of a series, their means (e-), and weight
Series = Sequence[tuple[Indices, F64, float]]


@dataclass(frozen=True)
class Persistence:
    """Exponential release of a share of the charge of each frame."""

    share: float
    share_error: float
    decay: float  # in which the release falls by a factor e, s or frames
    decay_error: float
    in_seconds: bool
    # of a second kind of traps: its part of the share, and its longer decay
    slow_part: float = 0.0
    slow_part_error: float = 0.0
    slow: float = 0.0
    slow_error: float = 0.0

    @classmethod
    def of(cls, fit: SeparableFit, variance: float, in_seconds: bool) -> "Persistence":
        """From shares and logarithms of decays; ``variance``: of a frame's mean, e-²."""
        share, decays = float(fit.sizes.sum()), np.exp(fit.shapes)
        of_decays = np.hypot(fit.errors(variance)[1], _OF_MODEL) * decays
        covariance = variance * fit.covariance[: len(decays), : len(decays)]

        def error(value: float, slope: F64) -> float:
            return float(np.hypot(np.sqrt(slope @ covariance @ slope), _OF_MODEL * value))

        of_share = error(share, np.ones(len(decays)))
        lag = cls(share, of_share, float(decays[0]), float(of_decays[0]), in_seconds)
        if len(decays) == 1:
            return lag
        part = float(fit.sizes[1]) / share
        of_part = error(part, np.array([-part, 1 - part]) / share)
        lag = replace(lag, slow_part=part, slow_part_error=of_part)
        return replace(lag, slow=float(decays[1]), slow_error=float(of_decays[1]))


@dataclass(frozen=True)
class _Sequence:
    """All frames without gaps, in order of time."""

    period: F64  # (t,) from the start of the frame until it is read, s
    pause: F64  # (t,) from then until the next frame starts, s
    series: Indices  # (t,) number of each one's series
    places: tuple[tuple[Stack, Indices, F64], ...]  # measured frames of each series, and means, e-

    def released(self, charge: F64, decay: float, in_seconds: bool) -> F64:
        """Charge (t,) released in each frame, for a share of one."""
        spans = self.period / decay if in_seconds else np.full(len(self.period), 1 / decay)
        after = np.exp(-self.pause / decay) if in_seconds else np.ones(len(spans))
        released, held = [], 0.0
        for own, kept, left in zip(
            charge.tolist(), np.exp(-spans).tolist(), after.tolist(), strict=True
        ):
            released.append((1 - kept) * held)
            held = (kept * held + own) * left
        return np.array(released)

    def late(self, lag: Persistence) -> F64:
        """Charge (t,) released in each frame, e-."""
        kinds = [(1 - lag.slow_part, lag.decay), (lag.slow_part, lag.slow)][: 1 + (lag.slow > 0)]
        late = np.zeros(len(self.period))
        for _ in range(_ROUNDS):
            charge = self.light(late, lag.share)
            each = [part * self.released(charge, decay, lag.in_seconds) for part, decay in kinds]
            late = lag.share * np.sum(each, axis=0)
        return late

    def light(self, late: F64, share: float) -> F64:
        """Light (t,), steady in each series, of frames that lose a share and gain ``late``, e-."""
        light = [float((means - late[at]).mean()) / (1 - share) for _, at, means in self.places]
        return np.maximum(light, 0.0)[self.series]


class Released(NamedTuple):
    """Charge of earlier light in frames without fringes."""

    lag: Persistence
    late: list[F64]  # mean charge released in the frames of each series, e-
    sure: bool  # whether it is distinguished from a drift of the level without light


def persistence(evidence: Evidence) -> Persistence | None:
    """As `released_late`, from pixels of a part of the window that are valid in all frames."""
    used = evidence.good.copy()
    for stack in evidence.stacks:
        used &= np.isfinite(stack.adu).all(axis=0)
    if not used.any():
        return None
    bias = evidence.bias[used].mean()
    levels = [(s, (frame_means(s.adu, used) - bias) * evidence.gain) for s in evidence.stacks]
    found = released_late(levels, evidence.read_noise**2 / used.sum())
    return None if found is None else found.lag


def released_late(levels: Levels, least: float) -> Released | None:
    """Fit to the level of dark frames soon after light; None if nothing significant is released.

    The flats decide whether the release follows time or the number of frames. ``least``: smallest
    variance of a frame's mean, e-².
    """
    sequence = _sequence([one for one in levels if _placed(one[0])])
    if sequence is None:
        return None
    lit = [(at, m, 1 / m.mean()) for s, at, m in sequence.places if s.kind == "flat" and m.all()]
    flats = [s.start_s + s.time_s for s, _ in levels if s.kind == "flat"]
    light = np.concatenate([*flats, np.zeros(0)])
    dark = [
        (at, means, 1.0)
        for s, at, means in sequence.places
        if s.kind != "flat" and soon_after(light, s)
    ]
    kinds = ((1, False), (1, True), (2, True))
    fits = [fit for kind in kinds if (fit := _fit(sequence, dark, *kind, least)) is not None]

    def misfit(fit: _LagFit) -> float:
        """Negative log-likelihood, twice, for noise of unknown size in darks and in flats."""
        rest = _centred(lit) - _centred(lit, sequence.late(fit.lag))
        of_flats = (len(rest) - len(lit)) * np.log(max(float(rest @ rest), 1e-12))
        return float(fit.freedom * np.log(fit.left) + of_flats + _SURE**2 * (fit.lag.slow > 0))

    lag = min(fits, key=misfit).lag if fits else None
    if lag is None or lag.share <= _SURE * lag.share_error:
        return None
    late = sequence.late(lag)
    placed = iter(late[at] for _, at, _ in sequence.places)
    each = [next(placed) if _placed(s) else np.zeros(len(means)) for s, means in levels]
    return Released(lag, each, _told_from_drift(sequence, late, least))


class _LagFit(NamedTuple):
    lag: Persistence
    left: float  # sum of squares of the levels, and more if that is less than noise gives, e-²
    freedom: int


def _fit(
    sequence: _Sequence, dark: Series, kinds: int, in_seconds: bool, least: float
) -> _LagFit | None:
    """Traps of some kinds, from levels of darks; None if these do not constrain each kind."""
    levels = _centred(dark)
    freedom = len(levels) - len(dark) - _PARAMETERS * kinds
    if freedom < 1:
        return None
    periods = sequence.period[np.concatenate([at for at, _, _ in dark])]
    unit = float(np.median(periods)) if in_seconds else 1.0
    grid = np.log(unit * np.geomspace(_SHORTEST, LONGEST, _DECAYS))
    charge = sequence.light(np.zeros(len(sequence.period)), 0.0)
    for _ in range(_ROUNDS):

        def term(log_decay: float, charge: F64 = charge) -> F64:
            return _centred(dark, sequence.released(charge, float(np.exp(log_decay)), in_seconds))

        fit = fit_terms(term, levels, grid, kinds)
        left = max(fit.left, freedom * least)
        if kinds > 1 and (fit.sizes <= _SURE * fit.errors(left / freedom)[0]).any():
            return None
        lag = Persistence.of(fit, left / freedom, in_seconds)
        charge = sequence.light(sequence.late(lag), lag.share)
    return _LagFit(lag, left, freedom)


def _centred(series: Series, model: F64 | None = None) -> F64:
    """Levels of series about their means, weighted; or those of a model (t,) of all frames."""
    own = [(means if model is None else model[at], weight) for at, means, weight in series]
    return np.concatenate([*((v - v.mean()) * weight for v, weight in own), np.zeros(0)])


def _placed(stack: Stack) -> bool:
    """Whether a series has a known time or needs none; light at an unknown time may be anywhere."""
    return stack.kind == "flat" or bool(np.isfinite(stack.start_s))


def _sequence(levels: Levels) -> _Sequence | None:
    """Frames in order of time, those of the other half at the level of their series."""
    # Others may interrupt a series, as if the first level of flats is repeated at the end. None
    # where time stamps are unknown.
    times = [stack.start_s + stack.time_s for stack, _ in levels]
    if not times or not np.isfinite(np.concatenate(times)).all():
        return None
    # Of frames of one time stamp, those of the series that began first.
    every = sorted((t, own[0], n, i) for n, own in enumerate(times) for i, t in enumerate(own))
    runs = [(n, [i for *_, i in own]) for n, own in groupby(every, key=lambda one: one[2])]
    follows = [*(float(times[n][at[0]]) for n, at in runs[1:]), 0.0]
    at = [np.zeros(len(own), int) for own in times]
    frames: list[tuple[float, float, int]] = []
    for (n, own), following in zip(runs, follows, strict=True):
        stack = levels[n][0]
        number = stack.frame[own] - stack.frame[own[0]]
        first, last = float(times[n][own[0]]), int(number[-1])
        # Time stamps may be whole seconds: the period is that of the whole run.
        span = (times[n][own[-1]] - first) / last if last else stack.exptime_s
        span = float(span) if np.isfinite(span) and span > 0 else _SHORTEST
        ends = own[-1] == len(times[n]) - 1
        count = max(last, int(stack.last - stack.frame[own[0]]) * ends) + 1
        at[n][own] = len(frames) + number
        pause = max(following - first - count * span, 0.0)
        frames += [(span, 0.0, n)] * (count - 1) + [(span, pause, n)]
    period, pauses, series = np.array(frames).T
    places = tuple((s, own, means) for (s, means), own in zip(levels, at, strict=True))
    return _Sequence(period, pauses, series.astype(int), places)


def _told_from_drift(sequence: _Sequence, late: F64, least: float) -> bool:
    """Whether charge of earlier light is distinguished from a drift of the level without light.

    It must fit all unlit frames better than a level that settles, or falls steadily, from the start
    of the session on; and the steps from frame to frame after light must follow it, which those of
    a random walk do not.
    """
    time = np.cumsum(sequence.period + sequence.pause) - sequence.period - sequence.pause
    unlit = [(at, means, 1.0) for s, at, means in sequence.places if s.kind != "flat"]
    light = min(int(at[0]) for s, at, _ in sequence.places if s.kind == "flat")
    levels = _centred(unlit)
    rest = levels - _centred(unlit, late)
    freedom = len(rest) - len(unlit) - _PARAMETERS
    if freedom < 1:
        return False
    spans = time.max() * np.geomspace(_FASTEST, _SLOWEST, _DRIFTS)
    drift = fit_terms(lambda x: _centred(unlit, np.exp(-time / np.exp(x))), levels, np.log(spans))
    left = float(rest @ rest)
    if drift.left - left < _SURE**2 * max(left / freedom, least):
        return False
    after = [own for own in unlit if own[0][0] > light]
    step = np.concatenate([np.diff(means) for _, means, _ in after])
    expected = np.concatenate([np.diff(late[at]) for at, _, _ in after])
    if len(step) <= _PARAMETERS or not expected.any():
        return False
    share = fit_terms(lambda _: expected, step, np.zeros(1))
    variance = max(share.left / (len(step) - _PARAMETERS), 2 * least)
    return bool(share.sizes[0] > _SURE * share.errors(variance)[0][0])
