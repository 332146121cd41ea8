"""Effects that pixcal does not have: the right answer is an unexplained gap."""

import numpy as np

from second_bench.effects.law import Drawn, law
from second_bench.model import F64, Bench, Frame


@law("modulated_glow", "corner", 8, 400, "e- at the corner", known=False)
def modulated_glow(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Stray light of the modulator's driver, bright at high voltage."""
    x, y = bench.grid()
    ny, nx = bench.shape
    corner = rng.choice([-0.5, 0.5], 2)
    glow = size * np.exp(-np.hypot(x / nx - corner[0], y / ny - corner[1]) / rng.uniform(0.1, 0.4))

    def glows(e: F64, frame: Frame) -> F64:
        if frame.run.kind != "fringes":
            return e
        voltage = (frame.run.phase[frame.index] % (2 * np.pi)) / (2 * np.pi)
        return np.asarray(e + frame.rng.poisson(glow * voltage**2))

    bench.charge.append(glows)
    return {"corner": corner.tolist()}


@law("pickup", "tone", 1, 25, "e- amplitude")
def pickup(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """A tone of a power supply, sampled as pixels are read one after the other."""
    ny, nx = bench.shape
    turns = float(np.exp(rng.uniform(np.log(0.003), np.log(0.3))))
    order = np.arange(ny)[:, None] * (nx + 20) + np.arange(nx)

    def hums(e: F64, frame: Frame) -> F64:
        phase = 2 * np.pi * (turns * order + frame.rng.random())
        return np.asarray(e + size * np.sin(phase))

    bench.offset.append(hums)
    return {"turns_per_pixel": turns}


@law("pixel_nonlinearity", "quadratic", 1e-3, 0.015, "rms at the peak", known=False)
def pixel_nonlinearity(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Individual nonlinearity of pixels, zero on average."""
    own = size * rng.standard_normal(bench.shape)
    own -= own.mean()
    bench.signal.append(lambda e, _: e * (1 - own * e / bench.peak_e))


@law(
    "mirror_crosstalk", "halves", 3e-4, 0.01, "of the mirrored pixel", known=False, decidable=False
)
def mirror_crosstalk(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Coupling of two outputs that are read simultaneously, from both sides inwards.

    The mirrored fringes add harmonics of the fringe, which a fit with free intensities absorbs.
    """
    sign = float(rng.choice([-1, 1]))
    bench.signal.append(lambda e, _: e + sign * size * e[:, ::-1])
    return {"sign": sign}
