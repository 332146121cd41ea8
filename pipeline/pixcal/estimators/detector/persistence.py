"""Charge of earlier exposures that dark frames after light release: its share and decay."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

import numpy as np
from scipy.optimize import minimize, minimize_scalar

from pixcal.estimators.diagnosis.evidence import Evidence, Stack, soon_after
from pixcal.kernels.sample_sums import frame_means
from pixcal.model.arrays import F64, Indices

_SURE = 5.0  # standard errors of the share
_PARAMETERS = 2  # share and decay of a kind of traps
LONGEST = 15.0  # longest decay, in frames or median periods
_SHORTEST = 0.1
_OF_MODEL = 2e-3  # least relative error: the light of a series is not quite steady
_ROUNDS = 3  # of the fit, each with the light that the last one gives
_STEP = 0.01  # relative, for derivatives by the decay
_DRIFTS = 40  # time constants of a drift that are tried before the best is refined
_SLOWEST, _FASTEST = 10.0, 1e-3  # of them, in durations of the session


# series of frames, and the mean above bias of each frame, e-
Levels = Sequence[tuple[Stack, F64]]


@dataclass(frozen=True)
class Persistence:
    """Exponential release of a share of the charge of each frame."""

    share: float
    share_error: float
    decay: float  # in which the release falls by a factor e, s or frames
    decay_error: float
    in_seconds: bool
    # of a second kind of traps: its part of the share, and its longer decay, s
    slow_part: float = 0.0
    slow_part_error: float = 0.0
    slow: float = 0.0
    slow_error: float = 0.0


@dataclass(frozen=True)
class _Sequence:
    """All frames without gaps, in order of time."""

    charge: F64  # (t,) mean that light and dark signal give, e-
    period: F64  # (t,) from the start of the frame until it is read, s
    pause: F64  # (t,) from then until the next frame starts, s
    series: Indices  # (t,) number of each one's series
    places: tuple[tuple[Stack, Indices, F64], ...]  # measured frames of each series, and means, e-

    def released(self, decay: float, in_seconds: bool) -> F64:
        """Charge (t,) released in each frame, for a share of one."""
        spans = self.period / decay if in_seconds else np.full(len(self.period), 1 / decay)
        after = np.exp(-self.pause / decay) if in_seconds else np.ones(len(spans))
        released, held = np.empty(len(spans)), 0.0
        for n, kept in enumerate(np.exp(-spans)):
            released[n] = (1 - kept) * held
            held = (kept * held + self.charge[n]) * after[n]
        return released

    def late(self, lag: Persistence) -> F64:
        """Charge (t,) released in each frame, e-."""
        late = (1 - lag.slow_part) * self.released(lag.decay, lag.in_seconds)
        if lag.slow_part:
            late = late + lag.slow_part * self.released(lag.slow, True)
        return np.asarray(lag.share * late)

    def of_light(self, lag: Persistence) -> "_Sequence":
        """Without what the frames lose and gain; the light of a series is steady."""
        late = self.late(lag)
        light = [float((means - late[at]).mean()) / (1 - lag.share) for _, at, means in self.places]
        return replace(self, charge=np.maximum(light, 0.0)[self.series])


def persistence(evidence: Evidence) -> Persistence | None:
    """As `released_late`, from pixels of a part of the window that are valid in all frames."""
    used = evidence.good.copy()
    for stack in evidence.stacks:
        used &= np.isfinite(stack.adu).all(axis=0)
    if not used.any():
        return None
    means = [frame_means(s.adu, used) for s in evidence.stacks]
    bias = evidence.bias[used].mean()
    levels = [
        (s, (level - bias) * evidence.gain) for s, level in zip(evidence.stacks, means, strict=True)
    ]
    fit = released_late(levels, evidence.read_noise**2 / used.sum())
    return None if fit is None else fit[0]


def released_late(levels: Levels, least: float) -> tuple[Persistence, list[F64]] | None:
    """Fit to the level of dark frames soon after light; None if nothing significant is released.

    The flats decide whether the release follows time or the number of frames. Also the mean charge
    released in the frames of each series, e-. ``least``: smallest variance of a frame's mean, e-².
    """
    sequence = _sequence([one for one in levels if _placed(one[0])])
    if sequence is None:
        return None
    light = np.concatenate(
        [np.zeros(0), *(s.start_s + s.time_s for s, _ in levels if s.kind == "flat")]
    )
    lit = [(at, m, 1 / m.mean()) for s, at, m in sequence.places if s.kind == "flat" and m.all()]
    dark = [
        (at, means, 1.0)
        for stack, at, means in sequence.places
        if stack.kind != "flat" and soon_after(light, stack)
    ]
    freedom = sum(len(at) - 1 for at, _, _ in dark) - _PARAMETERS
    if freedom < 1:
        return None
    fits = [_fit(sequence, dark, mode, freedom, least) for mode in (False, True)]
    left = np.array([[_misfit(sequence, of, one) for of in (dark, lit)] for one in fits])
    scale = np.maximum(left.min(axis=0), [freedom * least, 1e-12])
    count = np.array([freedom, sum(len(at) - 1 for at, _, _ in lit)])
    best = fits[int(np.argmin((left / scale) @ count))]
    for _ in range(_ROUNDS):
        best = _fit(sequence.of_light(best), dark, best.in_seconds, freedom, least)
    best = _of_two_kinds(sequence, dark, best, freedom - _PARAMETERS, least) or best
    if best.share <= _SURE * best.share_error:
        return None
    late = sequence.of_light(best).late(best)
    placed = iter(late[at] for _, at, _ in sequence.places)
    return best, [next(placed) if _placed(s) else np.zeros(len(means)) for s, means in levels]


def _placed(stack: Stack) -> bool:
    """Whether a series has a known time or needs none; light at an unknown time may be anywhere."""
    return stack.kind == "flat" or bool(np.isfinite(stack.start_s))


def told_from_drift(levels: Levels, late: Sequence[F64], least: float) -> bool:
    """Whether charge of earlier light is distinguished from a drift of the level without light.

    It must fit all unlit frames better than a level that settles, or falls steadily, from the start
    of the session on; and the steps from frame to frame after light must follow it, which those of
    a random walk do not. ``late``, ``least``: as `released_late` gives and takes them.
    """
    start = min(float(s.start_s + s.time_s[0]) for s, _ in levels if _placed(s))
    light = min(float(s.start_s + s.time_s[0]) for s, _ in levels if s.kind == "flat")
    unlit = [
        (s.start_s + s.time_s - start, means, released)
        for (s, means), released in zip(levels, late, strict=True)
        if s.kind != "flat" and _placed(s)
    ]
    rest = np.concatenate([_about_mean(means - released) for _, means, released in unlit])
    freedom = len(rest) - len(unlit) - _PARAMETERS
    if freedom < 1:
        return False
    left, drift = float(rest @ rest), _left_by_drift([(at, means) for at, means, _ in unlit])
    if drift - left < _SURE**2 * max(left / freedom, least):
        return False
    after = [(means, released) for at, means, released in unlit if start + at[0] > light]
    step, expected = (
        np.concatenate([np.diff(one) for one in of]) for of in zip(*after, strict=True)
    )
    square = float(expected @ expected)
    if len(step) <= _PARAMETERS or square <= 0:
        return False
    share = float(expected @ step) / square
    rest = step - share * expected
    variance = max(float(rest @ rest) / (len(step) - _PARAMETERS), 2 * least)
    return bool(share * np.sqrt(square / variance) > _SURE)


def _left_by_drift(unlit: Sequence[tuple[F64, F64]]) -> float:
    """Sum of squares that a drift with one time constant leaves of levels about their means."""
    # ``unlit``: times of the frames after the start of the drift, s, and means, of each series.
    levels = np.concatenate([_about_mean(means) for _, means in unlit])
    span = max(float(at[-1]) for at, _ in unlit)

    def left(constant: float) -> float:
        fall = np.concatenate([_about_mean(np.exp(-at / np.exp(constant))) for at, _ in unlit])
        square = float(fall @ fall)
        rest = levels - (float(fall @ levels) / square if square > 0 else 0.0) * fall
        return float(rest @ rest)

    tried = np.log(span * np.geomspace(_FASTEST, _SLOWEST, _DRIFTS))
    sums = [left(float(one)) for one in tried]
    best = int(np.argmin(sums))
    bounds = float(tried[max(best - 1, 0)]), float(tried[min(best + 1, _DRIFTS - 1)])
    return min(min(sums), float(minimize_scalar(left, bounds=bounds, method="bounded").fun))


def _about_mean(values: F64) -> F64:
    return np.asarray(values - values.mean())


Series = Sequence[tuple[Indices, F64, float]]


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
    charge, period, pause, series = np.zeros((4, 0))
    for (n, frames), following in zip(runs, follows, strict=True):
        stack, means = levels[n]
        number = stack.frame[frames] - stack.frame[frames[0]]
        first = float(times[n][frames[0]])
        # Time stamps may be whole seconds: the period is that of the whole run.
        span = (times[n][frames[-1]] - first) / number[-1] if number[-1] else stack.exptime_s
        span = float(span) if np.isfinite(span) and span > 0 else _SHORTEST
        ends = frames[-1] == len(times[n]) - 1
        count = int(max(number[-1], (stack.last - stack.frame[frames[0]]) * ends)) + 1
        at[n][frames] = len(charge) + number
        charge = np.append(charge, [max(float(means.mean()), 0.0)] * count)
        period = np.append(period, [span] * count)
        series = np.append(series, [n] * count)
        pause = np.append(pause, [0.0] * (count - 1) + [max(following - first - count * span, 0.0)])
    places = tuple((s, own, means) for (s, means), own in zip(levels, at, strict=True))
    return _Sequence(charge, period, pause, series.astype(int), places)


def _fit(
    sequence: _Sequence, series: Series, in_seconds: bool, freedom: int, least: float
) -> Persistence:
    """Share and decay of least squares; ``least``: smallest variance of a frame's mean, e-²."""

    def share(decay: float) -> tuple[float, float, F64]:
        model, levels = _centred(sequence.released(decay, in_seconds), series)
        square = float(model @ model)
        size = float(model @ levels) / square if square > 0 else 0.0
        rest = levels - size * model
        return size, float(rest @ rest), model

    dark = np.concatenate([at for at, _, _ in series])
    unit = float(np.median(sequence.period[dark])) if in_seconds else 1.0
    bounds = tuple(float(np.log(unit * d)) for d in (_SHORTEST, LONGEST))
    best = minimize_scalar(lambda x: share(float(np.exp(x)))[1], bounds=bounds, method="bounded")
    decay = float(np.exp(best.x))
    size, left, model = share(decay)
    turned = (share(decay * (1 + _STEP))[2] - model) * size / (_STEP * decay)
    design = np.stack([model, turned], axis=1)
    variance = max(left / freedom, least)
    errors = np.sqrt(variance) * np.linalg.norm(np.linalg.pinv(design), axis=1)
    errors = np.hypot(errors, _OF_MODEL * np.array([size, decay]))
    return Persistence(size, float(errors[0]), decay, float(errors[1]), in_seconds)


def _of_two_kinds(
    sequence: _Sequence, series: Series, one: Persistence, freedom: int, least: float
) -> Persistence | None:
    """Traps of two decays in seconds; None unless they fit far better than ``one`` kind."""
    if freedom < 1:
        return None
    dark = np.concatenate([at for at, _, _ in series])
    unit = float(np.median(sequence.period[dark]))
    lag, before = one, _misfit(sequence.of_light(one), series, one)
    decays = np.array([0.5, 4.0]) * one.decay * (1.0 if one.in_seconds else unit)
    limits = unit * _SHORTEST, unit * LONGEST
    for _ in range(_ROUNDS):
        own = sequence.of_light(lag)
        decays = _decays(own, series, np.clip(decays, *limits), limits)
        sizes, models, left = _shares(own, series, decays)
        turned = (_shares(own, series, (1 + _STEP) * decays)[1] - models) * sizes
        design = np.concatenate([models, turned / (_STEP * decays)], axis=1)
        variance = max(left / freedom, least)
        # Of the design itself: the inverse of its square may be negative, where decays are alike.
        inverse = np.linalg.pinv(design)
        covariance = variance * inverse @ inverse.T
        if (sizes <= _SURE * np.sqrt(np.diag(covariance)[:2])).any():
            return None
        share = float(sizes.sum())
        part = float(sizes[1]) / share
        values = np.array([share, decays[0], part, decays[1]])
        change = np.zeros((4, 4))
        change[0, :2], change[2, :2] = 1, np.array([-part, 1 - part]) / share
        change[1, 2] = change[3, 3] = 1
        errors = np.sqrt(np.diag(change @ covariance @ change.T))
        errors = np.hypot(errors, _OF_MODEL * values)
        of_all, fast, of_slow, slow = zip(values.tolist(), errors.tolist(), strict=True)
        lag = Persistence(*of_all, *fast, True, *of_slow, *slow)
    return lag if before - left > _SURE**2 * variance else None


def _decays(sequence: _Sequence, series: Series, start: F64, limits: tuple[float, float]) -> F64:
    """Two decays (s) of least squares, ascending, from ``start`` on."""
    best = minimize(
        lambda x: _shares(sequence, series, np.exp(x))[2],
        np.log(start),
        method="Nelder-Mead",
        bounds=[np.log(limits)] * 2,
        options={"xatol": 1e-4, "fatol": np.inf},
    )
    return np.asarray(np.exp(np.sort(best.x)))


def _shares(sequence: _Sequence, series: Series, decays: F64) -> tuple[F64, F64, float]:
    """Least-squares shares of traps of given decays (s), their models, and what is left."""
    pairs = [_centred(sequence.released(float(decay), True), series) for decay in decays]
    models, levels = np.stack([model for model, _ in pairs], axis=1), pairs[0][1]
    sizes: F64 = np.linalg.lstsq(models, levels)[0].astype(float)
    rest = levels - models @ sizes
    return sizes, models, float(rest @ rest)


def _misfit(sequence: _Sequence, series: Series, lag: Persistence) -> float:
    """Sum of squares that a persistence leaves of the levels about their means."""
    if not series:
        return 0.0
    late, levels = _centred(sequence.late(lag), series)
    return float(((levels - late) ** 2).sum())


def _centred(model: F64, series: Series) -> tuple[F64, F64]:
    """Model and levels of all series about their means, scaled."""
    pairs = [
        ((model[at] - model[at].mean()) * scale, (levels - levels.mean()) * scale)
        for at, levels, scale in series
    ]
    first, other = zip(*pairs, strict=True)
    return np.concatenate(first), np.concatenate(other)
