"""Distortions of the signal that the fit of the fringes cannot absorb, fitted to its residuals.

A distortion changes the samples by a function of the signal and a few sizes. The directions in
which the fit is free are projected out of it and of the residuals (with weights), so that errors of
the fit do not matter; sizes follow by weighted least squares (Gauss-Newton).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from pixcal.estimators.diagnosis.evidence import FringeEvidence
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.kernels.frame_order import follows
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_chi2
from pixcal.model.arrays import F32, F64

Distortion = Callable[[FringeEvidence, F32, F64], F32]

# alternating projections: for fringes of full contrast 0.5 % of the remainder still lies in free
# directions, and each further one halves that
_TURNS = 4
_AT_ONCE = 16  # frames processed together, to stay in the cache

_INDEPENDENT = 1e-3
_NEGLIGIBLE = 1e-6

# most steps, all with the derivatives at zero distortion; they end when all sizes together move by
# less than this many standard errors
_ROUNDS = 8
_STILL = 0.1
# Rounds of the fit of one size; each cuts the error of a charge to the share that it moves.
_ROUNDS_OF_FIRST = 4

# share of the chi-square of separate sizes above which common ones are rejected
MAX_DISAGREEMENT = 0.25


class FramesByPixels:
    """A table of frames by pixels, with free functions of time and of place.

    weight : (t, n) one over the variance; zero where a sample has no weight
    of_time : (k, t) functions of time, free in each pixel
    of_place : (j, n) functions of place, free in each frame
    slopes : (t, p, j) coefficients of the functions of place for each parameter of a frame, where
        these are fewer
    """

    def __init__(self, weight: F32, of_time: F32, of_place: F32, slopes: F64 | None = None) -> None:
        self.weight, self.of_time, self.of_place, self._slopes = weight, of_time, of_place, slopes

    @cached_property
    def pixel_inverse(self) -> F64:
        """Inverse (n, k, k) of the pixels' normal matrices for their functions of time."""
        k = len(self.of_time)
        upper = np.triu_indices(k)
        products = self.of_time[upper[0]] * self.of_time[upper[1]]
        normal = symmetric((products @ self.weight).T)
        # A pixel with too few samples has no parameters.
        trace = np.einsum("nii->n", normal)[:, None, None]
        return np.linalg.inv(normal + (_NEGLIGIBLE * trace + 1e-30) * np.eye(k))

    @cached_property
    def frame_covariance(self) -> F64:
        """Covariance (t, j, j) of each frame's coefficients of ``of_place``, from the noise."""
        upper = np.triu_indices(len(self.of_place))
        products = self.of_place[upper[0]] * self.of_place[upper[1]]
        normal = symmetric(self.weight @ products.T)
        if self._slopes is None:
            return inverse_normal(normal, 1e-7)
        turned = self._slopes.swapaxes(1, 2)
        return turned @ inverse_normal(self._slopes @ normal @ turned, 1e-7) @ self._slopes

    def left_over(self, change: F32) -> F32:
        """Part of a change (t, n) of the samples orthogonal to the freedom; 0 without weight."""
        # Projected in turn onto the residuals of the frames and of the pixels.
        inverse = np.ascontiguousarray(np.moveaxis(self.pixel_inverse, 0, -1), np.float32)
        covariance = self.frame_covariance.astype(np.float32)
        rest = np.where(self.weight > 0, change, np.float32(0))
        share = np.zeros((len(self.of_time), rest.shape[1]), np.float32)
        for _ in range(_TURNS):
            sums = np.zeros_like(share)
            for first in range(0, len(rest), _AT_ONCE):
                frames = slice(first, first + _AT_ONCE)
                rows, weight, times = rest[frames], self.weight[frames], self.of_time[:, frames]
                rows -= times.T @ share
                dots = (weight * rows) @ self.of_place.T
                rows -= np.einsum("tij,tj->ti", covariance[frames], dots) @ self.of_place
                sums += times @ (weight * rows)
            share = np.einsum("ikn,kn->in", inverse, sums)
        rest -= self.of_time.T @ share
        rest[self.weight == 0] = 0
        return rest

    def absorbed_by_pixels(self) -> F32:
        """Share (t, n) of the variance that the pixels' free parameters absorb."""
        k, count = self.of_time.shape
        products = (self.of_time[:, None] * self.of_time).reshape(k * k, count)
        inverse = self.pixel_inverse.reshape(-1, k * k).astype(np.float32)
        return np.asarray(products.T @ inverse.T * self.weight)


class Freedom(FramesByPixels):
    """The directions in which a fit of a fringe set is free.

    Frames are free in (B, A cos phi, A sin phi) and the fringe vector; pixels in the three maps, in
    higher ``harmonics`` of the phase and in a share of a sum of the frames 1, 2, ... ``before``, of
    these weights.
    ``margin``: pixels along the edges that are excluded. ``good``: (y, x) the n
    pixels used; ``of_time``: (k, t) orthonormal; ``of_place``: (7, n) the maps, and their slopes
    along x and y.
    """

    def __init__(
        self,
        fringes: FringeEvidence,
        harmonics: int = 1,
        margin: int = 0,
        before: Sequence[float] = (),
    ) -> None:
        inside = np.zeros_like(fringes.good)
        ny, nx = inside.shape
        inside[margin : ny - margin, margin : nx - margin] = True
        self.good = good = fringes.good & inside
        usable = np.isfinite(self.of_good(fringes.electrons))
        weight: F32 = np.where(usable, 1 / self.of_good(fringes.variance), np.float32(0))
        of_time = [fringes.g / np.abs(fringes.g).max(axis=0)]
        for n in range(2, harmonics + 1):
            of_time += [np.cos(n * fringes.phi)[:, None], np.sin(n * fringes.phi)[:, None]]
        if len(before):
            earlier = (
                part * np.roll(of_time[0], n, axis=0) * follows(fringes.frame, n)[:, None]
                for n, part in enumerate(before, start=1)
            )
            of_time.append(np.sum(list(earlier), axis=0))
        # Where there are few different phases, harmonics are not independent.
        independent, size, _ = np.linalg.svd(np.hstack(of_time), full_matrices=False)
        independent = independent[:, size > _INDEPENDENT * size[0]]
        y, x = (np.broadcast_to(v, good.shape)[good] for v in grid((good.shape[0], good.shape[1])))
        theta = fringes.theta[:, good]
        # The maps, and their slopes along x and y, which rotate with the phase of the frame.
        of_place = np.stack(
            [*theta, x * theta[1], x * theta[2], y * theta[1], y * theta[2]]
        ).astype(np.float32)
        slopes = np.zeros((len(fringes.g), 5, 7))
        slopes[:, [0, 1, 2], [0, 1, 2]] = 1
        for row, column in ((3, 3), (4, 5)):
            slopes[:, row, column] = -fringes.g[:, 2]
            slopes[:, row, column + 1] = fringes.g[:, 1]
        super().__init__(weight, np.ascontiguousarray(independent.T, np.float32), of_place, slopes)

    def of_good(self, samples: F32) -> F32:
        """The good pixels (t, n) of samples (t, y, x)."""
        return np.take(samples.reshape(len(samples), -1), np.flatnonzero(self.good), axis=1)


@dataclass(frozen=True)
class Agreement:
    """Whether sets agree on common sizes."""

    common: float  # common, own: chi-square explained by common sizes, and by each set's own
    own: float
    more: int  # sizes that are each set's own, less the common ones

    @property
    def rejected(self) -> bool:
        """Whether sets contradict each other substantially, beyond chance."""
        apart = self.own - self.common
        chance = sigmas_of_chi2(apart, self.more) < SIGNIFICANT if self.more else True
        return apart > MAX_DISAGREEMENT * self.own and not chance


def fit_distortions(
    sets: Sequence[FringeEvidence],
    distortion: Distortion,
    count: int,
    *,
    margin: int = 0,
    prior: tuple[F64, F64] | None = None,
) -> tuple[F64, F64, Agreement]:
    """Sizes (count,) of distortions common to all sets, and their covariance from sample noise.

    Returns also the sets' agreement.

    distortion : gives the change of the signal (t, y, x) from a set, its undistorted signal
        (t, y, x) and the sizes. Derivatives are the changes by sizes of one.
    margin : pixels along the edges that are not used
    prior : (float64 array, float64 array) prior values of the sizes, and their information (inverse
        variance; zero without a prior)
    """
    fits = [_SetFit(fringes, distortion, np.eye(count), margin) for fringes in sets]
    known, information = (np.zeros(count), np.zeros(count)) if prior is None else prior
    covariance = inverse_normal(sum(fit.normal for fit in fits) + np.diag(information), 1e-7)
    sizes = np.zeros(count)
    rights = [fit.right(sizes) for fit in fits]
    agreement = _agreement(fits, rights)
    for _ in range(_ROUNDS):
        right = sum(rights) + information * (known - sizes)
        step = covariance @ right
        sizes = sizes + step
        if right @ step < _STILL**2:
            break
        rights = [fit.right(sizes) for fit in fits]
    return sizes, covariance, agreement


def distortion_sums(
    sets: Sequence[FringeEvidence],
    distortion: Distortion,
    count: int,
    first: int,
    *,
    margin: int = 0,
) -> tuple[F64, F64]:
    """Normal matrix (count, count) and right-hand side (count,) of sizes that all sets share.

    Parameters as in `fit_distortions`. A subset of sizes uses the same rows and columns of the
    sums. The distortion is linearised about what its ``first`` size alone explains in each set.
    """
    normal, right = np.zeros((count, count)), np.zeros(count)
    for fringes in sets:
        about = np.zeros(count)
        fit = _SetFit(fringes, distortion, np.eye(count)[[first]], margin)
        for _ in range(_ROUNDS_OF_FIRST):
            about[first] += fit.right(about)[0] / fit.normal[0, 0]
        fit.linearise(np.eye(count), about)
        normal, right = normal + fit.normal, right + fit.right(about) + fit.normal @ about
    return normal, right


def _agreement(fits: Sequence["_SetFit"], rights: Sequence[F64]) -> Agreement:
    """From the normal equations of each set about no distortion."""

    def explained(normal: F64, right: F64) -> float:
        return float(right @ inverse_normal(normal, 1e-7) @ right)

    each = [explained(fit.normal, right) for fit, right in zip(fits, rights, strict=True)]
    common = explained(np.sum([fit.normal for fit in fits], axis=0), np.sum(rights, axis=0))
    return Agreement(common, sum(each), len(rights[0]) * (len(fits) - 1))


class _SetFit:
    """One set: residuals, the freedom of the fit, and the normal matrix of steps of the sizes."""

    def __init__(
        self, fringes: FringeEvidence, distortion: Distortion, steps: F64, margin: int
    ) -> None:
        self._fringes, self._distortion = fringes, distortion
        self._freedom = Freedom(fringes, margin=margin)
        self._residual = self._freedom.left_over(self._freedom.of_good(fringes.residual))
        # Pixels without a fit affect their neighbours by the samples themselves.
        seen = np.isfinite(fringes.electrons) & ~fringes.good
        self._fitted = np.nan_to_num(np.where(seen, fringes.electrons, fringes.model))
        self._signal = self._fitted
        self.linearise(steps, np.zeros(steps.shape[1]))

    def linearise(self, steps: F64, sizes: F64) -> None:
        """Derivatives for steps (n, count) from sizes, of the signal that `right` last left."""
        freedom, given = self._freedom, (self._fringes, self._signal)
        plain = self._distortion(*given, sizes)
        slopes = (self._distortion(*given, sizes + step) - plain for step in steps)
        self._left = [freedom.left_over(freedom.of_good(slope)) for slope in slopes]
        self.normal = np.array([self._weighted_dots(rest) for rest in self._left])

    def right(self, sizes: F64) -> F64:
        """Right-hand side for a step that improves the sizes."""
        residual = self._residual
        if np.any(sizes):
            freedom = self._freedom
            change = freedom.of_good(self._distortion(self._fringes, self._signal, sizes))
            left = freedom.left_over(change)
            self._signal = self._fitted.copy()
            self._signal[:, freedom.good] -= change - left
            residual = residual - left
        return self._weighted_dots(residual)

    def _weighted_dots(self, rest: F32) -> F64:
        weighted = self._freedom.weight * rest
        return np.array(
            [float(np.einsum("tn,tn->t", left, weighted).sum(dtype=float)) for left in self._left]
        )
