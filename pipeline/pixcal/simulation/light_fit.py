"""Estimate parameters of an effect that acts only on the light of the fringes, from fitted maps.

The changes of mean light, visibility and phase of every pixel follow from the forward model
(`ForwardModel.light`), without simulated frames. Its numbers are fitted to the maps of all sets by
Gauss-Newton steps, jointly with smooth surfaces and the degenerate fringe modes of a fit.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.maps.map_fit import MapFit, MapPart, fit_maps, polynomial
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.arrays import F64
from pixcal.simulation.forward import field_of, numbers, set_of, with_numbers
from pixcal.simulation.light_maps import KINDS, PHASE, FringeSetLight, light_maps

ROUNDS = 3  # Gauss-Newton steps
# change of a map (relative, or rad) by a step for a derivative; the first such step, and how often
# and by what factor it is lengthened
SEEN, STEP, LONGER, MOST = 1e-4, 1e-3, 3, 1e3
# chi-square, and share of the total, by which a start with more numbers must improve
APART, MODEL = 25.0, 0.02
STRAIGHT = 0.02  # largest error of the linear prediction of a step's change, relative
# share of an effect's largest signal in any kind of map, below which a kind is left out: with
# similar noise in all, so small a signal carries no information
LEAST = 0.01
ABSORBED = 1e-8  # residual share of a signal's square below which smooth surfaces absorb it
LOWEST = -3.0  # lowest significance, standard deviations
# least observed share of the predicted change of a map; errors that the prediction must exceed
AGREED, SHOWN = 0.5, 2.0


@dataclass(frozen=True)
class LightStart:
    """Starting point of a fit, and its free fields."""

    model: Any
    free: tuple[str, ...]  # fields whose numbers are fitted
    law: str = ""  # in words


@dataclass(frozen=True)
class LightFit:
    """Estimate of an effect from the maps."""

    start: LightStart
    model: Any
    errors: dict[str, float]  # 1-sigma errors of the numbers that were fitted
    gain: float  # fall in chi-square relative to no effect
    agreed: dict[str, float]  # observed share of the predicted change, by kind of map
    dof: int  # numbers that the maps determine

    @property
    def significance(self) -> float:
        """Significance, sigma; zero if a map that must show the effect does not."""
        if min(self.agreed.values(), default=1.0) < AGREED:
            return 0.0
        # Zero gain would give -37 sigma, and one such simulation would dominate the scatter.
        return max(sigmas_of_chi2(self.gain, max(self.dof, 1)), LOWEST)

    @property
    def why(self) -> str:
        """One sentence."""
        shown = " and ".join(self.agreed) or "maps"
        return f"{shown} of the pixels, as its forward model predicts"


def fit_light(starts: Sequence[LightStart], evidence: Evidence, degree: int) -> LightFit | None:
    """Best fit over the starts, those with fewer numbers first; None with too few pixels."""
    lit = light_maps(evidence)
    best: LightFit | None = None
    for start in starts if lit else ():
        fit = _fitted(start, lit, degree)
        if best is None or fit.gain - best.gain >= max(APART, MODEL * fit.gain):
            best = fit
    return best


def _fitted(start: LightStart, lit: Sequence[FringeSetLight], degree: int) -> LightFit:
    model, here = start.model, [one.change(start.model) for one in lit]
    errors: dict[str, float] = {}
    lengths: dict[str, float] = {}
    for _ in range(ROUNDS):
        values = {k: v for k, v in numbers(model).items() if field_of(k) in start.free}
        slopes = _slopes(model, values, lit, here, lengths)
        rest = [one.data - at for one, at in zip(lit, here, strict=True)]
        fit = _least_squares(lit, rest, slopes, degree)
        step = dict(zip(values, fit.values, strict=True))
        errors = dict(zip(values, map(float, np.sqrt(np.diag(fit.covariance))), strict=True))
        model = with_numbers(model, {k: values[k] + v for k, v in step.items() if errors[k] > 0})
        there = [one.change(model) for one in lit]
        straight = [
            _is_straight(b - a, np.tensordot(fit.values, slope, 1))
            for a, b, slope in zip(here, there, slopes, strict=True)
        ]
        here = there
        if all(straight):
            break
    errors = {key: error for key, error in errors.items() if error > 0}
    return LightFit(start, model, errors, *_gain(lit, here, degree), len(errors))


def _slopes(
    model: Any,
    values: Mapping[str, float],
    lit: Sequence[FringeSetLight],
    here: Sequence[F64],
    lengths: dict[str, float],
) -> list[F64]:
    """Derivatives (n, 3, y, x) of the maps of each set by numbers; keeps the step lengths."""
    slopes = [np.zeros((len(values), *at.shape)) for at in here]
    for n, (key, value) in enumerate(values.items()):
        step, of = lengths.get(key, STEP * max(abs(value), 1.0)), set_of(model, key)
        sets = [i for i, one in enumerate(lit) if of in ("", one.name)]
        for _ in range(LONGER):
            moved, size = _moved(model, key, value, step)
            changes = {i: lit[i].change(moved) - here[i] for i in sets}
            largest = max((float(np.abs(c).max()) for c in changes.values()), default=0.0)
            if largest > SEEN or not size:
                break
            step *= 1.5 * SEEN / max(largest, SEEN / MOST)
        lengths[key] = step
        for i, change in changes.items():
            slopes[i][n] = change / (size or 1.0)
    return slopes


def _moved(model: Any, key: str, value: float, step: float) -> tuple[Any, float]:
    """The model with a number moved by a step (backwards at the end of its range), and the step."""
    for change in (step, -step):
        moved = with_numbers(model, {key: value + change})
        size = numbers(moved)[key] - value
        if size > 0:
            break
    return moved, size


def _is_straight(change: F64, expected: F64) -> bool:
    """Whether maps (3, y, x) changed as their derivatives predict, up to a constant."""
    off = change - expected
    off = off - off.mean(axis=(1, 2), keepdims=True)
    size = expected - expected.mean(axis=(1, 2), keepdims=True)
    return bool((off**2).sum() <= STRAIGHT**2 * (size**2).sum())


def _least_squares(
    lit: Sequence[FringeSetLight],
    rest: Sequence[F64],
    signals: Sequence[F64],
    degree: int,
    kinds: Sequence[int] = range(len(KINDS)),
) -> MapFit:
    """Fit signals (n, 3, y, x) to maps (3, y, x) of all sets; undetermined ones have zero error."""
    parts = []
    whole, left = np.zeros((2, len(signals[0])))
    for one, data, signal in zip(lit, rest, signals, strict=True):
        largest = np.abs(signal).max(axis=(2, 3))
        for kind in (k for k in kinds if (largest[:, k] > LEAST * largest.max(axis=1)).any()):
            free = np.concatenate([polynomial(one.good.shape, degree), one.gauge])
            stitched = one.stitched if kind == PHASE else None
            # A number of one set does not change the maps of other sets.
            some = largest[:, kind] > 0
            part = MapPart.of(signal[some, kind], data[kind], free, one.good, stitched)
            shown = np.zeros((len(part.data), len(signal)))
            shown[:, some] = part.signals
            parts.append(replace(part, signals=shown))
            whole[some] += (signal[some, kind][:, one.good] ** 2).sum(axis=1)
            left += (shown**2).sum(axis=0)
    determined = np.flatnonzero(left > ABSORBED * whole)
    full = MapFit(np.zeros(len(whole)), np.zeros((len(whole),) * 2), 0.0)
    if not len(determined):
        return full
    size = np.sqrt(left[determined])
    fit = fit_maps([replace(p, signals=p.signals[:, determined] / size) for p in parts])
    full.values[determined] = fit.values / size
    full.covariance[np.ix_(determined, determined)] = fit.covariance / np.outer(size, size)
    return replace(full, gain=fit.gain)


def _gain(
    lit: Sequence[FringeSetLight], changes: Sequence[F64], degree: int
) -> tuple[float, dict[str, float]]:
    """Fall in chi-square by the changes, and their observed share in each kind of map."""
    data, signals = [one.data for one in lit], [change[None] for change in changes]
    gain, agreed = 0.0, {}
    for kind, name in enumerate(KINDS):
        fit = _least_squares(lit, data, signals, degree, (kind,))
        share, error = float(fit.values[0]), float(np.sqrt(fit.covariance[0, 0]))
        gain += fit.gain * (share > 0)
        if 0 < SHOWN * error < 1:
            agreed[name] = share
    return gain, agreed
