"""Hits of particles: upward outliers in single frames, grouped, counted and classified."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy import ndimage
from scipy.special import ndtr

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_count
from pixcal.model.arrays import F32, F64, I64, Mask

THRESHOLD = 6.5  # standard deviations of the noise above which a sample is an outlier
JOINED = 3.0  # standard deviations above which a sample joins an outlier near it
# classes of hits: number of outlying samples, in all and next to the brightest, and brightness over
# the faintest outlier
SIZES = (1.5, 2.5, 4.5, 8.5)
NEAR = (1.5, 2.5, 3.5, 5.5)
BRIGHTNESS = (1.25, 1.6, 2.0, 2.8, 4.0, 8.0)
MIN_FRAMES = 3
OFTEN = 2
# number of noise outliers over that of a Gaussian, as shot noise of faint light is skewed
SKEW = 5.0
# recurrent hits on the same pixels, over those by chance, and as a share of all hits
AGAIN, SHARE_AGAIN = 2.0, 0.1
STEPS = 300  # most steps of the maximisation
LEAST_EXPECTED = 1e-6


@dataclass(frozen=True)
class Hits:
    """Detected hits (n,)."""

    peaks: F64  # brightest sample, e-
    sizes: F64  # sizes, near: number of outlying samples, in all and within a pixel of the peak
    near: F64
    # frames and pixels of the brightest samples, if known
    frames: F64 = field(default_factory=lambda: np.zeros(0))
    pixels: F64 = field(default_factory=lambda: np.zeros(0))

    def classes(self, faintest: float) -> tuple[F64, F64]:
        """Number of hits of each size and brightness, and of each size and width."""
        size = np.digitize(self.sizes, SIZES)
        counts = []
        for other, edges in ((self.peaks / faintest, BRIGHTNESS), (self.near, NEAR)):
            kinds = len(edges) + 1
            number = size * kinds + np.digitize(other, edges)
            counts.append(np.bincount(number, minlength=(len(SIZES) + 1) * kinds).astype(float))
        return counts[0], counts[1]


@dataclass(frozen=True)
class HitSearch:
    """Outliers of a sequence of frames."""

    seconds: float  # exposure time, s
    area: float  # of all samples, cm²
    samples: int
    limit: float  # sigmas above which a sample is an outlier
    hits: Hits  # upward outliers
    downwards: int  # number of downward outliers
    sigma: F32  # (t, y, x) noise of the samples, e-; NaN for excluded ones
    faintest: float  # usual charge above which a sample is an outlier, e-


def hit_searches(evidence: Evidence) -> Iterator[HitSearch]:
    """Outliers of the fringe sets, and of bias and dark frames."""
    area = (evidence.pitch_um * 1e-4) ** 2
    for f in evidence.fringes.values():
        # As in `CosmicHits.charge`.
        seconds = f.exptime_s if f.exptime_s > 0 else float(np.median(np.diff(f.time_s)))
        # Include pixels with a bad fit: the strongest hits cause one.
        residual = np.where(evidence.good & np.isfinite(f.theta).all(axis=0), f.residual, np.nan)
        yield _searched(residual, np.sqrt(f.variance), seconds, area)
    for stack in (*evidence.of_kind("bias"), *evidence.of_kind("dark")):
        if len(stack.adu) >= MIN_FRAMES:
            seconds = 0.0 if stack.kind == "bias" else np.nan_to_num(stack.exptime_s)
            yield _searched(*evidence.dark_noise(stack), seconds, area)


def _searched(residual: F32, sigma: F32, seconds: float, area: float) -> HitSearch:
    """Outliers of residuals (t, y, x) of given sigma; ``area`` of a pixel, cm²."""
    ratio = residual / sigma
    usable = np.isfinite(ratio)
    # Ratio of actual to predicted noise, from every seventh sample.
    wide = robust_sigma(ratio.ravel()[::7])
    limit = np.float32(THRESHOLD * np.fmax(wide, 1.0))
    up, down = ratio > limit, ratio < -limit
    often = np.count_nonzero(up | down, axis=0) > OFTEN
    up &= ~often
    down &= ~often
    least = limit * np.float32(JOINED / THRESHOLD)
    n = int(np.count_nonzero(usable))
    return HitSearch(
        seconds,
        area * ratio.size,
        n,
        float(limit),
        grouped_hits(up, ratio > least, residual),
        len(grouped_hits(down, ratio < -least, -residual).peaks),
        np.where(usable, sigma, np.float32(np.nan)),
        float(limit * np.median(sigma)),
    )


def hit_counts(searches: Sequence[HitSearch]) -> tuple[F64, F64]:
    """Number of hits of each search, and that expected by chance."""
    by_chance = [max(SKEW * s.samples * float(ndtr(-THRESHOLD)), s.downwards) for s in searches]
    return np.array([float(len(s.hits.peaks)) for s in searches]), np.array(by_chance)


def significance_of_hits(searches: Sequence[HitSearch]) -> float:
    """Significance (sigmas) of all hits over those expected by chance."""
    counts, chances = hit_counts(searches)
    return sigmas_of_count(int(counts.sum()), float(chances.sum()))


def grouped_hits(outliers: Mask, joined: Mask, residual: F32) -> Hits:
    """Groups of adjacent outliers in a frame, with fainter samples that join them."""
    hits = []
    for frame in np.flatnonzero(outliers.any(axis=(1, 2))):
        bright = joined[frame] | outliers[frame]
        labels, _ = ndimage.label(ndimage.binary_dilation(bright, np.ones((3, 3))), np.ones((3, 3)))
        rows, columns = np.nonzero(bright)
        groups = labels[rows, columns]
        for group in np.unique(labels[outliers[frame]]):
            y, x = rows[groups == group], columns[groups == group]
            charge = residual[frame, y, x]
            at = int(charge.argmax())
            near = (abs(y - y[at]) <= 1) & (abs(x - x[at]) <= 1)
            pixel = y[at] * residual.shape[2] + x[at]
            hits.append((float(charge[at]), len(y), np.count_nonzero(near), frame, pixel))
    return Hits(*np.array(hits, float).reshape(-1, 5).T)


def _hits_per_pixel(hits: Hits, shape: tuple[int, ...]) -> tuple[I64, I64]:
    """Hits on each pixel in the first and the second half of frames (t, y, x)."""
    count, pixels = shape[0], hits.pixels.astype(np.int64)
    late = 2 * hits.frames >= count
    size = shape[1] * shape[2]
    return np.bincount(pixels[~late], minlength=size), np.bincount(pixels[late], minlength=size)


def recur(searches: Sequence[HitSearch]) -> bool:
    """Whether hits recur on the same pixels far more often than by chance."""
    parts = np.stack(
        [part for s in searches for part in _hits_per_pixel(s.hits, s.sigma.shape)]
    ).astype(float)

    def pairs(counts: F64) -> F64:
        return np.asarray((counts.sum(axis=0) ** 2 - (counts**2).sum(axis=0)) / 2)

    seen, hits = float(pairs(parts).sum()), float(parts.sum())
    by_chance = float(pairs(parts.sum(axis=1))) / parts.shape[1]
    more, chance = seen - AGAIN * by_chance, np.sqrt(AGAIN * by_chance + 1)
    return bool(more > SIGNIFICANT * chance and more > SHARE_AGAIN * hits)


def hit_rates(counts: F64, chances: F64, exposures: F64) -> tuple[list[float], list[float]]:
    """Hits (n,) per exposure of both kinds, and errors; the second is zero unless significant."""
    fits: list[tuple[F64, F64]] = []
    for own in (exposures[:1], exposures):
        # Maximum of the likelihood of Poisson counts, by expectation and maximisation.
        total = own.sum(axis=1)
        rates = counts.sum() / total / len(own)
        for _ in range(STEPS):
            rates = (
                rates * (own @ (counts / np.maximum(rates @ own + chances, LEAST_EXPECTED))) / total
            )
        fits.append((rates, np.maximum(rates @ own + chances, LEAST_EXPECTED)))
    (_, one), (_, both) = fits
    gain = 2 * float((counts * np.log(both / one) - both + one).sum())
    used = 1 + (gain > SIGNIFICANT**2) if len(exposures) > 1 else 1
    rates, expected = fits[used - 1]
    # The posterior of a rate, without prior, has one hit more: few hits constrain it poorly.
    normal = exposures[:used] @ (exposures[:used] / (expected + 1 / len(counts))).T
    errors = np.sqrt(np.diag(np.linalg.inv(normal)))
    return [*rates.tolist(), 0.0][: len(exposures)], errors.tolist()
