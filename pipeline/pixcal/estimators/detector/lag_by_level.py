"""Charge that a frame leaves behind, from a forward model.

A share that is equal at all levels, and independent of charge held before, only changes amplitude
and phase of the frames, which the fringe fit absorbs: it appears in the contrast. Any other loss
leaves harmonics of the phases in the residuals. Gauss-Newton steps fit the loss that a model
predicts to both, together with a nonlinear response.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.detector.frame_lag import slow_contrast
from pixcal.estimators.diagnosis.central_crop import MAX_SAMPLES, central_crop
from pixcal.estimators.diagnosis.distortions import Freedom
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.charge_release import BANDS, in_bands
from pixcal.kernels.frame_order import since_gap
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.normal_matrix import inverse_normal
from pixcal.model.arrays import F32, F64

STEP = 0.01  # relative step of a parameter for its derivative: of the order of its error
UNKNOWN = 6  # frames after a gap, whose past is not known
CONVERGED = 1.0  # fall in chi-square that a step must bring
# factors of a step that are tried: the samples that fill the traps change with the step
LENGTHS = (4.0, 2.0, 1.0, 0.5, 0.25)
NOT_EVEN = 25.0  # chi-square from which the share depends on the level
# start values for traps that fill up: decay in frames, and capacity over the loss of full scale
# without such a limit
DECAYS, CAPACITIES = (0.8, 2.0), (0.1, 0.2, 0.4, 0.7)
ROUNDS, ROUNDS_OF_TRAPS = 3, 13  # most Gauss-Newton steps
_NO_INFLUENCE = 1e-9  # relative error below which a parameter does not influence the frames

# charge (t, n), e-, that frames lose, from parameters and their charge
Loss = Callable[[F64, F32], F32]


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


def loss_by_level(
    evidence: Evidence, lost: Loss, share: float, level_e: float, release: Sequence[float]
) -> FittedLoss | None:
    """Shares of bands of the level, or traps that fill up; None if one share describes the frames.

    ``lost``: takes shares of all bands or, for traps, one share or these, decay (frames), and
    capacity (e-).
    ``share``: mean one; ``level_e``: full scale, e-; ``release``: parts of the charge left behind
    that come out 1, 2, ... frames later, of which each pixel has a share of its own.
    """
    few, fit = (
        LossFit(central_crop(evidence, MAX_SAMPLES // n), lost, level_e, release) for n in (8, 2)
    )
    bands = fit.fit(np.full(len(BANDS), share), ROUNDS)
    precision = inverse_normal(bands.covariance)
    # Contrast is sensitive to the square of the common share, which linear steps neglect.
    away = bands.value - (precision @ bands.value).sum() / precision.sum()
    if float(away @ precision @ away) < NOT_EVEN:
        return None
    # Traps have most room for the charge of the band with the largest share.
    most = float(bands.value.max())
    full = most * level_e
    few.weigh(bands.value)
    starts = [np.array([most, decay, part * full]) for decay in DECAYS for part in CAPACITIES]
    traps = few.fit(min(starts, key=few.chi2), ROUNDS_OF_TRAPS)
    if traps.chi2 > few.chi2(bands.value):
        return bands
    traps = fit.fit(traps.value, ROUNDS_OF_TRAPS)
    if traps.chi2 > fit.chi2(bands.value) - NOT_EVEN:
        return bands
    both = fit.fit(np.repeat(traps.value, [len(BANDS), 1, 1]), ROUNDS_OF_TRAPS)
    return both if both.chi2 < fit.chi2(traps.value) - NOT_EVEN else traps


class LossFit:
    """Fits a loss of charge and a nonlinear response to fringe frames.

    ``level_e``: full scale; ``release``: as in `loss_by_level`.
    """

    def __init__(
        self, evidence: Evidence, lost: Loss, level_e: float, release: Sequence[float]
    ) -> None:
        self._lost, sets = lost, evidence.fringes.values()
        self._sets = [_Set(evidence, fringes, level_e, release) for fringes in sets]

    def fit(self, start: F64, rounds: int) -> FittedLoss:
        """Fit nonzero parameters (p,); ``rounds``: most steps."""
        self.weigh(start)
        value, count, rests = start, len(start), self._rests(start)
        for _ in range(rounds):
            slopes = []
            for n, size in enumerate(STEP * value):
                moved = self._rests(value + size * np.eye(count)[n])
                slopes.append(
                    [(a - b) / np.float32(size) for a, b in zip(rests, moved, strict=True)]
                )
            products = self._products([*slopes, rests])
            covariance, chi2 = inverse_normal(products[:-1, :-1]), float(products[-1, -1])
            step, gain = covariance @ products[:-1, -1], 0.0
            for factor in LENGTHS:
                # Parameters keep their sign: one that would change it is halved instead.
                tried = value + factor * step
                tried = np.where(value * tried > 0, tried, value / 2)
                left = self._rests(tried)
                fall = chi2 - float(self._products([left])[0, 0])
                if fall <= gain and gain > 0:
                    break
                if fall > gain:
                    best, gain = (tried, left), fall
            if gain > 0:
                (value, rests), chi2 = best, chi2 - gain
            if gain < CONVERGED:
                break
        return FittedLoss(value, covariance, chi2)

    def chi2(self, value: F64) -> float:
        """Of a loss with these parameters."""
        return float(self._products([self._rests(value)])[0, 0])

    def weigh(self, value: F64) -> None:
        """Set the contrast's noise from the scatter that a loss leaves."""
        for one, rest in zip(self._sets, self._rests(value), strict=True):
            one.contrast_error *= robust_sigma(rest[one.known, -1])
        self._bent = list(zip(*(one.bent() for one in self._sets), strict=True))

    def _rests(self, value: F64) -> list[F32]:
        return [one.rest(self._lost(value, one.level)) for one in self._sets]

    def _products(self, every: Sequence[Sequence[F32]]) -> F64:
        """Sums (k, k) of products of rests, each less what a nonlinear response explains of it."""
        count = len(every)
        sums: F64 = np.zeros((count + len(self._bent),) * 2)
        for of_set in zip(*every, *self._bent, strict=True):
            rows = np.stack(of_set, axis=1)
            sums += (rows @ rows.swapaxes(1, 2)).sum(axis=0, dtype=float)
        mixed = sums[:count, count:]
        return sums[:count, :count] - mixed @ inverse_normal(sums[count:, count:]) @ mixed.T


class _Set:
    """One fringe set."""

    def __init__(
        self, evidence: Evidence, fringes: FringeEvidence, level_e: float, release: Sequence[float]
    ) -> None:
        # Pixels differ in their share, which must not pass for a dependence on level.
        self._freedom = freedom = Freedom(fringes, before=release)
        self._flat = evidence.flat[freedom.good].astype(np.float32)
        self.level: F32 = freedom.of_good(evidence.level(fringes, np.nan_to_num(fringes.model)))
        self._bands = in_bands(self.level, level_e)[1:]
        b, c, s = fringes.free[:, :3].T
        amplitude = np.hypot(c, s)
        self._to_contrast = np.stack([-1 / b, c / amplitude**2, s / amplitude**2], axis=1)
        self._slow = slow_contrast(fringes.free, fringes.frame)
        self._contrast = self._without_slow(np.log(amplitude / b))
        self.contrast_error = robust_sigma(self._contrast)
        self.known = ~since_gap(fringes.frame, UNKNOWN)
        self._sigma = np.sqrt(freedom.weight) * self.known[:, None]
        self._residual = freedom.left_over(freedom.of_good(fringes.residual))

    def rest(self, lost: F32) -> F32:
        """Residuals, and the contrast as a last column, over their noise, without a loss (t, n)."""
        return self._noise_units(self._residual, self._contrast) - self._of_change(-lost)

    def bent(self) -> list[F32]:
        """What bands of a nonlinear response cause, as in `rest`."""
        return [self._of_change(part) for part in self._bands]

    def _of_change(self, charge: F32) -> F32:
        change = charge / self._flat
        of_frames = (self._freedom.weight * change) @ self._freedom.of_place.T
        moved = np.einsum("tij,tj->ti", self._freedom.frame_covariance[:, :3], of_frames)
        contrast = np.einsum("ti,ti->t", self._to_contrast, moved)
        return self._noise_units(self._freedom.left_over(change), self._without_slow(contrast))

    def _noise_units(self, samples: F32, contrast: F64) -> F32:
        column = (contrast / self.contrast_error).astype(np.float32)
        return np.column_stack([self._sigma * samples, column])

    def _without_slow(self, values: F64) -> F64:
        return np.asarray(values - self._slow @ (self._slow.T @ values))
