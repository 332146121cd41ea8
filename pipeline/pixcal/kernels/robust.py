"""Robust combination of many frames of one scene, batch by batch, each sample read once.

The first batch (64 frames or fewer) gives each pixel's median and its noise from the median of the
absolute deviations; samples further than ``clip`` sigmas are then left out of the running sums.
The common part of a frame (a shift of the bias, the power of a lamp) is removed first, so that it
neither widens the limits nor makes a whole frame an outlier. Its mean is added back at the end:
where no sample is excluded, the result is the plain mean.

Bias of the clipping: on Gaussian noise the mean keeps its value, the variance is too small by
`clipped_variance_factor` (0.1 % at 4 sigma, 1.5e-5 at 5), for which it is corrected. Limits are
never narrower than the typical noise of the tile requires, because few samples determine that of
one pixel; for the same reason, limits below 4 sigmas would need too large a correction. An outlier
beyond the limit has no weight; one just inside it moves the mean of n frames by ``clip / sqrt(n)``
of the mean's own noise.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pixcal.kernels import inner, kernel
from pixcal.kernels.medians import SIGMA_OF_MAD, finite_median
from pixcal.model.arrays import F32, F64, Mask

BATCH = 64  # frames processed at a time
_LEVEL_PIXELS = 4096
_ROUNDING = np.float32(1e-6)
_BRIGHT, _LIT = 0.9, 0.1  # quantile of a tile that is lit if any pixel is; share of its signal


def clipped_variance_factor(clip: float) -> float:
    """Variance of Gaussian noise cut at ``±clip`` sigmas, as a share of the uncut variance."""
    density = math.exp(-0.5 * clip * clip) / math.sqrt(2 * math.pi)
    return 1 - 2 * clip * density / math.erf(clip / math.sqrt(2))


@inner()
def _exchange(a: Any, b: Any) -> None:
    for i in range(a.size):
        low, high = a[i], b[i]
        a[i] = low if low < high else high
        b[i] = high if low < high else low


@inner()
def _sort_columns(rows: Any) -> None:
    # Batcher's merge exchange (Knuth, TAOCP 3, 5.2.2 M): the same exchanges whatever the data, so
    # that neighbouring columns are sorted in step, in vector registers.
    n = rows.shape[0]
    top = 1
    while 2 * top < n:
        top *= 2
    p = top
    while p > 0:
        q, r, d = top, 0, p
        while True:
            for i in range(n - d):
                if i & p == r:
                    _exchange(rows[i], rows[i + d])
            if q == p:
                break
            d, q, r = q - p, q // 2, p
        p //= 2


@inner()
def _median_of_columns(rows: Any, out: Any) -> None:
    """Median of each column of (row, column) float32, NaN not counted; sorts the rows."""
    for x in range(rows.shape[1]):
        out[x] = 0
    for t in range(rows.shape[0]):
        for x in range(rows.shape[1]):
            if math.isnan(rows[t, x]):
                rows[t, x] = np.inf
            else:
                out[x] += 1
    _sort_columns(rows)
    for x in range(rows.shape[1]):
        m = int(out[x])
        out[x] = 0.5 * (rows[(m - 1) // 2, x] + rows[m // 2, x]) if m > 0 else np.nan


@kernel()
def _median_and_deviation(frames: Any, rows: Any, median: Any, deviation: Any) -> None:
    # Loops: assigning the slices takes seconds to compile. The rows (t, x) are scratch.
    for y in range(frames.shape[1]):
        for t in range(frames.shape[0]):
            for x in range(frames.shape[2]):
                rows[t, x] = frames[t, y, x]
        _median_of_columns(rows, median[y])
        for t in range(frames.shape[0]):
            for x in range(frames.shape[2]):
                rows[t, x] = abs(frames[t, y, x] - median[y, x])
        _median_of_columns(rows, deviation[y])


def median_and_deviation(frames: F32) -> tuple[F32, F32]:
    """Median (..., x) of frames (t, ..., x), NaN apart, and of the absolute deviations from it."""
    count, columns = len(frames), frames.shape[-1]
    median, deviation = np.empty((2, frames[0].size // columns, columns), np.float32)
    rows = np.empty((count, columns), np.float32)
    _median_and_deviation(frames.reshape(count, -1, columns), rows, median, deviation)
    return median.reshape(frames.shape[1:]), deviation.reshape(frames.shape[1:])


def median_around(values: NDArray[Any], side: int) -> F32:
    """Median (y, x) of an odd square around each pixel, NaN excluded; edges mirror the map."""
    out = np.empty(values.shape, np.float32)
    wide = np.pad(values.astype(np.float32), side // 2, "symmetric")
    for y, row in enumerate(out):
        around = sliding_window_view(wide[y : y + side], len(row), axis=1)
        row[:], _ = median_and_deviation(around.reshape(side * side, len(row)))
    return out


@inner()
def _add_row(
    samples: Any, offset: float, factor: float, reference: Any, limit: Any, widen: float,
    seen: Any, count: Any, s1: Any, s2: Any, s3: Any, s4: Any,
) -> None:  # fmt: skip
    for i in range(samples.size):
        d = (samples[i] - offset) * factor - reference[i]
        seen[i] += np.float64(d == d)
        kept = abs(d) <= limit[i] * widen
        z = np.float64(d) if kept else 0.0
        count[i] += np.float64(kept)
        zz = z * z
        s1[i] += z
        s2[i] += zz
        s3[i] += zz * z
        s4[i] += zz * zz


@kernel()
def _add_frames(
    frames: Any, offsets: Any, factors: Any, reference: Any, limit: Any, sums: Any
) -> None:
    for y in range(frames.shape[1]):
        for t in range(frames.shape[0]):
            # A dim frame, made as bright as the others, is noisier by up to that factor.
            widen = max(np.float32(1), factors[t])
            _add_row(
                frames[t, y], offsets[t], factors[t], reference[y], limit[y], widen,
                sums[0, y], sums[1, y], sums[2, y], sums[3, y], sums[4, y], sums[5, y],
            )  # fmt: skip


@dataclass(frozen=True)
class Combined:
    """Statistics of each pixel over many frames of one scene; all (y, x) float64."""

    mean: F64  # of the samples within the limits; NaN where there is none
    # of one sample, unbiased, corrected for the clipping; NaN with fewer than two samples
    variance: F64
    # 0 for Gaussian noise, negative for noise with two levels; NaN with fewer than four samples
    excess_kurtosis: F64
    seen: F64  # seen, kept: samples that were not NaN, and those of them within the limits
    kept: F64


class Combination:
    """Streaming robust mean and variance of frames.

    clip : limit, sigmas
    lamp : whether the common part of a frame is a factor (a lamp's power); else an offset
    quantum : step of the samples, added to the limits, so that noise below it does not close them
    """

    def __init__(self, *, clip: float, lamp: bool, quantum: float) -> None:
        self._clip = clip
        self._lamp = lamp
        self._quantum = quantum
        self._reference: F32 | None = None
        self._limit = np.zeros((0, 0), np.float32)
        self._sums = np.zeros((6, 0, 0))
        self._sigma = 0.0
        self._levels: list[F32] = []

    def update(self, frames: F32) -> F32:
        """Add frames (t, y, x), NaN without sample; the first `BATCH` of them, or all, set limits.

        Returns the factor or offset (t,) of each frame relative to the first batch; NaN for a frame
        without samples.
        """
        if self._reference is None:
            self._start(frames)
        assert self._reference is not None
        levels = self._common(_some(frames), _some(self._reference[None])[0])
        self._levels.append(levels)
        zeros, ones = np.zeros_like(levels), np.ones_like(levels)
        offsets, factors = (zeros, ones / levels) if self._lamp else (levels, ones)
        _add_frames(frames, offsets, factors, self._reference, self._limit, self._sums)
        return levels

    def result(self) -> Combined:
        """Mean, variance and shape of the noise, from all frames added so far."""
        if self._reference is None:
            raise ValueError("no frames were added")
        seen, n, s1, s2, s3, s4 = self._sums
        with np.errstate(invalid="ignore", divide="ignore"):
            m1 = s1 / n
            square = m1**2  # a higher power would take ten times as long
            central2 = s2 / n - square
            variance = central2 * n / (n - 1) / clipped_variance_factor(self._clip)
            kurtosis = np.full(n.shape, np.nan)
            if n.max() > 3:
                central4 = s4 / n - 4 * m1 * (s3 / n) + (6 * (s2 / n) - 3 * square) * square
                known = (n > 3) & (central2 > 0)
                kurtosis = np.where(known, central4 / central2**2 - 3, np.nan)
        mean = self._reference + m1
        variance = np.where(n > 1, variance, np.nan)
        levels = np.concatenate(self._levels).astype(float)
        common = float(np.mean(levels[np.isfinite(levels)])) if np.isfinite(levels).any() else 1.0
        if self._lamp:
            mean, variance = mean * common, variance * common**2
        else:
            mean = mean + common
        return Combined(mean, variance, kurtosis, seen, n)

    def _start(self, frames: F32) -> None:
        # Twice: the frames' common part, measured in a sample of pixels, is removed before the
        # final limits are measured.
        reference, deviation = median_and_deviation(_some(frames)[:, None])
        scale = SIGMA_OF_MAD * len(frames) / max(len(frames) - 0.8, 0.2)
        seen = lit(reference) if self._lamp else np.ones(reference.shape, np.bool_)
        self._sigma = scale * finite_median(deviation[seen])
        levels = self._common(_some(frames), reference[0])[:, None, None]
        level = frames / levels if self._lamp else frames - levels
        self._reference, deviation = median_and_deviation(level)
        sigma = scale * deviation
        seen = lit(self._reference) if self._lamp else np.ones(sigma.shape, np.bool_)
        self._sigma = finite_median(sigma[seen])
        if len(frames) == 2:
            # Two samples show neither which is wrong nor their own noise: the noise of the tile
            # decides, and of two that disagree the lower one is right, because particles only add
            # charge.
            usual = math.sqrt(2) * math.hypot(self._sigma, self._quantum)
            apart = np.ptp(level, axis=0) > self._clip * usual + self._quantum
            self._reference = np.where(apart, level.min(axis=0), self._reference)
            sigma = np.full_like(sigma, self._sigma)
        sigma = np.maximum(sigma, np.float32(self._sigma))
        rounding = np.float32(self._quantum) + _ROUNDING * np.abs(self._reference)
        # The median deviation of integers may be zero.
        self._limit = np.float32(self._clip) * np.hypot(sigma, np.float32(self._quantum)) + rounding
        self._sums = np.zeros((6, *frames.shape[1:]))

    def _common(self, samples: F32, reference: F32) -> F32:
        """Factor or offset of each frame (t, n) to the reference (n,), by the median."""
        if not self._lamp:
            return np.array([finite_median(s - reference) for s in samples], np.float32)
        level = finite_median(reference[lit(reference)])
        if not level > 3 * self._sigma or level <= 0:
            # Too dark here to see the lamp.
            return np.ones(len(samples), np.float32)
        bright = reference >= level
        ratios = (finite_median(s[bright] / reference[bright]) for s in samples)
        return np.array([r if r > 0 else np.nan for r in ratios], np.float32)


def lit(signal: NDArray[Any]) -> Mask:
    """Lit pixels of a tile, without an overscan."""
    some = _some(signal[None])[0]
    finite = some[np.isfinite(some)]
    rank = int(_BRIGHT * finite.size)
    bright = float(np.partition(finite, rank)[rank]) if finite.size else np.inf
    return np.asarray(signal > _LIT * bright)


def _some(frames: NDArray[Any]) -> NDArray[Any]:
    """Samples (t, n) of some pixels of frames (t, ...), the same in each."""
    # An odd stride meets all columns, whatever pattern they have.
    stride = (frames[0].size // _LEVEL_PIXELS) | 1
    return np.ascontiguousarray(frames.reshape(len(frames), -1)[:, ::stride])
