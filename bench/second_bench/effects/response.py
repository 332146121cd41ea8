"""Response: nonlinearity, and errors of flats."""

import numpy as np
from scipy.ndimage import gaussian_filter

from second_bench.effects.law import Drawn, law
from second_bench.model import F64, Bench, Frame


@law("nonlinearity", "quadratic", 1e-3, 0.03, "at the peak")
def quadratic(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Response that falls in proportion to the signal."""
    bench.signal.append(lambda e, _: e * (1 - size * e / bench.peak_e))


@law("nonlinearity", "cubic", 1e-3, 0.03, "at the peak")
def cubic(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Response that falls with the square of the signal."""
    bench.signal.append(lambda e, _: e * (1 - size * (e / bench.peak_e) ** 2))


@law("nonlinearity", "dead_zone", 10, 200, "e-")
def dead_zone(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Loss of the first electrons, which saturates with the signal."""
    scale = float(rng.uniform(800, 4000))
    bench.signal.append(lambda e, _: e - size * (1 - np.exp(-np.maximum(e, 0) / scale)))
    return {"scale_e": scale}


@law("nonlinearity", "knee", 4e-3, 0.1, "at the peak")
def knee(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Linear up to a knee below the full well."""
    level = float(rng.uniform(0.55, 0.8))

    def bends(e: F64, _: Frame) -> F64:
        over = np.maximum(e / bench.peak_e - level, 0) / (1 - level)
        return e - size * bench.peak_e * over**2 / (1 + 0.5 * over)

    bench.signal.append(bends)
    return {"knee": level}


def _smooth(shape: tuple[int, int], scale: float, rng: np.random.Generator) -> F64:
    """A random field with a scale in pixels, zero mean and rms 1."""
    edge = int(3 * scale)
    wide = gaussian_filter(rng.standard_normal((shape[0] + 2 * edge, shape[1] + 2 * edge)), scale)
    own = wide[edge : edge + shape[0], edge : edge + shape[1]]
    return np.asarray((own - own.mean()) / own.std())


@law("flat_error", "illumination", 0.002, 0.03, "rms")
def illumination(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Uneven illumination by the lamp."""
    scale = float(min(bench.shape) * rng.uniform(0.06, 0.14))
    bench.flat_response = bench.flat_response * (1 + size * _smooth(bench.shape, scale, rng))
    return {"scale_px": scale}


@law("flat_error", "pixels", 1e-3, 0.02, "rms")
def pixels(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Pixels respond differently to the lamp's colour."""
    bench.flat_response = bench.flat_response * (1 + size * rng.standard_normal(bench.shape))


@law("flat_error", "etalon", 1e-3, 0.02, "rms")
def etalon(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Interference of the lamp's light in the window's glass: rings about a distant point."""
    x, y = bench.grid()
    centre, period = rng.normal(0, 600, 2), float(rng.uniform(12, 45))
    r = np.hypot(x - centre[0], y - centre[1])
    rings = np.sqrt(2) * np.cos(2 * np.pi * r / period + rng.uniform(0, 2 * np.pi))
    bench.flat_response = bench.flat_response * (1 + size * rings)
    return {"period_px": period, "centre_px": centre.tolist()}
