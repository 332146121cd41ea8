"""Frame parameters of a set, from a few tiles spread over the detector.

The start uses about a hundred frames spread over the run. Their samples are a matrix of rank three;
any three vectors that span it are transformed to (iota, alpha sin psi, alpha cos psi) by means of
the fringe vector and the gauge (physics note, sections 2 and 3). With the pixels of these tiles
known, every frame is then solved separately, block after block.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.linalg import eigh

from pixcal.estimators.fringe_fit import fringes, tile_fit
from pixcal.estimators.fringe_fit.fit_flags import excess_scatter, typical_chi2
from pixcal.estimators.fringe_fit.fringes import MIN_FRINGES_FOR_MAPS, FrameParameters
from pixcal.estimators.fringe_fit.gauge import gauge_matrix
from pixcal.estimators.fringe_fit.tile_fit import Coding, Tile
from pixcal.kernels.bilinear import frame_sums, solve_pixels
from pixcal.kernels.normal_matrix import inverse_normal, symmetric
from pixcal.model.arrays import C128, F32, F64, U16, Indices, Mask
from pixcal.model.errors import InputError

Pixels = Indices | slice
# flat numbers of pixels of a tile, and their codes (t, p)
Samples = tuple[Indices, U16]
MapFunction = Callable[[Callable[[int], Any], Sequence[int]], list[Any]]

# pixels used to solve frames: the frames' noise then adds some 2e-4 to a map's variance
MAX_PIXELS = 20_000
# interval of these pixels for the start, which only gives weights, and the point at which a moving
# phase is linearised
SUBSAMPLE = 4
MIN_FRAMES = 6  # three unknowns per pixel, and as many again to test the fit
# departure from the visibility of a tile's pixels, over the usual one, above which a pixel is
# excluded; some 8 standard deviations
OUTLIER_VISIBILITY = 12.0
# ratio of mean light to that of most pixels, or inverse, above which one is excluded
MAX_LIGHT_RATIO = 3.0
# largest median distance of the pixels' phases from smooth ones; random phases have 1.57
MAX_PHASE_SCATTER_RAD = 0.8
ITERATIONS, ITERATIONS_MOVING = 3, 8  # most iterations of pixels from frames, frames from pixels
# Change of the frames by an iteration, over their errors, at which it ends. Each iteration halves
# it, so that the remainder is below this share of the frames' noise, which is small itself.
CONVERGED = 0.02
# least power of the weakest of three components over the next, which is noise: frames of only two
# phases have no third component, and noise would be mistaken for the fringes' shape
ABOVE_NOISE = 1.5


def serial_map(function: Callable[[int], Any], numbers: Sequence[int]) -> list[Any]:
    """Call a function with each of the numbers in turn."""
    return [function(n) for n in numbers]


@dataclass
class Scout:
    """Frame parameters at ``reference`` (y, x) from a few tiles, the first for the fringe vector.

    ``nominal``: fringe vector (kx, ky), rad/px. ``each``: runs a function for every tile.
    """

    tiles: Sequence[Tile]
    coding: Coding
    nominal: tuple[float, float]
    reference: tuple[float, float]
    each: MapFunction = field(default=serial_map, repr=False)
    k: tuple[float, float] = (0.0, 0.0)  # fringe vector of the first tile, rad/px
    # moving, moving_significance: whether the fringe vector changes from frame to frame, and
    # the test's statistic
    moving: bool = False
    moving_significance: float = 0.0
    noise: float = 1.0  # usual reduced chi-square of the pixels
    excess_scatter: float = 0.0  # its relative scatter from pixel to pixel beyond chance
    theta: list[F64] = field(default_factory=list)  # (3, y, x) of each tile

    def prime(self, codes: Sequence[U16]) -> FrameParameters:
        """Fit the tiles' pixels to frames (t, y, x) spread over the run; returns their parameters.

        Raises InputError: too few frames or good pixels, no fringes, or a phase that does not
        change.
        """
        n_frames = codes[0].shape[0]
        if n_frames < MIN_FRAMES:
            raise InputError(f"{n_frames} frames: at least {MIN_FRAMES} are needed; take more")
        self._drop_outliers(codes)
        self._require_pixels()
        g = self._subspace(codes)
        frames = FrameParameters(g, np.zeros((n_frames, 2)), self.reference)
        frames = self._settled(codes, frames, ITERATIONS)
        self._count_fringes()
        chi2 = self._chi2(codes, frames)
        significance = self._motion_significance(codes, frames) / np.median(chi2)
        self.moving_significance = significance
        # Six standard deviations above the value of frames without motion.
        self.moving = significance > 1 + 6 / np.sqrt(n_frames)
        if self.moving:
            frames = self._settled(codes, frames, ITERATIONS_MOVING)
            chi2 = self._chi2(codes, frames)
        self.noise = typical_chi2(chi2, n_frames - 3)
        self.excess_scatter = excess_scatter(chi2, n_frames - 3)
        return frames

    def solve(self, codes: Sequence[U16], start: FrameParameters | None = None) -> FrameParameters:
        """Parameters of further frames (t, y, x), common to all tiles, whose pixels are known."""
        samples = self._samples(codes)
        frames = self._unweighted(samples) if start is None else start
        # Weights come from the previous step; if the model is linear one step is enough.
        for _ in range(3 if self.moving else 1):
            frames, _, _ = self._frame_step(samples, frames, self.moving)
        return frames

    def _samples(self, codes: Sequence[U16]) -> list[Samples]:
        """Samples of each tile that are used to solve frames."""

        def taken(n: int) -> Samples:
            picked, size = self._picked(self.tiles[n]), self.tiles[n].good.size
            if 4 * len(picked) > 3 * size:
                # Unused pixels have zero theta, which is faster than leaving them out.
                picked = np.arange(size)
            return picked, _taken(codes[n], picked)

        return self.each(taken, range(len(self.tiles)))

    def _unweighted(self, samples: Sequence[Samples]) -> FrameParameters:
        """Frames by unweighted least squares."""
        matrix: F64 = np.zeros((3, 3))
        right: F64 = np.zeros((len(samples[0][1]), 3))
        for theta, (picked, codes) in zip(self.theta, samples, strict=True):
            few = _scattered(len(picked), -(-len(picked) // SUBSAMPLE))
            design = theta.reshape(3, -1)[:, picked[few]]
            matrix = matrix + design @ design.T
            right = right + self._electrons(codes, few) @ design.T.astype(np.float32)
        g = np.asarray(np.linalg.solve(matrix, right.T).T, dtype=np.float64)
        return FrameParameters(g, np.zeros((len(g), 2)), self.reference)

    def _require_pixels(self) -> None:
        if sum(int(t.good.sum()) for t in self.tiles) < 30:
            raise InputError(
                "fewer than 30 good pixels: the others are "
                "masked, saturated too often, or do not fit the fringes; check the mask, the "
                "bias frames and the level of the light"
            )

    def _picked(self, tile: Tile) -> Indices:
        """Flat numbers of the good pixels that are used to solve frames."""
        good = np.flatnonzero(tile.good)
        return good[_scattered(len(good), max(1, MAX_PIXELS // len(self.tiles)))]

    def _electrons(self, codes: U16, picked: Pixels) -> F32:
        """Samples (t, p), e-; saturated ones, without weight, get the pixel's highest value."""
        flat = _taken(codes, picked)
        electrons = self.coding.electrons(flat)
        lost = flat == self.coding.fill
        if lost.any():
            electrons[lost] = 0
            lost &= ~lost.all(axis=1, keepdims=True)
            electrons = np.where(lost, electrons.max(axis=0), electrons)
        return np.asarray(electrons, np.float32)

    def _drop_outliers(self, codes: Sequence[U16]) -> None:
        """Exclude pixels whose mean light is far from the median, which would dominate the fit."""

        def drop(n: int) -> None:
            tile = self.tiles[n]
            if not tile.good.any():
                return
            parts = _parts(tile.good.size)
            level = np.concatenate([self._electrons(codes[n], p).mean(axis=0) for p in parts])
            level = level.reshape(tile.shape)
            usual = np.median(level[tile.good])
            tile.good &= (level > usual / MAX_LIGHT_RATIO) & (level < MAX_LIGHT_RATIO * usual)

        self.each(drop, range(len(self.tiles)))

    def _subspace(self, codes: Sequence[U16]) -> F64:
        """First frame parameters: three components, transformed by means of the fringe vector."""

        def gram_of(n: int) -> F64:
            gram: F64 = np.zeros((len(codes[n]), len(codes[n])))
            picked = self._picked(self.tiles[n])
            for part in _parts(len(picked)):
                electrons = self._electrons(codes[n], picked[part])
                gram += electrons @ electrons.T
            return gram

        gram = np.sum(self.each(gram_of, range(len(self.tiles))), axis=0)
        last = len(gram) - 1
        values, vectors = eigh(gram, subset_by_index=(last - 3, last), overwrite_a=True)
        if values[1] <= 1e-12 * values[3] or values[1] < ABOVE_NOISE * values[0]:
            raise InputError(
                "no fringes found, or their phase was scanned too little: the frames "
                "differ by noise only; check the frames, and scan the phase evenly over 2π or more"
            )
        g = vectors[:, :0:-1]
        first, block = self.tiles[0], codes[0]
        every = _parts(first.good.size)
        maps = np.hstack([g.T @ self._electrons(block, part) for part in every])
        maps = maps.reshape(3, *first.shape)
        mean = np.where(first.good & (np.abs(maps[0]) > 0), maps[0], 1.0)
        ratios = np.where(first.good, maps[1:] / mean, 0.0)
        # A third map that is only noise must not drown the fringes of the second.
        self.k = fringes.find_fringe_vector(ratios, first.good, self.nominal)
        y, x = fringes.grid(first.shape)
        target = np.exp(1j * (self.k[0] * x + self.k[1] * y))[first.good]
        span = np.stack([m[first.good] for m in maps], axis=1)
        level = np.median(np.abs(span[:, 0]))
        fringe = np.linalg.lstsq(span / level, target, rcond=None)[0]
        light = np.linalg.lstsq(span / level, np.ones(len(span)), rcond=None)[0]
        mix = np.stack([light, fringe.imag, fringe.real])
        if not np.linalg.cond(mix) < 1e6:
            raise InputError(
                "the frames do not differ enough: the phase was scanned too little; scan it "
                "evenly over 2π or more"
            )
        g = g @ np.linalg.inv(mix)
        return np.asarray(g / self._norm(g))

    def _count_fringes(self) -> None:
        """Reject false fringes and too long periods (the fringe vector is now accurate)."""
        tile, theta = self.tiles[0], self.theta[0]
        level = np.where(tile.good, theta[0], 1.0)
        phasor = np.where(tile.good, theta[2] + 1j * theta[1], 0.0) / level
        smooth = fringes.smooth_phasor(np.asarray(phasor, complex), tile.good, self.k)
        away = np.abs(np.angle(phasor * smooth.map.conj()))[tile.good]
        (kx, ky), (ny, nx) = smooth.k, tile.shape
        turned = np.hypot((kx - self.k[0]) * nx, (ky - self.k[1]) * ny)
        if not np.median(away) < MAX_PHASE_SCATTER_RAD or turned > np.pi:
            raise InputError(
                "no fringes found in the pixels; check the frames, the bias frames, and which "
                "files the set lists"
            )
        across = float(np.hypot(kx * nx, ky * ny)) / (2 * np.pi)
        if across < MIN_FRINGES_FOR_MAPS:
            raise InputError(
                f"{across:.1f} fringes across {nx} x {ny} px: at least {MIN_FRINGES_FOR_MAPS:g} "
                "are needed; use a longer baseline or a larger window"
            )

    @staticmethod
    def _norm(g: F64) -> F64:
        """Scales that make the mean of B and the mean of A equal to 1."""
        amplitude = np.hypot(g[:, 1], g[:, 2]).mean()
        return np.array([g[:, 0].mean(), amplitude, amplitude])

    def _settled(self, codes: Sequence[U16], frames: FrameParameters, most: int) -> FrameParameters:
        """Iterate until the change of the frames is far below their noise."""
        for _ in range(most):
            before = frames
            frames, normal = self._refine(codes, before)
            size = 5 if self.moving else 3
            change = np.hstack([frames.g - before.g, frames.dk - before.dk])[:, :size]
            square = np.einsum("ti,tij,tj->", change, normal[:, :size, :size], change)
            if square < CONVERGED**2 * size * len(change):
                break
        return frames

    def _refine(self, codes: Sequence[U16], frames: FrameParameters) -> tuple[FrameParameters, F64]:
        """One iteration: pixels from frames, gauge, frames from pixels; with normal matrices."""
        before: Sequence[F64 | None] = self.theta or [None] * len(self.tiles)

        def fit(n: int) -> tuple[F64, C128]:
            given = self.tiles[n], [codes[n]], self.coding, frames
            model, smooth = tile_fit.start_model(*given, self.k, before[n])
            step, _, _ = solve_pixels(tile_fit.accumulate(*given, model))
            return model + step, smooth.map

        thetas, smooths = zip(*self.each(fit, range(len(self.tiles))), strict=True)
        goods = [
            _like_most(theta, t.good & np.isfinite(theta).all(axis=0) & (theta[0] > 0))
            for t, theta in zip(self.tiles, thetas, strict=True)
        ]
        q = gauge_matrix(list(zip(thetas, goods, smooths, strict=True)))
        g = frames.g @ np.linalg.inv(q)
        norm = self._norm(g)
        self.theta = [
            np.where(good, ((norm[:, None] * q) @ theta.reshape(3, -1)).reshape(theta.shape), 0.0)
            for theta, good in zip(thetas, goods, strict=True)
        ]
        for tile, good in zip(self.tiles, goods, strict=True):
            tile.good &= good
        self._require_pixels()
        frames = FrameParameters(g / norm, frames.dk, self.reference)
        frames, _, normal = self._frame_step(self._samples(codes), frames, self.moving)
        return frames, normal

    def _frame_step(
        self, samples: Sequence[Samples], frames: FrameParameters, moving: bool
    ) -> tuple[FrameParameters, F64, F64]:
        """One Gauss-Newton step of every frame; its size and normal matrices (t, 5, 5) too."""
        n = len(frames.g)
        # In C order, as another order would compile the kernel again.
        g, dk = frames.g.astype(np.float32, order="C"), frames.dk.astype(np.float32)

        def sums_of(number: int) -> tuple[F64, F64]:
            tile, theta, (picked, codes) = self.tiles[number], self.theta[number], samples[number]
            packed, right = np.zeros((n, 15)), np.zeros((n, 5))
            yy, xx = np.divmod(picked, tile.shape[1])
            y = (yy + tile.y[0] - self.reference[0]).astype(np.float32)
            x = (xx + tile.x[0] - self.reference[1]).astype(np.float32)
            maps = np.ascontiguousarray(theta[:, yy, xx], np.float32)
            pixels = (y, x, maps, tile.read[yy, xx], tile.shot[yy, xx])
            frame_sums(codes.astype(np.float32), *self.coding, g, dk, *pixels, packed, right)
            return packed, right

        every = self.each(sums_of, range(len(self.tiles)))
        packed, right = (np.sum(sums, axis=0) for sums in zip(*every, strict=True))
        normal = symmetric(packed)
        size = 5 if moving else 3
        step = np.zeros((n, 5))
        step[:, :size] = np.einsum(
            "tij,tj->ti", inverse_normal(normal[:, :size, :size], 1e-10), right[:, :size]
        )
        # The kernel used float32 parameters: the step is relative to those.
        moved = FrameParameters(
            g.astype(float) + step[:, :3], dk.astype(float) + step[:, 3:], frames.reference
        )
        return moved, step, normal

    def _motion_significance(self, codes: Sequence[U16], frames: FrameParameters) -> float:
        """Mean of dk' C^-1 dk / 2 over frames; without motion, the reduced chi-square."""
        _, step, normal = self._frame_step(self._samples(codes), frames, moving=True)
        seen = normal[:, 0, 0] > 0
        covariance = inverse_normal(normal[seen], 1e-10)[:, 3:, 3:]
        dk = step[seen, 3:]
        dk = dk - dk.mean(axis=0)
        return float(
            np.einsum("ti,tij,tj->t", dk, inverse_normal(covariance, 1e-10), dk).mean() / 2
        )

    def _chi2(self, codes: Sequence[U16], frames: FrameParameters) -> F64:
        """Reduced chi-square of the good pixels of all tiles."""

        def chi2(n: int) -> F64:
            tile, theta = self.tiles[n], self.theta[n].astype(np.float32)
            sums = tile_fit.accumulate(tile, [codes[n]], self.coding, frames, theta)
            return np.asarray((solve_pixels(sums)[2] / np.maximum(sums[10] - 3, 1))[tile.good])

        return np.concatenate(self.each(chi2, range(len(self.tiles))))


def _like_most(theta: F64, good: Mask) -> Mask:
    """Pixels (y, x) with about the median visibility; others have a wrong bias."""
    visibility = np.hypot(theta[1], theta[2]) / np.where(good, theta[0], 1.0)
    away = np.abs(visibility - np.median(visibility[good])) if good.any() else visibility
    usual = np.median(away[good]) if good.any() else 0.0
    return np.asarray(good & (away < OUTLIER_VISIBILITY * usual + 1e-9))


@lru_cache(maxsize=64)
def _scattered(n: int, wanted: int) -> Indices:
    """A random subset of ``n`` numbers: at even steps, pixels may all have the same phase."""
    if wanted >= n:
        return np.arange(n)
    return np.sort(np.random.default_rng(n).permutation(n)[:wanted])


def _parts(n: int) -> list[slice]:
    """Slices of a thousand of n pixels, to limit the memory of floating-point samples."""
    return [slice(first, min(first + 1024, n)) for first in range(0, n, 1024)]


def _taken(codes: U16, picked: Pixels) -> U16:
    """Samples (t, p) of given pixels; no copy if these are all."""
    flat = codes.reshape(len(codes), -1)
    if isinstance(picked, slice):
        return flat[:, picked]
    return flat if len(picked) == flat.shape[1] else np.take(flat, picked, axis=1)
