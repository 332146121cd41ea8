"""Reduce maps of any size to the contents of a figure, in one pass over bands of rows.

A map of 46 Mpix does not fit on a page: it is shown as means of n × n pixels. Profiles and counts
use all pixels; spectra use windows spread over the map.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from math import gcd
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels.medians import median_and_sigma
from pixcal.model.arrays import F32, F64, I64, U8, Mask, Source

SHOWN_PIXELS = 400  # most blocks along the longer side of a map on the page
SAMPLE = 1_000_000  # most pixels of a histogram
BAND_ROWS = 128  # rows read at a time: one row of chunks
SEGMENT = 256  # longest side of the windows whose power spectra are averaged
DETAIL = 96  # side of the window that is shown pixel by pixel when the whole map cannot be


@dataclass(frozen=True)
class ArraySource:
    """A map in memory as a `Source`."""

    values: NDArray[Any]

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return self.values.shape

    def read(self, *ranges: tuple[int, int]) -> NDArray[Any]:
        """A block."""
        return self.values[tuple(slice(*r) for r in ranges)]


@dataclass(frozen=True)
class RatioSource:
    """One map over another; NaN where the divisor is not positive."""

    above: Source
    below: Source

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return self.above.shape

    def read(self, *ranges: tuple[int, int]) -> F32:
        """A block."""
        return _ratio(self.above.read(*ranges), self.below.read(*ranges)).astype(np.float32)


@dataclass(frozen=True)
class Profile:
    """Means of a map along one axis."""

    mean: F64  # (n,) NaN where no pixel is good
    scatter: F64  # (n,) standard deviation of the pixels that were averaged
    count: I64  # (n,) number of averaged pixels


@dataclass(frozen=True)
class MapSummary:
    """Contents of a figure of a map."""

    shape: tuple[int, int]  # of the map, pixels
    block: int  # side of the blocks of pixels that `image` averages
    image: F32  # (y, x) mean of the finite pixels of each block; NaN where there are none
    # columns, rows: mean of each column (over y) and of each row (over x), in whole resolution
    columns: Profile
    rows: Profile
    sample: F32  # (n,) finite pixels at regular steps: all of them up to `SAMPLE`
    mean: float  # mean, std: of all finite pixels
    std: float

    @property
    def median(self) -> float:
        """Median of the sample; NaN where there is none."""
        return float(np.median(self.sample)) if len(self.sample) else float("nan")

    @property
    def robust_std(self) -> float:
        """Standard deviation by the median absolute deviation, which few outliers do not move."""
        return median_and_sigma(self.sample)[1]


def block_side(shape: tuple[int, ...], most: int = SHOWN_PIXELS) -> int:
    """Side of the square blocks that leave at most ``most`` along the longer axis."""
    return max(1, -(-max(shape) // most))


def block_mean(values: NDArray[Any], side: int) -> F32:
    """Means (float32) of side × side pixels, smaller at the far edges, of finite values (y, x)."""
    total, count = _block_sums(values, np.isfinite(values), side)
    return _ratio(total, count).astype(np.float32)


def _block_sums(values: NDArray[Any], good: Mask, side: int) -> tuple[F64, F64]:
    edges = [np.arange(0, n, side) for n in values.shape]

    def sums(data: NDArray[Any]) -> F64:
        across = np.add.reduceat(data, edges[1], axis=1, dtype=float)
        return np.asarray(np.add.reduceat(across, edges[0], axis=0))

    return sums(np.where(good, values, 0)), sums(good)


def _ratio(above: NDArray[Any], below: NDArray[Any]) -> F64:
    return np.asarray(np.divide(above, below, out=np.full(above.shape, np.nan), where=below > 0))


def bands(source: Source, side: int = 1) -> Iterator[tuple[int, NDArray[Any]]]:
    """First row and values of bands of rows whose height is a multiple of ``side``."""
    ny, nx = source.shape
    height = side * max(1, BAND_ROWS // side)
    for y0 in range(0, ny, height):
        yield y0, source.read((y0, min(y0 + height, ny)), (0, nx))


def summarise(source: Source, most: int = SHOWN_PIXELS) -> MapSummary:
    """Summarise a map in at most ``most`` blocks a side; non-finite values are masked."""
    ny, nx = source.shape
    side = block_side((ny, nx), most)
    step = _sample_step(ny * nx, nx)
    image, samples = [], []
    columns = np.zeros((3, nx))
    rows = np.zeros((3, ny))
    # Sums are relative to a first value, to avoid cancellation of nearly equal pixels.
    origin: float | None = None
    for y0, values in bands(source, side):
        good = np.isfinite(values)
        if origin is None and good.any():
            origin = float(np.median(values[good]))
        rest = np.where(good, values, origin or 0.0).astype(float) - (origin or 0.0)
        total, count = _block_sums(rest, good, side)
        image.append(_ratio(total, count) + (origin or 0.0))
        columns += [good.sum(axis=0), rest.sum(axis=0), (rest**2).sum(axis=0)]
        rows[:, y0 : y0 + len(values)] = [good.sum(axis=1), rest.sum(axis=1), (rest**2).sum(axis=1)]
        picked = values.ravel()[-(y0 * nx) % step :: step]
        samples.append(picked[np.isfinite(picked)].astype(np.float32))
    count, total, square = columns.sum(axis=1)
    mean = total / count if count else np.nan
    variance = square / count - mean**2 if count else np.nan
    return MapSummary(
        shape=(ny, nx),
        block=side,
        image=np.concatenate(image).astype(np.float32),
        columns=_profile(columns, origin or 0.0),
        rows=_profile(rows, origin or 0.0),
        sample=np.concatenate(samples),
        mean=float(mean + (origin or 0.0)),
        std=float(np.sqrt(np.maximum(variance, 0.0))),
    )


def _sample_step(pixels: int, nx: int) -> int:
    """Step through the pixels in reading order that visits all columns equally often."""
    step = -(-pixels // SAMPLE)
    while gcd(step, nx) != 1:
        step += 1
    return step


def _profile(sums: F64, origin: float) -> Profile:
    count, total, square = sums
    mean = _ratio(total, count)
    with np.errstate(invalid="ignore"):
        scatter = np.sqrt(np.maximum(_ratio(square, count) - mean**2, 0.0))
    return Profile(mean + origin, scatter, count.astype(np.int64))


@dataclass(frozen=True)
class Spectrum:
    """Power spectral density of a map."""

    # (my, mx) px² per (cycle/px)², zero frequency in the middle; its mean is the map's variance
    power: F64
    white: float  # power expected from the map's errors alone, at every frequency
    windows: int  # windows averaged

    @property
    def frequencies(self) -> tuple[F64, F64]:
        """Frequencies along y and x, cycles/px."""
        my, mx = self.power.shape
        return np.fft.fftshift(np.fft.fftfreq(my)), np.fft.fftshift(np.fft.fftfreq(mx))

    def radial(self) -> tuple[F64, F64]:
        """Frequency and mean power of rings, up to half a cycle per pixel."""
        fy, fx = self.frequencies
        radius = np.hypot(fy[:, None], fx[None, :])
        n = max(1, min(self.power.shape) // 2)
        edges = np.linspace(0, 0.5, n + 1)
        ring = np.digitize(radius.ravel(), edges) - 1
        inside = (ring < n) & (radius.ravel() > 0)
        count = np.bincount(ring[inside], minlength=n)
        total = np.bincount(ring[inside], self.power.ravel()[inside], minlength=n)
        middle = (edges[1:] + edges[:-1]) / 2
        return middle[count > 0], total[count > 0] / count[count > 0]


def spectrum(delta: Source, sigma: Source) -> Spectrum | None:
    """Mean power spectrum of windows spread over a map (px, NaN masked); None without good pixels.

    Each window is tapered (sine squared) and masked pixels count as zero, both of which the
    normalisation takes into account; spectra of independent errors stay flat.
    """
    my, mx = (min(SEGMENT, n) for n in delta.shape)
    taper = _taper(my)[:, None] * _taper(mx)[None, :]
    power, white, norm, windows = np.zeros((my, mx)), 0.0, 0.0, 0
    for y0 in _starts(delta.shape[0], my):
        for x0 in _starts(delta.shape[1], mx):
            place = (y0, y0 + my), (x0, x0 + mx)
            values, error = delta.read(*place).astype(float), sigma.read(*place).astype(float)
            good = np.isfinite(values) & np.isfinite(error)
            weight = np.where(good, taper, 0.0)
            if not weight.any():
                continue
            values, error = np.where(good, values, 0.0), np.where(good, error, 0.0)
            values = weight * (values - (weight * values).sum() / weight.sum())
            power += np.abs(np.fft.fft2(values)) ** 2
            white += float((weight**2 * error**2).sum())
            norm += float((weight**2).sum())
            windows += 1
    if not windows:
        return None
    return Spectrum(np.fft.fftshift(power) / norm, white / norm, windows)


def _taper(n: int) -> F64:
    return np.asarray(np.sin(np.pi * (np.arange(n) + 0.5) / n) ** 2)


def _starts(size: int, window: int) -> list[int]:
    number = min(6, -(-size // window))
    return [round(v) for v in np.linspace(0, size - window, number)]


@dataclass(frozen=True)
class Detail:
    """The middle of a map, pixel by pixel."""

    start: tuple[int, int]  # first row and column
    delta: MapSummary
    sigma: MapSummary


def detail(delta: Source, sigma: Source) -> Detail:
    """The middle of a map and of its errors."""
    ny, nx = delta.shape
    my, mx = min(DETAIL, ny), min(DETAIL, nx)
    y0, x0 = (ny - my) // 2, (nx - mx) // 2
    parts = (source.read((y0, y0 + my), (x0, x0 + mx)) for source in (delta, sigma))
    return Detail((y0, x0), *(summarise(ArraySource(part), DETAIL) for part in parts))


@dataclass(frozen=True)
class FlagSummary:
    """Contents of a figure of a map of flags."""

    shape: tuple[int, int]
    block: int
    image: U8  # (y, x) flags of any pixel of each block
    share: F32  # (y, x) share of each block's pixels that have any flag
    masked: int  # pixels with any flag
    counts: dict[int, int] = field(default_factory=dict)  # pixels that have each bit set


def summarise_flags(source: Source, most: int = SHOWN_PIXELS) -> FlagSummary:
    """Summarise a map of flags (uint8 bits)."""
    ny, nx = source.shape
    side = block_side((ny, nx), most)
    columns = np.arange(0, nx, side)
    image, share, by_value = [], [], np.zeros(256, np.int64)
    for _, values in bands(source, side):
        flags = values.astype(np.uint8)
        across = np.bitwise_or.reduceat(flags, columns, axis=1)
        image.append(np.bitwise_or.reduceat(across, np.arange(0, len(flags), side), axis=0))
        share.append(block_mean((flags != 0).astype(float), side))
        by_value += np.bincount(flags.ravel(), minlength=256)
    value = np.arange(256)
    counts = {1 << bit: int(by_value[(value >> bit & 1) == 1].sum()) for bit in range(8)}
    return FlagSummary(
        shape=(ny, nx),
        block=side,
        image=np.concatenate(image),
        share=np.concatenate(share),
        masked=int(by_value[1:].sum()),
        counts=counts,
    )
