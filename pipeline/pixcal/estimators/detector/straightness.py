"""Levels of flats off a straight line: the response, the lamp, or the exposure times.

A drifting lamp shows within the frames of each exposure time, whatever the response. The noise of
flats follows the slope of the response; levels that it contradicts deviate for another reason.
Rounded exposure times are wrong by a time that does not grow with the exposure.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.optimize import linprog
from scipy.special import fdtrc, ndtr

from pixcal.estimators.detector.calibration import MIN_STEPS, Linearity, linearity
from pixcal.model.arrays import F64, Mask

LAMP = 1e-3  # least relative error of the light of a flat, exposure time included
RATES = 1.3  # largest ratio of light per second among levels of one lamp
_BENT = 0.02  # largest deviation from a line with an offset in exposure time that one lamp gives
SURE = 5.0  # errors above which a lamp or a response is reported
_BY_CHANCE = float(ndtr(-SURE))
# least deviation from a line of which it is said that a lamp may cause it: below, the linearity and
# its error say enough
_WORTH = 5e-3
_DEGREE = 6  # highest of the polynomial of the lamp's light in time
_DETERMINED = 1e10  # condition of its normal equations
# least width of the residuals of rounded times, over that of their distribution, and least share of
# it that no curve in level explains
_FILLED, _ROUGH = 0.2, 0.3
# Scatter in proportion to the time, as of a lamp reset for each level, over scatter that is equal
# for all times, and over that expected of the step: above this, times are reported as rounded. A
# lamp has the size of the step by chance only.
_LIKELIER = 0.95
_NOISE = 5e-3  # least relative error of the noise of a level
_ORDERED = 0.9  # correlation of exposure time and time of recording that a drift can mimic


@dataclass(frozen=True)
class Level:
    """The flats of an exposure time and a lamp."""

    exptime: float  # s
    level: float  # mean (ADU), without bias and dark signal
    usable: bool  # without saturation
    light: F64  # (t,) of each frame (ADU), from some of the pixels
    time: F64  # (t,) when each was recorded, s; NaN if unknown


@dataclass(frozen=True)
class Straightness:
    """How straight the levels of flats are, and why they are not."""

    line: Linearity  # of the levels at a steady lamp
    # largest, error: relative deviation of the response from a line; the error is None if there is
    # one flat at each level
    largest: float
    error: float | None
    # peak to peak relative change of the lamp over the usable flats, which ``line`` allows for
    drift: float = 0.0
    rounded: float = 0.0  # s, to which exposure times are rounded, if levels show it
    scatter: float = 0.0  # relative, of levels about a curve, if their noise excludes the response
    lamp: bool = False  # whether a lamp that drifts may have bent the levels


def straightness(
    levels: Sequence[Level], transfer: F64, read_variance: float
) -> Straightness | None:
    """Judge levels of flats; None with too few, or where the lamp was changed between them.

    transfer : (point, 3) level, variance and its error, of `emva.transfer_points`
    read_variance : of a sample without light, ADU²; NaN without a measured gain
    """
    if len(levels) < MIN_STEPS:
        return None
    times = np.array([one.exptime for one in levels])
    means = np.array([one.level for one in levels])
    used = np.array([one.usable for one in levels], np.bool_)
    light = [one.light for one in levels]
    line, drift, of_drift = _at_a_steady_lamp(levels, times, means, used)
    if line is None or not _one_lamp((means / times)[used], line):
        return None
    change = 0.0
    if drift is not None:
        means = means / np.array([one.mean() for one in drift])
        light = [one / lamp for one, lamp in zip(light, drift, strict=True)]
        # At saturated levels the drift is extrapolated.
        change = float(np.ptp(np.concatenate([drift[n] for n in np.flatnonzero(used)])))
        # A response that is not straight changes the drift that is seen, too.
        of_drift = float(np.hypot(of_drift, change * line.max_deviation))
    ratios = [o.var(ddof=1) / o.mean() ** 2 / len(o) for o in light if len(o) > 1 and o.mean() > 0]
    error = float(np.hypot(np.sqrt(np.mean(ratios)), of_drift)) if ratios else None
    verdict = Straightness(line, line.max_deviation, error, change)
    if line.max_deviation < LAMP or (not of_drift and line.max_deviation < SURE * (error or 0.0)):
        return verdict
    # Levels that do not vanish at no exposure are late by a constant time, or bent.
    favour = max(
        _noise_favours_levels(charge[used], means[used], transfer, read_variance)
        for charge in (times, times + line.late[0])
    )
    if favour < -(SURE**2):
        verdict = _without_times(verdict, times[used], means[used])
    if not verdict.rounded and not verdict.scatter and drift is None and favour < SURE**2:
        told = error is not None and line.max_deviation > _WORTH
        return replace(verdict, lamp=told and _may_drift(levels))
    return verdict


def _one_lamp(rates: F64, line: Linearity) -> bool:
    """Whether all levels can be of one lamp, perhaps with exposures longer than stated."""
    alike = bool(rates.max() < RATES * rates.min())
    return alike or (np.isfinite(line.late[1]) and line.max_deviation < _BENT)


def _at_a_steady_lamp(
    levels: Sequence[Level], times: F64, means: F64, used: Mask
) -> tuple[Linearity | None, list[F64] | None, float]:
    """The line, and the light (t,) of the lamp in each level with the error that it adds."""
    # Without a lamp whose drift is told by the frames of each level and straightens the levels, its
    # light is None.
    once = len(set(times[used])) == used.sum()
    line = linearity(times, means, used) if once else None
    drifts = _drift(levels)
    if drifts is None:
        return line, None, 0.0
    steady, *shifted = (
        linearity(times, means / [one.mean() for one in light], used) for light in drifts
    )
    if steady is None:
        return line, None, 0.0
    if line is not None and steady.max_deviation > line.max_deviation:
        # The lamp may start anew at each level.
        return line, None, steady.max_deviation - line.max_deviation
    if not once and _apart(times[used], steady.deviation[used]) > LAMP:
        return None, None, 0.0
    changes = [one.deviation - steady.deviation for one in shifted if one is not None]
    worst = np.nanargmax(np.abs(steady.deviation))
    return steady, drifts[0], float(np.linalg.norm([one[worst] for one in changes]))


def _apart(times: F64, deviation: F64) -> float:
    """Largest difference of levels of the same exposure time."""
    return max(float(np.ptp(deviation[times == t])) for t in set(times))


def _drift(levels: Sequence[Level]) -> list[list[F64]] | None:
    """Light (t,) of the lamp in each level, and with each independent error added; None if steady.

    From frames of the same exposure time, without the first of each level, which lag may dim. If a
    level is repeated, pairs keep both frames, because the repeat says more.
    """
    repeated = len({one.exptime for one in levels}) < len(levels)
    every = np.concatenate([one.time for one in levels])
    if not np.ptp(every) > 0:
        return None
    middle, half = (every.max() + every.min()) / 2, np.ptp(every) / 2
    powers = [((one.time - middle) / half)[:, None] ** np.arange(1, _DEGREE + 1) for one in levels]
    design, value = [np.zeros((0, _DEGREE))], [np.zeros(0)]
    for t in {one.exptime for one in levels if one.usable}:
        same = [n for n, one in enumerate(levels) if one.exptime == t and one.usable]
        rest = [slice(int(len(levels[n].light) > 2 or not repeated), None) for n in same]
        light = np.concatenate([levels[n].light[one] for n, one in zip(same, rest, strict=True)])
        if len(light) < 2 or light.mean() <= 0:
            continue
        terms = np.concatenate([powers[n][one] for n, one in zip(same, rest, strict=True)])
        # Photon noise falls with the root of the light.
        weight = np.sqrt(light.mean())
        design.append(weight * (terms - terms.mean(axis=0)))
        value.append(weight * (light / light.mean() - 1))
    freedom = sum(max(len(one) - 1, 0) for one in value)
    fitted = _polynomial(np.concatenate(design), np.concatenate(value), freedom)
    if fitted is None:
        return None
    sizes, steps = fitted
    exponents = [
        [terms[:, : len(own)] @ own for terms in powers]
        for own in (sizes, *(sizes + step for step in steps))
    ]
    # A lamp that was set anew for each level does not drift.
    if np.ptp(np.concatenate(exponents[0])) > np.log(RATES):
        return None
    return [[np.exp(one) for one in own] for own in exponents]


def _polynomial(design: F64, value: F64, freedom: int) -> tuple[F64, F64] | None:
    """Coefficients (n,) of the degree with most evidence, and shifts (n, n) by each error."""
    # None without a significant one. The degree has the least Bayesian information criterion.
    best: float = np.inf
    fit: tuple[F64, F64] | None = None
    whole = float(value @ value)
    for degree in range(1, min(_DEGREE, freedom // 2) + 1):
        terms = design[:, :degree]
        normal = terms.T @ terms
        if not np.linalg.cond(normal) < _DETERMINED:
            break
        sizes = np.linalg.solve(normal, terms.T @ value)
        rest = float(((value - terms @ sizes) ** 2).sum())
        criterion = freedom * np.log(max(rest, 1e-300)) + degree * np.log(freedom)
        scatter = max(rest / (freedom - degree), 1e-300)
        # The scatter is known from the few residuals alone.
        ratio = (whole - rest) / degree / scatter
        if criterion < best and fdtrc(degree, freedom - degree, ratio) < _BY_CHANCE:
            errors = np.linalg.cholesky(scatter * np.linalg.inv(normal))
            best, fit = criterion, (np.asarray(sizes), np.asarray(errors.T))
    return fit


def _noise_favours_levels(charge: F64, levels: F64, transfer: F64, read_variance: float) -> float:
    """Chi-square by which noise fits a response through the levels better than a straight one."""
    # A response of slope s has s² times the shot noise of a straight one of the same charge (in any
    # unit). Zero where there is no noise to tell.
    order = np.argsort(levels)
    charge = charge[order] * np.mean(levels / charge)
    charge, signal = np.append(0.0, charge), np.append(0.0, levels[order])
    known = (transfer[:, 0] > signal[1] / 2) & (transfer[:, 0] <= 1.05 * signal[-1])
    if not np.isfinite(read_variance) or known.sum() < MIN_STEPS or np.diff(charge).min() <= 0:
        return 0.0
    level, variance, error = transfer[known].T
    share = (variance - read_variance) / level
    error = np.hypot(error / level, _NOISE * share)
    response = PchipInterpolator(charge, signal)
    inner = np.interp(level, signal, charge)
    bent = response(inner, 1) ** 2 * inner / level

    def misfit(expected: F64) -> float:
        weighted, value = expected / error, share / error
        rest = value - weighted * (weighted @ value) / (weighted @ weighted)
        return float(rest @ rest)

    return misfit(np.ones_like(level)) - misfit(bent)


def _without_times(verdict: Straightness, times: F64, levels: F64) -> Straightness:
    """The response from levels that scatter because of exposure times or the lamp."""
    step = _rounded_to(times, levels)
    u = levels / levels.max()
    sigma = step / np.sqrt(12) / times if step else np.ones_like(times)
    # Over the straight line; where times are not rounded an offset of theirs counts as straight.
    terms = [np.ones_like(u), u, *([] if step else [1 / u])]
    design, value = np.stack(terms, axis=1) / sigma[:, None], levels / times / sigma
    freedom = len(times) - len(terms)
    if freedom < 2:
        return verdict
    normal = design.T @ design
    sizes = np.linalg.solve(normal, design.T @ value)
    rest = value - design @ sizes
    scatter = np.sqrt(rest @ rest / freedom) / sizes[0]
    if not step and scatter < _ROUGH * verdict.line.max_deviation:
        return verdict
    bent = linearity(times, times * (1 + 1e-3 * u), np.ones(len(u), np.bool_))
    assert bent is not None
    unit = bent.max_deviation / 1e-3
    largest = unit * abs(float(sizes[1] / sizes[0]))
    error = unit * max(scatter, 1.0 if step else 0.0) * np.sqrt(np.linalg.inv(normal)[1, 1])
    return replace(
        verdict,
        largest=largest,
        error=float(np.hypot(error, verdict.error or 0.0)),
        rounded=step,
        scatter=0.0 if step else float(scatter),
    )


def _rounded_to(times: F64, levels: F64) -> float:
    """Step (s) to which times were rounded, if levels are straight but for that; else zero."""
    steps = 10.0 ** np.arange(2, -10, -1)
    whole = [np.abs(times / s - np.rint(times / s)) <= 1e-6 * times / s for s in steps]
    step = float(next((s for s, own in zip(steps, whole, strict=True) if own.all()), 0.0))
    if len(set(levels)) <= MIN_STEPS or not step:
        return 0.0

    # A cut-off of digits is rounding of times that are longer by half a step. The line with the
    # least largest distance (steps) decides.
    same = np.ones_like(times)
    terms = np.stack([levels / levels.max(), same], axis=1)
    below = np.concatenate([np.column_stack([sign * terms, -same]) for sign in (1, -1)])
    nearest = linprog([0, 0, 1], below, np.append(times, -times) / step, bounds=(None, None))

    def width(degree: int, unit: F64) -> float:
        """Of distances from a curve in a unit (n,), which has one size for all."""
        rest = (times - np.polyval(np.polyfit(levels, times, degree, w=1 / unit), levels)) / unit
        scale = float(np.exp(np.log(unit).mean()))
        return scale * float(np.linalg.norm(rest)) / float(np.sqrt(len(times) - degree - 1))

    line, expected = width(1, same), step / np.sqrt(12)
    even = line > _FILLED * expected and width(2, same) > _ROUGH * line
    likelier = width(1, times) > _LIKELIER * max(line, expected)
    return step if even and likelier and nearest.fun <= 0.5 else 0.0


def _may_drift(levels: Sequence[Level]) -> bool:
    """Whether levels were recorded in the order of exposure times, or at unknown times."""
    times = np.array([one.time.mean() for one in levels])
    order = np.corrcoef(np.argsort(np.argsort(times)), np.arange(len(times)))[0, 1]
    return not np.isfinite(times).all() or abs(order) > _ORDERED
