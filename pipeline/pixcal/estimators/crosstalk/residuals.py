"""Frames less what they should be, as noise that can be correlated between pixels.

Taken off are what is common to the pixels of a frame (offset; light, contrast and phase, the same
over the window or growing along it) and what is common to the frames of a pixel (its level; its
light and fringe, and the harmonics that a curved response makes). The first correlates what is
left, with the negative of the modes' products; the modes are kept, so that this can be made good.
The second makes it smaller, which is made good here.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, Stack
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.kernels.crosstalk import Coupling, filled, noise_shares, uncouple, uncouple_fringes
from pixcal.model.arrays import F32, F64, Indices

UNIT = 1e4  # electrons that charge is counted in; variances are in 10⁴ e-²
CLIP = 6.0  # residuals beyond so many sigmas (particles, telegraph noise) do not count
# samples of one sequence that are used at most; of longer ones frames spread over it
MAX_SAMPLES = 6_000_000
MIN_FRAMES = 16  # fewest frames of a fringe set that leave residuals
# every so many frames the modes are kept; they change little, and only their products count
STRIDE = 16
STEPS = 3  # times that what is common to pixels and to frames is taken off in turn, till it is both
MIN_NOISE_SHARE = 0.1  # least share of a sample's noise that is left, of those that count


@dataclass(frozen=True)
class Residuals:
    """Some frames in units of their noise; zero where a sample has no weight."""

    e: F32  # (t, y, x) residual over its sigma
    charge: F32  # (t, y, x) mean charge as collected, which is its variance, over sigma (10⁴ e-)
    shot: F32  # (t, y, x) variance that charge gives after the couplings, over sigma
    one: F32  # (t, y, x) one over sigma
    # (m, s, y, x) what was taken off every `STRIDE`-th frame, orthonormal, and grown to stand
    # for all
    modes: F32

    @property
    def brightness(self) -> float:
        """Median charge, 10⁴ e-."""
        used = self.one > 0
        return float(np.median(self.charge[used] / self.one[used])) if used.any() else 0.0

    @property
    def taken(self) -> tuple[F32, F32, F32]:
        """Modes as if they were frames, and their charge and one, (m s, y, x)."""
        times = (len(self.modes), 1, 1)
        charge, one = (np.tile(a[::STRIDE], times) for a in (self.charge, self.one))
        return self.modes.reshape(one.shape), charge, one


def all_residuals(evidence: Evidence, known: Sequence[Coupling]) -> Iterator[Residuals]:
    """Residuals of each sequence of frames; known couplings give the charge collected."""
    shape = (evidence.good.shape[0], evidence.good.shape[1])
    kept = noise_shares(known, shape, evidence.origin)[0].astype(np.float32)
    for stack in evidence.stacks:
        if len(stack.adu) > 1:
            yield _of_stack(stack, evidence, known, kept)
    for fringes in evidence.fringes.values():
        if len(fringes.g) >= MIN_FRAMES:
            yield _of_fringes(fringes, known, kept)


def _spread(frames: int, pixels: int) -> Indices:
    few = max(MIN_FRAMES, MAX_SAMPLES // pixels)
    return np.unique(np.linspace(0, frames - 1, min(frames, few)).astype(int))


def _of_stack(stack: Stack, evidence: Evidence, known: Sequence[Coupling], kept: F32) -> Residuals:
    """Bias, darks or flats; offset and level of each frame are free, and each pixel's level."""
    at = _spread(len(stack.adu), evidence.good.size)
    signal = (stack.adu[at] - evidence.bias) * evidence.gain
    light = signal.mean(axis=0)
    used = evidence.good & (stack.adu.max(axis=0) < evidence.saturation_adu)
    rest = np.where(used, (signal - light) / UNIT**0.5, np.nan).astype(np.float32)
    collected = np.maximum(uncouple(light, known, evidence.origin), 0)
    charge = np.broadcast_to((collected / UNIT).astype(np.float32), rest.shape)
    common = [np.ones((1, 1), np.float32)]
    if stack.kind == "flat":
        common.append(charge)
    read = np.full(used.shape, evidence.read_noise**2 / UNIT, np.float32)
    return _noise(rest, charge, read, kept, common, common[:1], np.ones((len(at), 1)))


def _of_fringes(found: FringeEvidence, known: Sequence[Coupling], kept: F32) -> Residuals:
    """Fringe frames less the fit, as they were before they were divided by the flat.

    A curved response makes second and third harmonics of the fringes, not the same for all pixels.
    """
    at = _spread(len(found.g), found.good.size)
    flat = 1 / found.shot_factor
    theta = filled(np.where(found.good, found.theta, np.nan) * flat, found.k)
    collected = uncouple_fringes(theta, known, found.origin)
    charge, _, _ = _model(collected, found.g[at], found.dk[at])
    light, fringe, slope = _model(theta, found.g[at], found.dk[at])
    y, x = (a.astype(np.float32) for a in grid((flat.shape[0], flat.shape[1])))
    light -= fringe
    # Also what changes along the window: a fringe vector that moves, rows that are exposed later.
    places = (np.ones((1, 1), np.float32), x, y)
    scale = np.where(found.good, flat / UNIT**0.5, np.nan).astype(np.float32)
    rest = found.residual[at] * scale
    read = (found.read_variance * flat**2 / UNIT).astype(np.float32)
    turn = np.exp(1j * found.phi[at])
    powers = np.column_stack([turn**n for n in (1, 2, 3)])
    own = np.column_stack([np.ones(len(at)), powers.real, powers.imag])
    charge = np.maximum(charge / np.float32(UNIT), 0)
    return _noise(rest, charge, read, kept, (light, fringe, slope), places, own)


def _model(theta: F64, g: F64, dk: F64) -> tuple[F32, F32, F32]:
    """Frames (t, y, x) of maps, their fringes, and how these change with the phase; e-."""
    theta = theta.astype(np.float32)
    b, c, s = g.T.astype(np.float32)[:, :, None, None]
    fringe, slope = c * theta[1] + s * theta[2], c * theta[2] - s * theta[1]
    if np.any(dk):
        y, x = (a.astype(np.float32) for a in grid((theta.shape[1], theta.shape[2])))
        kx, ky = dk.T.astype(np.float32)[:, :, None, None]
        turn = kx * x + ky * y
        fringe, slope = fringe + turn * slope, slope - turn * fringe
    return b * theta[0] + fringe, fringe, slope


def _noise(
    rest: F32,
    charge: F32,
    read: F32,
    kept: F32,
    common: Sequence[F32],
    places: Sequence[F32],
    own: F64,
) -> Residuals:
    """Residuals in units of their noise, without what is common to pixels and to frames.

    Parameters
    ----------
    rest, charge : (t, y, x) float32
    read, kept : (y, x) float32
        Variance without light; variance of the shot noise over the charge.
    common, places : sequence of float32 array
        What is free in each frame, (t, y, x): each of the first times each of the second.
    own : (t, m) float64
        What is free in each pixel.
    """
    shot = charge * kept
    variance = shot + read
    good = rest**2 < CLIP**2 * variance
    one = np.where(good, 1 / np.sqrt(variance), np.float32(0)).astype(np.float32)
    e = np.where(good, rest, np.float32(0)) * one
    modes = _FrameModes.of(common, places, one)
    pixels = _PixelModes.of(own, one.reshape(len(e), -1))
    flat = e.reshape(len(e), -1)
    for _ in range(STEPS):
        modes.take_off(flat)
        flat -= pixels.part_of(flat)
    e /= (
        np.sqrt(np.maximum(1 - pixels.taken(), MIN_NOISE_SHARE)).astype(np.float32).reshape(e.shape)
    )
    # Noise beyond what is known makes every product count for less.
    squares = float(np.einsum("tyx,tyx->t", e, e).sum(dtype=float))
    excess = max(1.0, squares / max(int(np.count_nonzero(one)), 1))
    less = np.float32(excess**-0.5)
    some = np.stack([modes.orthonormal(t) for t in range(0, len(e), STRIDE)], axis=1)
    some *= less * np.float32(np.sqrt(len(e) / some.shape[1]))
    some = some.reshape(*some.shape[:2], *e.shape[1:])
    one *= less
    return Residuals(e * less, charge * one, shot * one, one, some)


@dataclass(frozen=True)
class _FrameModes:
    """What is free in each frame: some frames times some functions of place.

    They are made anew whenever they are needed: all at once they would be many times the samples.
    """

    common: Sequence[F32]  # sequence of (t, y, x) float32
    places: F32  # (place, y, x) as in `_noise`
    one: F32  # (t, y, x)
    to_orthonormal: F32  # (t, m, m)

    @classmethod
    def of(cls, common: Sequence[F32], places: Sequence[F32], one: F32) -> "_FrameModes":
        frames = [np.broadcast_to(part, one.shape) for part in common]
        every = np.stack([np.broadcast_to(place, one.shape[1:]) for place in places])
        count = len(frames) * len(every)
        found = cls(frames, every, one, np.empty((len(one), count, count), np.float32))
        for t, to_orthonormal in enumerate(found.to_orthonormal):
            own = found.frame(t)
            size = np.sqrt(np.maximum(np.einsum("mp,mp->m", own, own), np.float32(1e-20)))
            own /= size[:, None]
            gram = (own @ own.T).astype(float) + 1e-6 * np.eye(count)
            to_orthonormal[:] = np.linalg.inv(np.linalg.cholesky(gram)) / size
        return found

    def frame(self, t: int) -> F32:
        """Modes (m, pixel) of a frame, over sigma."""
        weighted = np.stack([part[t] for part in self.common]) * self.one[t]
        return np.asarray((self.places[:, None] * weighted).reshape(-1, weighted[0].size))

    def orthonormal(self, t: int) -> F32:
        """Modes (m, pixel) of a frame that are orthonormal over its pixels."""
        return np.asarray(self.to_orthonormal[t] @ self.frame(t))

    def take_off(self, e: F32) -> None:
        """Take what they explain off residuals (t, pixel) in units of their noise, in place."""
        for t, (rest, to_orthonormal) in enumerate(zip(e, self.to_orthonormal, strict=True)):
            own = self.frame(t)
            rest -= (to_orthonormal @ (own @ rest)) @ to_orthonormal @ own


@dataclass(frozen=True)
class _PixelModes:
    """What is free in each pixel: modes over the frames, weighted with one over sigma."""

    modes: F32  # (t, m) orthonormal without weights
    one: F32  # (t, pixel)
    covariance: F64  # (pixel, m, m)

    @classmethod
    def of(cls, modes: F64, one: F32) -> "_PixelModes":
        modes = np.linalg.qr(modes)[0]
        t, m = modes.shape
        squares = np.einsum("ti,tj->tij", modes, modes).reshape(t, -1).astype(np.float32)
        normal = ((one * one).T @ squares).astype(float).reshape(-1, m, m)
        trace = np.trace(normal, axis1=1, axis2=2)[:, None, None]
        return cls(
            modes.astype(np.float32),
            one,
            np.linalg.inv(normal + (1e-9 * trace + 1e-12) * np.eye(m)),
        )

    def part_of(self, e: F32) -> F32:
        """What the modes explain of residuals (t, pixel) in units of their noise."""
        right = (e * self.one).T @ self.modes
        size = np.einsum("pij,pj->pi", self.covariance, right).astype(np.float32)
        return np.asarray(self.one * (self.modes @ size.T))

    def taken(self) -> F32:
        """Share (t, pixel) of the noise that they take off."""
        t, m = self.modes.shape
        squares = np.einsum("ti,tj->tij", self.modes, self.modes).reshape(t, -1)
        covariance = self.covariance.reshape(-1, m * m).astype(np.float32)
        return np.asarray(squares @ covariance.T * self.one**2)
