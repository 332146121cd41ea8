"""A flat that differs from the response of the pixels to the light of the fringes.

Its smooth part is fitted as waves of one length (`ring_power`). A pattern of another form, such as
interference in the window of the sensor, is measured as the Fourier modes in which both maps stand
out and agree.
"""

from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.maps import map_fit
from pixcal.estimators.maps.ring_power import Ring, ring_power
from pixcal.kernels.beams import LightMaps
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.scene import TILE, DetectorMaps, Rows, chip_map
from pixcal.kernels.significance import root_with_error
from pixcal.model.arrays import F32, F64, Mask
from pixcal.model.bench import SimulatedDetector
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording

WAVES = 6  # plane waves that make up the smooth part
SMOOTH_SEEN = 3.0  # significance of the smooth part above which its scale is fitted
AGREE = 3.0  # standard deviations within which waves of one length explain the smooth part
_CLIP = 5.0
_MIN_PIXELS = 200
_MIN_FRAMES = 8
# power of a mode of the measured pattern, over that of noise and pixels: chance exceeds it once in
# 8,000 modes
STANDS_OUT = 9.0
_WAVES = ("wave_x_rad_px", "wave_y_rad_px", "wave_cos", "wave_sin")  # numbers of each wave


@dataclass(frozen=True)
class FlatError(Effect):
    """The response in the fringe frames differs from that in the flats.

    The pattern belongs to the chip, so the maps lack what `predict` would need.
    """

    name = "flat_error"
    title = "flat field that does not match the fringe frames"
    acts_at = Stage.PIXEL
    order = 2
    domains = ("space",)
    strengths = ("pixel_rms", "smooth_rms", "wave_cos", "wave_sin")
    absorbed_because = (
        "it scales level and fringes of a pixel equally and does not change the phase"
    )
    frames_needed = ("flat", "axis")
    sources = (
        "EMVA Standard 1288, release 4.0 (2021): nonuniformity is stated with the wavelength and "
        "f-number of its light",
        "Stubbs & Tonry 2006, ApJ 646, 1436: flats of a broad band are not those of a narrow one; "
        "a per cent is common",
    )

    pixel_rms: float = quantity(0.002, low=0, high=0.5)
    """relative rms from pixel to pixel"""
    smooth_rms: float = quantity(0.005, low=0, high=0.5)
    """relative rms of the smooth part"""
    scale_px: float = quantity(8.0, unit="px", above=1, high=1e5)
    """length scale of the smooth part: wavelength / 2 pi"""
    wave_x_rad_px: tuple[float, ...] = quantity((), unit="rad/px", low=-7, high=7)
    """wave vectors of a measured pattern, along x"""
    wave_y_rad_px: tuple[float, ...] = quantity((), unit="rad/px", low=-7, high=7)
    """wave vectors of a measured pattern, along y"""
    wave_cos: tuple[float, ...] = quantity((), low=-0.5, high=0.5)
    """cosine amplitudes of these waves, from the chip's first pixel"""
    wave_sin: tuple[float, ...] = quantity((), low=-0.5, high=0.5)
    """sine amplitudes"""

    def __post_init__(self) -> None:
        if len({len(getattr(self, name)) for name in _WAVES}) > 1:
            raise InputError(
                f"{', '.join(_WAVES)}: give the same number of values for each, one per wave"
            )

    def ratio(self, detector: SimulatedDetector, rows: Rows) -> F32:
        """Response to the fringes over the flat (y, x), on rows of the window."""
        pixels = chip_map(detector, rows, self.name, lambda rng: rng.standard_normal(TILE))
        error = self.pixel_rms * pixels + self.smooth_rms * self._smooth(detector, rows)
        if self.wave_cos:
            error += self._measured(detector, rows)
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

    def _measured(self, detector: SimulatedDetector, rows: Rows) -> F64:
        y = np.arange(*rows) + detector.origin[0]
        x = np.arange(detector.shape[1]) + detector.origin[1]
        sizes = np.array(self.wave_cos) - 1j * np.array(self.wave_sin)
        along_y = np.exp(1j * np.outer(y, self.wave_y_rad_px)) * sizes
        return np.asarray((along_y @ np.exp(1j * np.outer(self.wave_x_rad_px, x))).real)

    def pixels(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        if recording.kind != "fringes":
            return light
        ratio = self.ratio(recording.bench.detector, rows)
        return LightMaps(light.iota * ratio, light.alpha_sin * ratio, light.alpha_cos * ratio)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Structure common to iota and alpha, over the flats and less the shape of the light."""
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
        near = np.mean([map_fit.neighbour_products(a, b, good) for a, b in pairs], axis=0)
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
        common, chance = float(all_of_it.mean()), float(all_of_it.std() / np.sqrt(weight))
        full = _in_full(common, np.mean(iotas, axis=0), np.mean(alphas, axis=0), evidence.origin)
        return Estimate(
            cls(pixel, whole, ring.scale if waves else cls().scale_px),
            {"pixel_rms": float(errors[0]), "smooth_rms": float(errors[1])}
            | ({"scale_px": ring.scale_error} if waves else {}),
            common / chance,
            "structure common to mean light and fringe amplitude after division by the flat",
            in_full=full,
            size={} if full is None else _size(common, chance),
        )


def _size(variance: float, error: float) -> dict[str, float | str]:
    """The pattern's rms as the size of the effect."""
    (rms,), (rms_error,) = root_with_error(np.array([variance]), np.array([error]))
    return {"value": float(rms), "error": float(rms_error), "unit": "", "of": "rms of the response"}


def _in_full(variance: float, iota: F64, alpha: F64, origin: tuple[int, int]) -> FlatError | None:
    """The pattern of a variance that two maps (y, x) share, as measured; None without one."""
    (ny, nx), (y0, x0) = iota.shape, origin
    qy, qx = 2 * np.pi * np.fft.fftfreq(ny)[:, None], 2 * np.pi * np.fft.rfftfreq(nx)
    a, b = np.fft.rfft2(iota) / iota.size, np.fft.rfft2(alpha) / alpha.size
    pattern, common = (a + b) / 2, (a * b.conj()).real
    # One mode of each pair of opposite vectors, without those that have no opposite.
    single = np.where(qx > 0, qx < np.pi, (qy > 0) & (qy < np.pi)) & (np.abs(qy) < np.pi)
    power = np.abs(pattern) ** 2
    rest = float(np.median(power[single])) / np.log(2)  # mean of their exponential distribution
    rows, columns = np.nonzero(single & (power > STANDS_OUT * rest) & (common > power / 2))
    if not len(rows):
        return None
    y, x, mode = qy[rows, 0], qx[columns], pattern[rows, columns]
    sizes = 2 * mode * (1 - rest / np.abs(mode) ** 2) * np.exp(-1j * (y * y0 + x * x0))
    waves = [tuple(one.tolist()) for one in (x, y, sizes.real, -sizes.imag)]
    pixels = max(variance - float((np.abs(sizes) ** 2).sum()) / 2, 0.0)
    return FlatError(np.sqrt(pixels), 0.0, FlatError().scale_px, *waves)


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
    fringes: FringeEvidence, flat: F64, flats: tuple[F64, F64], good: Mask
) -> tuple[F64, F64]:
    """Logarithms of iota and alpha over the flats minus smooth terms, each from half the frames."""
    free = np.concatenate([map_fit.polynomial(good.shape, 2), map_fit.gauge_terms(fringes)])
    free = free[:, good].T
    maps = []
    for n in (0, 1):
        theta = map_fit.half_theta(fringes, n, good)
        size = theta[0] if n == 0 else np.hypot(theta[1], theta[2])
        ratio = np.log(np.maximum(size * flat[good] / flats[n][good], 1e-12))
        rest = map_fit.without(ratio[:, None], free)[:, 0]
        limit = _CLIP * robust_sigma(rest - np.median(rest))
        out = np.zeros(good.shape)
        out[good] = np.where(np.abs(rest) < limit, rest, 0.0)
        maps.append(out)
    return map_fit.without_harmonics(maps[0], maps[1], fringes, good)


def _smooth(neighbours: F64, ring: Ring) -> tuple[float, float, float]:
    """Variance of the smooth part, its error by noise, and its error as a sample of its kind."""
    # From the covariance of neighbours; from waves of one length if these explain it, as they are
    # better known.
    variance, noise = float(neighbours.mean()), float(neighbours.std() / np.sqrt(neighbours.size))
    if abs(ring.variance - variance) < AGREE * np.hypot(noise, ring.noise):
        return ring.variance, ring.noise, ring.error
    return variance, noise, float(np.hypot(noise, ring.error))
