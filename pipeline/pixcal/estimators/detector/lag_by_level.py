"""Charge that a frame leaves behind, from a forward model.

A share that is equal at all levels, and independent of charge held before, only changes amplitude
and phase of the frames, which the fringe fit absorbs: it appears in the contrast. Any other loss
leaves harmonics of the phases in the residuals. Gauss-Newton steps fit the loss that a model
predicts to both, together with a nonlinear response.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from pixcal.estimators.detector.frame_lag import MAX_DECAY, CommonLag
from pixcal.estimators.diagnosis.central_crop import MAX_SAMPLES, central_crop
from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.charge_release import fill_traps, released_by_frame
from pixcal.kernels.frame_order import since_gap
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.kernels.robust import robust_sigma
from pixcal.model.arrays import F32, F64

BANDS = (0.0, 0.125, 0.25, 0.5)  # where bands of the level begin, over the full scale
STEP = 0.03  # relative step of a parameter for its derivative
SLOW = (2, 2)  # powers of the time, and harmonics of the phase, that the contrast is free to have
UNKNOWN = 6  # frames after a gap, whose past is not known
CONVERGED = 1.0  # fall in chi-square that a step must bring
# factors of a step that are tried: the samples that fill the traps change with the step
LENGTHS = (4.0, 2.0, 1.0, 0.5, 0.25)
NOT_EVEN = 25.0  # chi-square from which the share depends on the level
# start values for traps that fill up: part kept from frame to frame, and capacity over the loss
# of full scale without such a limit
RETENTIONS, CAPACITIES = (0.3, 0.6), (0.1, 0.2, 0.4, 0.7)
STEPS = 12  # Gauss-Newton steps for such traps
_LARGEST = 100.0  # factor of the share in a band
_NO_INFLUENCE = 1e-9  # relative error below which a parameter does not influence the frames

Loss = Callable[[F64, F32], F32]


def by_level(
    evidence: Evidence, lag: CommonLag, share: float, level_e: float
) -> tuple[dict[str, Any], dict[str, float]]:
    """Parameters of a lag whose share depends on the level, or is limited by traps; their errors.

    Both are empty if the share is the same at all levels. ``share``: mean one; ``level_e``: full
    scale, e-.
    """

    def taken(shares: F64, charge: F32) -> F32:
        parts = in_bands(charge, level_e)
        return np.asarray(sum(np.float32(s) * p for s, p in zip(shares, parts, strict=True)))

    def banded(shares: F64, charge: F32) -> F32:
        held = taken(np.clip(shares / share, 0, _LARGEST) * share, charge)
        if lag.later:
            return released_by_frame(held, np.array(lag.later) / sum(lag.later))[0]
        return fill_traps(held, lag.keep, np.inf)[0]

    def trapped(values: F64, charge: F32) -> F32:
        *shares, keep, most = values
        return fill_traps(taken(np.maximum(shares, 0), charge), _kept(keep), most)[0]

    few, fit = (LossFit(central_crop(evidence, MAX_SAMPLES // n), level_e) for n in (8, 2))
    bands, traps = fit.by_level(few, banded, trapped, share, share * level_e)
    if bands is None:
        return {}, {}
    shares, errors = bands.value, bands.errors
    values: dict[str, Any] = {}
    more: dict[str, float] = {}
    if traps is not None:
        shares, (*of_bands, of_keep, of_most) = np.maximum(traps.value[:-2], 0), traps.errors
        keep = _kept(traps.value[-2])
        errors, decay = np.array(of_bands), float(-1 / np.log(keep))
        share = min(float(np.mean(shares)), 0.5)
        more = {"decay_frames": float(of_keep * decay**2 / keep), "capacity_e": float(of_most)}
        values = {"share": share, "decay_frames": decay, "capacity_e": float(traps.value[-1])}
        values["later"] = ()
    values["bands"] = tuple(float(v) for v in np.clip(shares / share, 0, _LARGEST))
    return values, {f"bands[{n}]": float(e / share) for n, e in enumerate(errors)} | more


def _kept(keep: float) -> float:
    """Share that traps keep for another frame, in the measurable range."""
    return float(np.clip(keep, 1e-3, np.exp(-1 / MAX_DECAY)))


def in_bands(level: F32, level_e: float) -> list[F32]:
    """Electrons of a signal in each band; their sum is the signal, where it is positive."""
    begins = [np.float32(b * level_e) for b in BANDS]
    ends = [*begins[1:], np.float32(np.inf)]
    return [np.clip(level, b, e) - b for b, e in zip(begins, ends, strict=True)]


@dataclass(frozen=True)
class FittedLoss:
    """Parameters of a loss of charge."""

    value: F64  # (p,)
    covariance: F64  # (p, p), from the noise of samples and of the contrast
    chi2: float

    @property
    def errors(self) -> F64:
        """1-sigma (p,); equal to the parameter where the frames do not constrain it."""
        errors, size = np.sqrt(np.diag(self.covariance).clip(0)), np.abs(self.value)
        return np.where(errors > _NO_INFLUENCE * size, errors, size)


class LossFit:
    """Fits losses of charge to fringe frames; ``level_e``: full scale, e-."""

    def __init__(self, evidence: Evidence, level_e: float) -> None:
        self._sets = [_Set(evidence, fringes, level_e) for fringes in evidence.fringes.values()]

    def fit(self, lost: Loss, start: Sequence[float] | F64, rounds: int) -> FittedLoss:
        """Fit nonzero parameters (p,) of a loss; ``rounds``: limit of Gauss-Newton steps.

        ``lost``: gives the charge (t, n), e-, that frames lose, from parameters and own charge.
        """
        value = np.array(start, float)
        rests = self._rests(lost, value)
        chi2 = sum(rest.chi2 for rest in rests)
        for _ in range(rounds + 1):
            normal, right = self._sums(lost, value, rests)
            covariance = inverse_normal(normal)[: len(value), : len(value)]
            step = (inverse_normal(normal) @ right)[: len(value)]
            gain = 0.0
            for factor in LENGTHS:
                # Parameters keep their sign: one that would change it is halved instead.
                moved = value + factor * step
                moved = np.where(value * moved > 0, moved, value / 2)
                tried = self._rests(lost, moved)
                fall = chi2 - sum(rest.chi2 for rest in tried)
                if fall <= gain and gain > 0:
                    break
                if fall > gain:
                    best, of_best, gain = moved, tried, fall
            if gain <= 0:
                break
            value, rests, chi2 = best, of_best, chi2 - gain
            if gain < CONVERGED:
                break
        return FittedLoss(value, covariance, chi2)

    def by_level(
        self, few: "LossFit", banded: Loss, trapped: Loss, share: float, full: float
    ) -> tuple[FittedLoss | None, FittedLoss | None]:
        """Shares of bands of the level, and traps that fill up; None if the fit does not improve.

        ``few``: fewer pixels, to search traps. ``banded, trapped``: as in `fit`. ``share``:
        mean share that stays behind; ``full``: full scale, e-.
        """
        even = np.full(len(BANDS), share)
        self.weigh(banded, even)
        bands = self.fit(banded, even, 2)
        precision = inverse_normal(bands.covariance)
        # Contrast is sensitive to the square of the common share, which linear steps neglect.
        away = bands.value - (precision @ bands.value).sum() / precision.sum()
        if float(away @ precision @ away) < NOT_EVEN:
            return None, None
        starts = [(*even, keep, capacity * full) for keep in RETENTIONS for capacity in CAPACITIES]
        few.weigh(banded, even)
        best = min(starts, key=lambda start: few.chi2(trapped, start))
        traps = few.fit(trapped, best, STEPS // 2)
        few.weigh(trapped, traps.value)
        traps = few.fit(trapped, traps.value, STEPS)
        if traps.chi2 > few.chi2(banded, bands.value):
            return bands, None
        self.weigh(trapped, traps.value)
        traps = self.fit(trapped, traps.value, STEPS)
        better = traps.chi2 <= self.chi2(banded, bands.value) - NOT_EVEN
        return bands, traps if better else None

    def chi2(self, lost: Loss, value: Sequence[float] | F64) -> float:
        """Of a loss with these parameters."""
        return sum(rest.chi2 for rest in self._rests(lost, np.array(value)))

    def weigh(self, lost: Loss, value: Sequence[float] | F64) -> None:
        """Set the contrast's noise from the scatter that a loss leaves."""
        for one, rest in zip(self._sets, self._rests(lost, np.array(value)), strict=True):
            one.contrast_error *= robust_sigma(rest.contrast[one.known])

    def _rests(self, lost: Loss, value: F64) -> list["_Rest"]:
        return [one.rest(lost(value, one.level)) for one in self._sets]

    def _sums(self, lost: Loss, value: F64, rests: Sequence["_Rest"]) -> tuple[F64, F64]:
        """Normal equations for a step of the parameters, then of a nonlinear response."""
        slopes: list[list[_Rest]] = []
        for n, size in enumerate(value):
            near = value.copy()
            near[n] += STEP * size
            moved = self._rests(lost, near)
            slopes.append([a.less(b, 1 / (STEP * size)) for a, b in zip(rests, moved, strict=True)])
        count = len(value) + len(BANDS) - 1
        normal, right = np.zeros((count, count)), np.zeros(count)
        for number, (one, rest) in enumerate(zip(self._sets, rests, strict=True)):
            every = [slope[number] for slope in slopes] + one.bent
            for i, a in enumerate(every):
                right[i] += a.dot(rest)
                for j, b in enumerate(every[: i + 1]):
                    normal[i, j] += a.dot(b)
        return np.tril(normal) + np.tril(normal, -1).T, right


@dataclass(frozen=True)
class _Rest:
    """Residuals (t, n) and contrast (t,) after correction, each over its noise."""

    samples: F32
    contrast: F64

    @property
    def chi2(self) -> float:
        return self.dot(self)

    def dot(self, other: "_Rest") -> float:
        samples = np.einsum("tn,tn->t", self.samples, other.samples).sum(dtype=float)
        return float(samples + self.contrast @ other.contrast)

    def less(self, other: "_Rest", scale: float) -> "_Rest":
        """Difference to another one, scaled."""
        samples = np.float32(scale) * (self.samples - other.samples)
        return _Rest(samples, scale * (self.contrast - other.contrast))


class _Set:
    """One fringe set."""

    def __init__(self, evidence: Evidence, fringes: FringeEvidence, level_e: float) -> None:
        # Pixels differ in their share, which must not pass for a dependence on level.
        self._freedom = freedom = Freedom(fringes, before=True)
        self._flat = evidence.flat[freedom.good].astype(np.float32)
        self.level: F32 = freedom.of_good(evidence.level(fringes, np.nan_to_num(fringes.model)))
        b, c, s = fringes.free[:, :3].T
        amplitude = np.hypot(c, s)
        self._to_contrast = np.stack([-1 / b, c / amplitude**2, s / amplitude**2], axis=1)
        time, phase = np.linspace(-1, 1, len(b)), np.arctan2(s, c)
        slow = [time**n for n in range(SLOW[0] + 1)]
        for n in range(1, SLOW[1] + 1):
            slow += [np.cos(n * phase), np.sin(n * phase)]
        self._slow = np.linalg.svd(np.stack(slow).T, full_matrices=False)[0]
        self._contrast = self._without_slow(np.log(amplitude / b))
        self.contrast_error = robust_sigma(self._contrast)
        self._residual = freedom.left_over(freedom.of_good(fringes.residual))
        self._sigma = np.sqrt(freedom.weight)
        self.known = ~since_gap(fringes.frame, UNKNOWN)
        self._sigma[~self.known] = 0
        self._bands = in_bands(self.level, level_e)[1:]

    @cached_property
    def bent(self) -> list["_Rest"]:
        """Residuals that bands of a nonlinear response cause."""
        return [self._of_change(part / self._flat) for part in self._bands]

    def rest(self, lost: F32) -> _Rest:
        """Residuals and contrast corrected for a loss (t, n), e-."""
        change = self._of_change(-lost / self._flat)
        samples = self._sigma * self._residual - change.samples
        return _Rest(samples, self._contrast / self.contrast_error - change.contrast)

    def _of_change(self, change: F32) -> _Rest:
        left = self._freedom.left_over(change)
        weighted = self._freedom.weight * change
        of_frames = weighted @ self._freedom.of_place.T
        moved = np.einsum("tij,tj->ti", self._freedom.frame_covariance[:, :3], of_frames)
        contrast = np.einsum("ti,ti->t", self._to_contrast, moved)
        return _Rest(self._sigma * left, self._without_slow(contrast) / self.contrast_error)

    def _without_slow(self, values: F64) -> F64:
        return np.asarray(values - self._slow @ (self._slow.T @ values))
