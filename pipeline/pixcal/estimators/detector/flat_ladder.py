"""Levels of flats against exposure time: a lamp's steadiness, and the detector's response.

No lamp repeats its light exactly, exposure times have an offset, and black levels drift: levels
scatter about a line that need not pass through zero. Their curvature is attributed to the detector
if the noise of the flats agrees with it within errors, else to the lamp.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.detector.straightness import LAMP, RATES
from pixcal.estimators.detector.transfer_curve import TransferCurve, transfer_curve
from pixcal.estimators.diagnosis.evidence import Evidence, Stack, cached_on_evidence
from pixcal.kernels.sample_sums import frame_means
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.arrays import F64

MIN_STEPS = 3  # fewest levels of flats that separate a curve from a line
STEADY = 0.1  # relative rms of levels about the curve above which the lamp was changed
OFF = 8.0  # typical distances from the curve beyond which a level has another lamp setting
DISAGREE = 4.0  # errors between the curvature of levels and of their noise

# least degrees of freedom of the flicker for first frames to measure lag: six pairs
FLICKER_KNOWN = 5.0

# of Student's distribution whose scale is fitted to changes of the light; the rms of normal values
# over that scale, and the efficiency relative to a standard deviation (of 7 to 40 values)
_STUDENT, _OVER_SCALE, _EFFICIENCY = 4.0, 1.202, 0.86
_WITH_BEFORE = 4  # pairs above which the effect of the frames before them is fitted
_WITH_OFFSET, _WITH_CUBIC = 5, 6  # fewest levels for these terms
_TURNS = 30
_SMALL = 1e-4
_UNCONSTRAINED_ERROR = 1e-2  # error of a power that is held at zero as levels are too few


@dataclass(frozen=True)
class Ladder:
    """Flats of several exposure times and one lamp."""

    times: F64  # (n,) s
    levels: F64  # (n,) e-, without bias and dark signal
    sizes: F64  # (2,) response S (1 + sizes[0] u + sizes[1] u²), u the level over the highest
    covariance: F64  # (2, 2); includes the scatter of the levels about the curve
    wander: float  # relative rms of the levels about the curve
    off: F64  # exposure times (s) of outlying flats, for which the lamp was changed

    @property
    def top(self) -> float:
        """Highest level, e-."""
        return float(self.levels.max())


@cached_on_evidence
def light_of(evidence: Evidence, stack: Stack) -> F64:
    """Mean (t,) of the good pixels in each frame without bias and dark signal, e-."""
    good = evidence.good
    dark = evidence.gain * evidence.bias[good].mean()
    if np.isfinite(stack.exptime_s):
        dark += evidence.dark_rate[good].mean() * stack.exptime_s
    return np.asarray(frame_means(stack.adu, good) * evidence.gain - dark)


@cached_on_evidence
def level_before(evidence: Evidence, stack: Stack) -> float:
    """Level (e-) of the frame before a series; zero where time stamps do not identify it."""
    start = stack.start_s + stack.time_s[0]
    earlier = [
        (float(times[times < start].max()), n)
        for n, times in enumerate(s.start_s + s.time_s for s in evidence.stacks)
        if (times < start).any()
    ]
    if not earlier:
        return 0.0
    last = frame_means(evidence.stacks[max(earlier)[1]].adu[-1:], evidence.good)[0]
    return max(float(last - evidence.bias[evidence.good].mean()) * evidence.gain, 0.0)


def warming(evidence: Evidence) -> tuple[float, float]:
    """Relative rise of the light from frame to frame of each level, and its error."""
    return rise_of([light_of(evidence, stack) for stack in evidence.ladder])


def rise_of(series: Sequence[F64]) -> tuple[float, float]:
    """Relative rise from frame to frame that series of light (t,) share, and its error."""
    # Both are zero unless it is significant. First frames, which lag makes fainter, and NaN are
    # excluded.
    rises, weights, squares, freedom = [], [], 0.0, -1
    for whole in series:
        time = 1.0 + np.flatnonzero(np.isfinite(whole[1:]))
        light = whole[time.astype(int)]
        if len(light) < 2 or light.mean() <= 0:
            continue
        time -= time.mean()
        light = light / light.mean() - 1
        rises.append(float(time @ light / (time @ time)))
        weights.append(float(time @ time))
        squares += float(light @ light)
        freedom += len(light) - 1
    if freedom < 1:
        return 0.0, 0.0
    rise = float(np.average(rises, weights=weights))
    rest = max(squares - rise**2 * sum(weights), 0.0)
    error = float(np.sqrt(rest / freedom / sum(weights)))
    return (rise, error) if abs(rise) > SIGNIFICANT * error else (0.0, 0.0)


def flicker(evidence: Evidence) -> tuple[float, float]:
    """Relative rms change of the lamp from frame to frame, and its degrees of freedom."""
    # By lag the first frame of a series may lack a share of its charge and gain one of the previous
    # frame: the common dependence of first steps on both levels is removed.
    rise, _ = warming(evidence)
    steps: list[float] = []
    firsts: list[float] = []
    before: list[float] = []
    for stack in evidence.ladder:
        light = light_of(evidence, stack)
        if len(light) > 1 and light.mean() > 0:
            changes = np.diff(light) / light.mean() - rise
            firsts.append(float(changes[0]))
            before.append(level_before(evidence, stack) / float(light.mean()))
            steps += changes[1:].tolist()
    pairs = np.array(firsts) - (np.median(firsts) if firsts else 0.0)
    if len(firsts) > _WITH_BEFORE and np.ptp(before) > 0:
        design = np.stack([np.ones_like(pairs), before], axis=1)
        rest = pairs - design @ np.linalg.lstsq(design, pairs)[0]
        pairs = rest * np.sqrt(len(rest) / (len(rest) - 2))
    every = np.concatenate([steps, pairs if len(pairs) > 2 else []])
    if not len(every):
        return 0.0, 1.0
    return _rms(every) / float(np.sqrt(2)), max(_EFFICIENCY * len(every), 1.0)


def _rms(values: F64) -> float:
    """Rms without outliers: the most likely scale of Student's distribution."""
    # A median absolute deviation would have half the degrees of freedom: of seven values it is
    # wrong by a factor of three in one case of a hundred.
    square = float(np.mean(values**2))
    for _ in range(_TURNS):
        if square > 0:
            weights = (_STUDENT + 1) / (_STUDENT + values**2 / square)
            square = float(np.mean(weights * values**2))
    return _OVER_SCALE * float(np.sqrt(square / (1 + 0.6 / len(values))))


def straight_line(times: F64, levels: F64, at: F64) -> F64:
    """Levels at times ``at`` on the line of least squared relative distances."""
    terms = 1 + (len(times) >= _WITH_OFFSET)
    design = np.stack([times, np.ones_like(times)][:terms], axis=1)
    line = np.linalg.lstsq(design / levels[:, None], np.ones(len(levels)))[0]
    return np.asarray(np.stack([at, np.ones_like(at)][:terms], axis=1) @ line)


@cached_on_evidence
def ladder(evidence: Evidence) -> Ladder | None:
    """The ladder of an acquisition; None where its noise contradicts the curve of its levels."""
    unproven, curve = unproven_ladder(evidence), transfer_curve(evidence)
    return unproven if unproven is None or curve is None or _agree(unproven, curve) else None


@cached_on_evidence
def unproven_ladder(evidence: Evidence) -> Ladder | None:
    """The ladder from its levels alone; None with too few of them, or a lamp that was changed."""
    stacks = [s for s in evidence.ladder if s.exptime_s > 0]
    light = [light_of(evidence, s) for s in stacks]
    times = np.array([s.exptime_s for s in stacks])
    levels = np.array([one.mean() for one in light])
    once = len(set(times)) == len(times)
    if len(times) < MIN_STEPS or not once or not levels.min() > 0 or not evidence.dithered:
        return None
    if len(times) < _WITH_OFFSET and (levels / times).max() > RATES * (levels / times).min():
        return None
    counts = np.array([len(one) for one in light])
    # The lamp dominates the error of a frame's mean, not photon noise.
    error = np.hypot(LAMP, flicker(evidence)[0] / np.sqrt(counts))
    # Where the flat varies, bright pixels are more nonlinear than the mean.
    flat = evidence.flat[evidence.good] / evidence.flat[evidence.good].mean()
    moments = float((flat**2).mean()), float((flat**2 * flat).mean())
    one_lamp = _of_one_lamp(times, levels, error, moments)
    return None if one_lamp is None or one_lamp.wander > STEADY else one_lamp


def _of_one_lamp(
    times: F64, levels: F64, error: F64, moments: tuple[float, float]
) -> Ladder | None:
    """The ladder without a level far from the curve of the others: no response has such a step."""
    # The end levels are always kept, as a response may have a knee there.
    whole = _bent(times, levels, error, moments)
    if whole is None or len(times) <= _WITH_CUBIC:
        return whole
    best, off = whole, None
    for n in np.argsort(levels)[1:-1]:
        rest = np.arange(len(times)) != n
        fit = _bent(times[rest], levels[rest], error[rest], moments)
        if fit is not None and fit.wander < best.wander:
            best, off = fit, n
    if off is None or best.wander * OFF > whole.wander * np.sqrt(len(times)):
        return whole
    return replace(best, off=times[[off]])


def _bent(times: F64, levels: F64, error: F64, moments: tuple[float, float]) -> Ladder | None:
    n, top = len(times), float(levels.max())
    terms = [True, n >= _WITH_OFFSET, True, n >= _WITH_CUBIC]
    lit = straight_line(times, levels, times)
    rate, sizes = 1.0, np.zeros(2)
    offset, unit = 0.0, float(levels.min())
    for _ in range(_TURNS):
        linear = rate * lit + offset * unit
        u = np.stack([linear * moments[0] / top, (linear / top) ** 2 * moments[1]])
        bent = linear * (1 + sizes @ u)
        slope = 1 + (2 * sizes[0] * u[0] + 3 * sizes[1] * u[1])
        design = np.stack([lit * slope, unit * slope, linear * u[0], linear * u[1]]) / bent / error
        design = design[terms]
        normal = design @ design.T
        if not np.isfinite(normal).all() or np.linalg.cond(normal) > 1e14:
            return None
        covariance = np.linalg.inv(normal)
        rest = (levels / bent - 1) / error
        step = np.zeros(4)
        step[terms] = covariance @ (design @ rest)
        rate, offset = rate + step[0], offset + step[1]
        sizes = np.clip(sizes + step[2:], -0.3, 0.3)
        if np.abs(step).max() < _SMALL:
            break
    freedom = n - sum(terms)
    chi2 = float(rest @ rest) / freedom if freedom else 1.0
    whole = _UNCONSTRAINED_ERROR**2 * np.eye(4)
    whole[np.ix_(terms, terms)] = covariance * max(chi2, 1.0)
    wander = float(np.sqrt(max(chi2, 1.0)) * error.mean())
    return Ladder(times, levels, sizes, whole[2:, 2:], wander, times[:0])


def _agree(flats: Ladder, curve: TransferCurve) -> bool:
    """Whether noise agrees with levels: variance over level follows the slope squared."""
    u = curve.levels / flats.top

    def slope(sizes: F64) -> float:
        rise = 1 + 2 * sizes[0] * u + 3 * sizes[1] * u**2
        share = rise**2 / (1 + sizes[0] * u + sizes[1] * u**2)
        line = np.polyfit(curve.levels / curve.top, share, 1, w=1 / curve.errors)
        return float(line[0] / line[1])

    expected = slope(flats.sizes)
    change = np.array([slope(flats.sizes + _SMALL * one) - expected for one in np.eye(2)]) / _SMALL
    error = np.hypot(curve.slope_error / curve.share, np.sqrt(change @ flats.covariance @ change))
    return bool(abs(curve.slope / curve.share - expected) < DISAGREE * error)


def ladder_response(evidence: Evidence, level_e: float) -> tuple[F64, F64] | None:
    """Relative deviations of the response from a line at a level, from a ladder of flats.

    Sizes (2,) of the first and the second power of the level, and covariance; None without a
    ladder.
    """
    flats = ladder(evidence)
    if flats is None:
        return None
    scale = (level_e / flats.top) ** np.arange(1, 3)
    return flats.sizes * scale, flats.covariance * np.outer(scale, scale)
