"""Noise that whole rows (or columns) of a frame have in common, from pairs of distant pixels.

Each row is cut into blocks, and only products of blocks that are not neighbours count: noise that
pixels have of their own, or share with pixels near them (crosstalk, brighter-fatter), drops out,
whatever its size. The products are taken mode by mode of the Fourier transform across the rows;
the mode of no frequency, which is the frame's own level, is left out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.model.arrays import F32, F64, I64, Mask

BLOCKS, MIN_BLOCK = 16, 4  # blocks of a row at most, and pixels of a block at least
FEWEST_BLOCKS = 4
FEWEST_FRAMES = 8
FEWEST_LINES = 8
_ROUNDS = 4


@dataclass(frozen=True)
class LineSpectrum:
    """Variance that rows have in common, by mode across the rows."""

    lines: int  # rows that were transformed, an even number
    power: F64  # (n,) of modes 1 to `lines / 2`, e-²; noise of single pixels does not add to it
    dof: F64  # (n,) degrees of freedom of each
    noise: float  # variance of a row's mean by the noise of its pixels, e-²
    pair_noise: float  # the same, as products of distant blocks see it, e-²

    @property
    def modes(self) -> I64:
        """Numbers of the modes."""
        return np.arange(1, self.lines // 2 + 1)

    def variance(self, common: F64) -> F64:
        """Of ``power``, where the rows have ``common`` (n,) in common."""
        square = (common + self.noise) ** 2 - self.noise**2 + self.pair_noise**2
        return np.asarray(2 * square / self.dof)


def line_spectrum(residual: F32, good: Mask, fitted: int = 1) -> LineSpectrum | None:
    """Spectrum of what rows have in common; None where rows or frames are too few.

    Of residuals (t, y, x), e-, without what is constant in time, NaN where there is no sample,
    after so many parameters of each pixel were fitted to the frames.
    """
    frames, lines, width = residual.shape
    lines -= lines % 2
    size = max(MIN_BLOCK, -(-width // BLOCKS))
    blocks = width // size
    if frames < FEWEST_FRAMES or lines < FEWEST_LINES or blocks < FEWEST_BLOCKS:
        return None
    begin = np.arange(blocks) * size
    used = good[:lines] & np.isfinite(residual[:, :lines]).all(axis=0)
    count = np.add.reduceat(used, begin, axis=1, dtype=float)
    total = np.add.reduceat(np.where(used, residual[:, :lines], 0), begin, axis=2, dtype=float)
    modes = np.fft.rfft(total / np.maximum(count, 1), axis=1, norm="ortho")[:, 1:]
    modes = np.ascontiguousarray(modes.transpose(1, 0, 2))
    products = (modes.conj().transpose(0, 2, 1) @ modes).real / (frames - fitted)
    # A block without any good pixel is zero.
    there = np.count_nonzero(count, axis=0) / lines
    at = np.arange(blocks)
    apart = (np.abs(at[:, None] - at) > 1) * np.outer(there, there)
    pairs = float(apart.sum())
    if not pairs:
        return None
    power = np.einsum("nij,ij->n", products, apart > 0) / pairs
    dof = np.full(len(power), 2.0 * (frames - fitted))
    dof[-1] /= 2
    own = np.maximum(np.einsum("nii->i", products) / len(power) - power.mean(), 0.0)
    return LineSpectrum(
        lines=lines,
        power=power,
        dof=dof,
        noise=float(own.sum()) / blocks**2,
        pair_noise=float(np.sqrt(own @ (apart > 0) @ own)) / pairs,
    )


@dataclass(frozen=True)
class LineVariances:
    """Variances of several kinds of noise of rows."""

    size: F64  # (m,) e-²; of nothing zero on average, so some come out below
    covariance: F64  # (m, m)
    sigmas: F64  # (m,) significance of each where it is the only one

    @property
    def roots(self) -> tuple[F64, F64]:
        """Standard deviations, and their errors: upwards, for near zero the two sides differ."""
        size = np.maximum(self.size, 0.0)
        above = np.sqrt(size + np.sqrt(np.diag(self.covariance)))
        return np.sqrt(size), above - np.sqrt(size)


def fit_lines(spectra: Sequence[LineSpectrum], shapes: Sequence[F64]) -> LineVariances:
    """Least-squares sizes of kinds of noise; ``shapes`` (m, n): their unit powers by spectrum."""
    power = np.concatenate([s.power for s in spectra])
    shape = np.concatenate(list(shapes), axis=1)
    ends = np.cumsum([len(s.power) for s in spectra])[:-1]

    def variance(size: F64) -> F64:
        common = np.split(np.maximum(size, 0) @ shape, ends)
        return np.concatenate([s.variance(c) for s, c in zip(spectra, common, strict=True)])

    size = np.zeros(len(shape))
    for _ in range(_ROUNDS):
        weighted = shape / variance(size)
        covariance = np.linalg.pinv(weighted @ shape.T, hermitian=True)
        size = covariance @ (weighted @ power)
    chance, dof = variance(np.zeros(len(shape))), np.concatenate([s.dof for s in spectra])
    sigmas = [_alone(power, own, chance, dof) for own in shape]
    return LineVariances(size, covariance, np.array(sigmas))


def _alone(power: F64, shape: F64, variance: F64, dof: F64) -> float:
    """Standard deviations by which one shape is there, its sum of squares being skew."""
    weight = shape / variance
    z = float(weight @ power / np.sqrt(weight @ shape))
    skew = float(np.sum((weight * np.sqrt(variance)) ** 3 * np.sqrt(8 / dof)))
    total = 8 / (skew / float(weight @ shape) ** 1.5) ** 2
    # A chi-square of as much skewness, by the cube root of Wilson and Hilferty (1931).
    ratio = max(1 + z * np.sqrt(2 / total), 0.0)
    return float((np.cbrt(ratio) - 1 + 2 / (9 * total)) / np.sqrt(2 / (9 * total)))
