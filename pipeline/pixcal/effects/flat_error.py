"""A flat that is not the pixels' response to the light of the fringes.

Waves of random direction and one length make a ring in the power that two maps share. Each scale,
the wavelength over 2 pi, gives a template of such waves on the window, less a parabola; with white
power beside it, it is fitted to the cross power of two maps of independent noise.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import j0

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.maps.map_fit import (
    gauge_terms,
    half_theta,
    neighbour_products,
    polynomial,
    without,
)
from pixcal.kernels.beams import LightMaps
from pixcal.kernels.robust import robust_sigma
from pixcal.kernels.scene import TILE, DetectorMaps, Rows, chip_map
from pixcal.kernels.significance import root_with_error
from pixcal.model.arrays import F32, F64, Mask
from pixcal.model.bench import SimulatedDetector
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording

WAVES = 6  # plane waves that make up the smooth part
SMOOTH_SEEN = 3.0  # significance of the smooth part above which its scale is fitted
AGREE = 3.0  # standard deviations within which waves of one length explain the smooth part
_CLIP = 5.0
_MIN_PIXELS = 200
_MIN_FRAMES = 8
SHORTEST = 1.25  # shortest scale, px: crests of shorter waves are a few pixels apart
# ratio of the window's width to the longest scale: longer waves resemble parabolas
WIDEST = 4
STEP = 0.1  # step of the logarithm of the trial scales
# ratio of the window's width to a scale above which the removed parabola does not matter
NARROW = 12
# error of a wave's phase across the window, rad; larger in windows below `FEW` scales, where it
# depends on the position of few crests, and a parabola absorbs much
APART, FEW_APART, FEW = 0.5, 2.0, 10
DIRECTIONS = 16  # directions of longer waves, whose ring has few resolution elements
EDGE = 0.02  # power at the edge of the ring, over the template's highest power
_PARABOLA = 2


@dataclass(frozen=True)
class FlatError(Effect):
    """The response in the fringe frames differs from that in the flats.

    The pattern belongs to the chip, so maps do not hold what `predict` would need.
    """

    name = "flat_error"
    title = "flat field that does not match the fringe frames"
    acts_at = Stage.PIXEL
    order = 2
    domains = ("space",)
    strengths = ("pixel_rms", "smooth_rms")
    absorbed_because = "it scales level and fringes of a pixel equally and leaves the phase"
    frames_needed = ("flat", "axis")
    sources = (
        "EMVA Standard 1288, release 4.0 (2021): nonuniformity is stated with the wavelength and "
        "f-number of its light",
        "Stubbs & Tonry 2006, ApJ 646, 1436: flats of a broad band are not those of a narrow one; "
        "a per cent is common",
    )

    pixel_rms: float = quantity(0.002, low=0, high=0.5, doc="relative rms from pixel to pixel")
    smooth_rms: float = quantity(0.005, low=0, high=0.5, doc="relative rms of the smooth part")
    scale_px: float = quantity(
        8.0, unit="px", above=1, high=1e5, doc="length scale of the smooth part: wavelength / 2 pi"
    )

    def ratio(self, detector: SimulatedDetector, rows: Rows) -> F32:
        """Response to the fringes over the flat (y, x), on rows of the window."""
        pixels = chip_map(detector, rows, self.name, lambda rng: rng.standard_normal(TILE))
        error = self.pixel_rms * pixels + self.smooth_rms * self._smooth(detector, rows)
        return np.asarray(np.maximum(1 + error, 0), np.float32)

    def _smooth(self, detector: SimulatedDetector, rows: Rows) -> F64:
        """Waves of random direction and phase, rms one, fixed to the chip."""
        rng = np.random.default_rng([detector.seed, WAVES])
        direction, phase = 2 * np.pi * rng.random((2, WAVES))
        y = np.arange(*rows)[:, None] + detector.origin[0]
        x = np.arange(detector.shape[1]) + detector.origin[1]
        waves = [
            np.cos((np.cos(d) * x + np.sin(d) * y) / self.scale_px + p)
            for d, p in zip(direction, phase, strict=True)
        ]
        return np.asarray(np.sum(waves, axis=0) * np.sqrt(2 / WAVES))

    def pixels(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        if recording.kind != "fringes":
            return light
        ratio = self.ratio(recording.bench.detector, rows)
        return LightMaps(light.iota * ratio, light.alpha_sin * ratio, light.alpha_cos * ratio)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """What iota and alpha share, divided by flats, beyond their light's shape."""
        flats = _two_flats(evidence)
        sets = [f for f in evidence.fringes.values() if len(f.g) >= _MIN_FRAMES]
        good = evidence.good & np.all([f.good for f in sets], axis=0)
        if flats is None or not sets or np.count_nonzero(good) < _MIN_PIXELS:
            return None
        good &= (flats[0] > 0) & (flats[1] > 0)
        iotas, alphas = zip(*(_structure(f, evidence.flat, flats, good) for f in sets), strict=True)
        n = len(sets)
        pairs = [(iotas[i], alphas[j]) for i in range(n) for j in range(n) if i != j or n == 1]
        weight = int(np.count_nonzero(good))
        near = np.mean([neighbour_products(a, b, good) for a, b in pairs], axis=0)
        # Mean cross power (y, x); its sum is the mean product of the good pixels.
        products = [(np.fft.fft2(a) * np.conj(np.fft.fft2(b))).real for a, b in pairs]
        ring = ring_power(np.asarray(np.mean(products, axis=0) / (weight * pairs[0][0].size)))
        all_of_it, neighbours = near[0][good], ((4 * near[1] - near[2]) / 3)[good]
        alone = float((all_of_it - neighbours).std() / np.sqrt(weight))
        smooth, noise, smooth_error = _smooth(neighbours, ring)
        rms, errors = root_with_error(
            np.array([all_of_it.mean() - smooth, smooth]),
            np.array([np.hypot(alone, noise), smooth_error]),
        )
        pixel, whole = (min(float(v), 0.5) for v in rms)
        waves = ring.variance > SMOOTH_SEEN * ring.noise
        return Estimate(
            cls(pixel, whole, ring.scale if waves else cls().scale_px),
            {"pixel_rms": float(errors[0]), "smooth_rms": float(errors[1])}
            | ({"scale_px": ring.scale_error} if waves else {}),
            float(all_of_it.mean() / all_of_it.std() * np.sqrt(weight)),
            "structure common to mean light and fringe amplitude after division by the flat",
        )


def _two_flats(evidence: Evidence) -> tuple[F64, F64] | None:
    """Flats (y, x) from every other frame and from the rest, e-; None with too few."""
    halves = [np.zeros(evidence.good.shape), np.zeros(evidence.good.shape)]
    count = 0
    for stack in evidence.of_kind("flat"):
        seconds = stack.exptime_s if np.isfinite(stack.exptime_s) else 0.0
        if len(stack.adu) < 2 or np.median(stack.adu) >= evidence.saturation_adu:
            continue
        for n in (0, 1):
            frames = stack.adu[n::2].astype(float)
            halves[n] += frames.sum(axis=0) - len(frames) * evidence.bias
            halves[n] -= len(frames) * evidence.dark_rate * seconds / evidence.gain
        count += len(stack.adu)
    return (halves[0], halves[1]) if count >= _MIN_FRAMES else None


def _structure(
    found: FringeEvidence, flat: F64, flats: tuple[F64, F64], good: Mask
) -> tuple[F64, F64]:
    """Logarithms of iota and alpha over the flats minus smooth terms, each from half the frames."""
    free = np.concatenate([polynomial(good.shape, 2), gauge_terms(found)])[:, good].T
    maps = []
    for n in (0, 1):
        theta = half_theta(found, n, good)
        size = theta[0] if n == 0 else np.hypot(theta[1], theta[2])
        ratio = np.log(np.maximum(size * flat[good] / flats[n][good], 1e-12))
        rest = without(ratio[:, None], free)[:, 0]
        limit = _CLIP * robust_sigma(rest - np.median(rest))
        out = np.zeros(good.shape)
        out[good] = np.where(np.abs(rest) < limit, rest, 0.0)
        maps.append(out)
    return maps[0], maps[1]


def _smooth(neighbours: F64, ring: "Ring") -> tuple[float, float, float]:
    """Variance of the smooth part, its error by noise, and its error as a sample of its kind."""
    # From the covariance of neighbours; from waves of one length if these explain it, as they are
    # better known.
    variance, noise = float(neighbours.mean()), float(neighbours.std() / np.sqrt(neighbours.size))
    if abs(ring.variance - variance) < AGREE * np.hypot(noise, ring.noise):
        return ring.variance, ring.noise, ring.error
    return variance, noise, float(np.hypot(noise, ring.error))


@dataclass(frozen=True)
class Ring:
    """Waves of one length common to two maps."""

    # variance, noise: of the waves in this window, with the part that a parabola absorbs; error
    variance: float
    noise: float
    # error of the variance as that of all waves of the kind, as a window holds few modes
    error: float
    # scale, scale_error: wavelength over 2 pi, px; the error is infinite without waves
    scale: float
    scale_error: float


def ring_power(power: F64) -> Ring:
    """Fit a ring to the cross power (y, x) of two maps: ``fft2(a) * conj(fft2(b))`` over px²."""
    shape = (power.shape[0], power.shape[1])
    scales, templates = _templates(shape)
    white = np.full(power.size, 1 / power.size)
    data = power.ravel()
    fits = [np.linalg.lstsq(np.stack([white, t], axis=1), data, rcond=None)[0] for t in templates]
    # Waves with negative power count as zero.
    both = zip(fits, templates, strict=True)
    left = [np.sum((data - c[0] * white - max(c[1], 0.0) * t) ** 2) for c, t in both]
    best = int(np.clip(np.argmin(left), 1, len(scales) - 2))
    variance, noise, modes = _sum_of_ring(data, templates[best])
    if variance <= 0:
        return Ring(variance, noise, noise, float(scales[best]), np.inf)
    slope = (templates[best + 1] - templates[best - 1]) / (2 * STEP)
    design = np.stack([white, templates[best], float(fits[best][1]) * slope], axis=1)
    unit = np.sqrt((design**2).sum(axis=0)) + 1e-300
    rows = np.linalg.pinv(design / unit, rcond=1e-8) / unit[:, None]
    projected = rows @ data
    # Waves fill the ring unevenly, so their scatter about it gives the error (Huber's sandwich),
    # which the resolution of the window limits.
    width = float(np.sqrt(2 * ((rows[2] * (data - design @ projected)) ** 2).sum()))
    scale = float(scales[best] * np.exp(np.clip(projected[2], -STEP, STEP)))
    apart = FEW_APART if scale * FEW > min(shape) else APART
    width = min(float(np.hypot(width, apart * scale / min(shape))), 0.75)
    # Error of the wavelength, larger towards longer wavelengths.
    width /= 1 - width
    # Relative to the expected variance, which may be larger than the measured one.
    draws = min(float(np.sqrt(2 / modes)), 0.75)
    error = float(np.hypot(noise, variance * draws / (1 - draws)))
    # A parabola absorbs more of longer waves.
    places = np.clip([best - width / STEP, best + width / STEP], 0, len(scales) - 1)
    ends = [_sum_of_ring(data, templates[int(n)])[0] for n in np.rint(places)]
    error = float(np.hypot(error, np.mean(np.abs(np.array(ends) - variance))))
    return Ring(variance, noise, error, scale, scale * width)


def _sum_of_ring(data: F64, template: F64) -> tuple[float, float, float]:
    """Variance of the waves from the ring's total power, its error by noise, number of modes."""
    # Waves fill the ring unevenly, which does not affect the sum. Modes k and -k of a real map
    # are equal.
    inside = template > EDGE * template.max()
    white, noise = float(data[~inside].mean()), float(data[~inside].var())
    power, share = float((data[inside] - white).sum()), float(template[inside].sum())
    # The waves' own power beats with the noise.
    spread = 2 * np.count_nonzero(inside) * noise + max(power, 0.0) * np.sqrt(2 * noise)
    modes = share**2 / float((template[inside] ** 2).sum())
    return power / share, max(float(np.sqrt(spread)) / share, 1e-300), modes


@lru_cache(maxsize=4)
def _templates(shape: tuple[int, int]) -> tuple[F64, F64]:
    """Scales (n,) and the mean power (n, y * x) of waves of unit variance on a window."""
    longest = max(min(shape) / WIDEST, SHORTEST * np.exp(4 * STEP))
    scales = np.exp(np.arange(np.log(SHORTEST), np.log(longest), STEP))
    short = [_of_short_waves(shape, s) for s in scales if s < min(shape) / NARROW]
    long = [_of_long_waves(shape, s) for s in scales[len(short) :]]
    return scales, np.stack([*short, *long]).reshape(len(scales), -1)


def _of_short_waves(shape: tuple[int, int], scale: float) -> F64:
    """Mean power (y, x) of all directions: the transform of a Bessel function."""
    ny, nx = shape
    dy, dx = np.arange(1 - ny, ny)[:, None], np.arange(1 - nx, nx)
    products = (1 - abs(dy) / ny) * (1 - abs(dx) / nx) * j0(np.hypot(dy, dx) / scale)
    wrapped = np.zeros(shape)
    np.add.at(wrapped, (dy % ny, dx % nx), products)
    return np.asarray(np.fft.fft2(wrapped).real / wrapped.size)


def _of_long_waves(shape: tuple[int, int], scale: float) -> F64:
    """Mean power (y, x) of waves of several directions, each minus its fitted parabola."""
    free = polynomial(shape, _PARABOLA).reshape(-1, shape[0] * shape[1]).T
    y, x = np.mgrid[: shape[0], : shape[1]].reshape(2, -1).astype(float)
    angle = np.pi * (np.arange(DIRECTIONS) + 0.5) / DIRECTIONS
    phase = (np.outer(x, np.cos(angle)) + np.outer(y, np.sin(angle))) / scale
    waves = without(np.sqrt(2) * np.hstack([np.cos(phase), np.sin(phase)]), free)
    power = np.abs(np.fft.fft2(waves.T.reshape(-1, *shape))) ** 2
    return np.asarray(power.mean(axis=0) / y.size**2)
