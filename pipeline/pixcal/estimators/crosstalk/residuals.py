"""Frames less what they should be, as noise that can be correlated between pixels.

Of every frame that is taken off which all pixels have in common: light, offset, phase, fringe
vector, and the harmonics that a curved response makes. That correlates what is left by itself, with
the negative of the modes' products; the modes are kept, so that this can be made good.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.fringes import grid
from pixcal.kernels.crosstalk import Coupling, filled, noise_shares, uncouple, uncouple_fringes

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

UNIT = 1e4
"""Electrons that charge is counted in; variances in its square's root, 10⁴ e-²."""
CLIP = 6.0
"""Residuals beyond so many sigmas (particles, telegraph noise) do not count."""
BLOCK = 1 << 19
"""Samples that are taken at once."""
MOST = 1 << 23
"""Samples of one sequence that are used at most; of longer ones blocks spread over it."""
MIN_FRAMES = 8
"""Fewest frames of a fringe set that leave residuals."""
STRIDE = 8
"""Every so many frames the modes are kept; they change little, and only their products count."""


@dataclass(frozen=True)
class Residuals:
    """Some frames in units of their noise; zero where a sample has no weight.

    Attributes
    ----------
    e : (t, y, x) float32
        Residual over its sigma.
    charge : (t, y, x) float32
        Mean charge as collected, which is its variance, over sigma (10⁴ e-).
    shot : (t, y, x) float32
        Variance that charge gives after the couplings, over sigma.
    one : (t, y, x) float32
        One over sigma.
    modes : (m, s, y, x) float32
        What was taken off every `STRIDE`-th frame, orthonormal, and grown to stand for all.
    """

    e: F32
    charge: F32
    shot: F32
    one: F32
    modes: F32

    @property
    def brightness(self) -> float:
        """Median charge, 10⁴ e-."""
        used = self.one > 0
        return float(np.median(self.charge[used] / self.one[used])) if used.any() else 0.0

    @property
    def taken(self) -> tuple[F32, F32, F32]:
        """Modes as if they were frames, and their charge and one, (m s, y, x)."""
        charge, one = (
            np.tile(a[::STRIDE], (len(self.modes), 1, 1)) for a in (self.charge, self.one)
        )
        return self.modes.reshape(one.shape), charge, one


def all_residuals(evidence: Evidence, known: Sequence[Coupling]) -> Iterator[Residuals]:
    """Residuals of all frames, block by block.

    Parameters
    ----------
    evidence : Evidence
    known : sequence of Coupling
        What is known of the couplings, by which the charge collected follows from what is read.
    """
    shape = (evidence.good.shape[0], evidence.good.shape[1])
    kept = noise_shares(known, shape, evidence.origin)[0].astype(np.float32)
    for stack in evidence.stacks:
        yield from _of_stack(stack, evidence, known, kept)
    for fringes in evidence.fringes.values():
        yield from _of_fringes(fringes, known, kept)


def _blocks(frames: int, pixels: int) -> list[slice]:
    size = max(2, min(frames, BLOCK // pixels))
    starts = np.arange(0, frames, size)
    keep = max(1, MOST // (size * pixels))
    chosen = starts[np.unique(np.linspace(0, len(starts) - 1, keep).astype(int))]
    return [slice(int(s), min(int(s) + size, frames)) for s in chosen]


def _of_stack(
    stack: Stack, evidence: Evidence, known: Sequence[Coupling], kept: F32
) -> Iterator[Residuals]:
    """Bias, darks or flats less the mean of all; level and offset of each frame are free."""
    n = len(stack.adu)
    if n < 2:
        return
    light = (stack.adu.mean(axis=0) - evidence.bias).astype(float)
    used = evidence.good & (stack.adu.max(axis=0) < evidence.saturation_adu)
    collected = np.maximum(uncouple(light, known, evidence.origin), 0)
    charge = (collected * evidence.gain / UNIT).astype(np.float32)[None]
    read = np.full_like(charge, evidence.read_noise**2 / UNIT)
    mended = evidence.gain / UNIT**0.5 * np.sqrt(n / (n - 1))
    design = [np.ones_like(charge)] + ([charge] if stack.kind == "flat" else [])
    for block in _blocks(n, used.size):
        rest = mended * (stack.adu[block] - evidence.bias - light)
        yield _freed(np.where(used, rest, np.nan), charge, read, kept, design)


def _of_fringes(found: FringeEvidence, known: Sequence[Coupling], kept: F32) -> Iterator[Residuals]:
    """Frames less the fit, as they were before they were divided by the flat."""
    n = len(found.g)
    if n < MIN_FRAMES:
        return
    flat = 1 / found.shot_factor
    theta = filled(np.where(found.good, found.theta, np.nan) * flat, found.k)
    collected = uncouple_fringes(theta, known, found.origin).astype(np.float32)
    read = (found.read_variance * flat**2 / UNIT).astype(np.float32)[None]
    mended = (flat * np.sqrt(n / (n - 3)) / UNIT**0.5).astype(np.float32)
    for block in _blocks(n, found.good.size):
        g, dk = found.g[block], found.dk[block]
        charge = _model(collected, g, dk)[0]
        rest = np.where(found.good, found.residual[block] * mended, np.float32(np.nan))
        design = _design(theta.astype(np.float32), g, dk)
        yield _freed(rest, np.maximum(charge / np.float32(UNIT), 0), read, kept, design)


def _model(theta: F32, g: F64, dk: F64) -> tuple[F32, F32, F32]:
    """Frames (t, y, x) of maps, their fringes, and how these change with the phase; e-."""
    b, c, s = g.T.astype(np.float32)[:, :, None, None]
    fringe, slope = c * theta[1] + s * theta[2], c * theta[2] - s * theta[1]
    if np.any(dk):
        y, x = (a.astype(np.float32) for a in grid((theta.shape[1], theta.shape[2])))
        kx, ky = dk.T.astype(np.float32)[:, :, None, None]
        turn = kx * x + ky * y
        fringe, slope = fringe + turn * slope, slope - turn * fringe
    return b * theta[0] + fringe, fringe, slope


def _design(theta: F32, g: F64, dk: F64) -> list[F32]:
    """What is free in each frame: light, fringe, fringe vector, and two harmonics."""
    y, x = (a.astype(np.float32) for a in grid((theta.shape[1], theta.shape[2])))
    _, fringe, slope = _model(theta, g, dk)
    size = np.sqrt(np.maximum(fringe**2 + slope**2, np.float32(1)))
    sine, cosine = fringe / size, slope / size
    double = (cosine**2 - sine**2, 2 * sine * cosine)
    triple = (cosine * (4 * cosine**2 - 3), sine * (3 - 4 * sine**2))
    return [theta[:1], fringe, slope, x * slope, y * slope, *double, *triple]


def _freed(rest: F32 | F64, charge: F32, read: F32, kept: F32, design: list[F32]) -> Residuals:
    """Residuals in units of their noise, without what ``design`` (each (t or 1, y, x)) spans."""
    variance = charge * kept + read
    good = rest**2 < CLIP**2 * variance
    one = np.where(good, 1 / np.sqrt(variance), np.float32(0)).astype(np.float32)
    e = np.where(good, rest, 0).astype(np.float32) * one
    t, *shape = e.shape
    x = np.stack([np.broadcast_to(d, rest.shape) * one for d in design], axis=1)
    x = x.reshape(t, len(design), -1)
    x /= np.sqrt(np.maximum(np.einsum("tmp,tmp->tm", x, x), np.float32(1e-20)))[:, :, None]
    gram = (x @ x.swapaxes(1, 2)).astype(float) + 1e-6 * np.eye(len(design))
    modes = np.linalg.inv(np.linalg.cholesky(gram)).astype(np.float32) @ x
    flat = e.reshape(t, -1, 1)
    flat -= modes.swapaxes(1, 2) @ (modes @ flat)
    some = modes[::STRIDE] * np.float32(np.sqrt(t / len(modes[::STRIDE])))
    # Noise beyond what is known makes every product count for less.
    excess = max(1.0, float(np.sum(e * e, dtype=float)) / max(int(np.count_nonzero(one)), 1))
    less = np.float32(excess**-0.5)
    return Residuals(
        e * less, charge * one * less, charge * kept * one * less, one * less,
        some.swapaxes(0, 1).reshape(len(design), -1, *shape) * less,
    )  # fmt: skip
