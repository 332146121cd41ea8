"""Fringes of a set: frame parameters, the local fringe vector, smooth phasors."""

from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import gcd
from typing import TypeVar

import numpy as np
from scipy.ndimage import maximum_filter

from pixcal.kernels.medians import median
from pixcal.model.arrays import C128, F32, F64, Mask
from pixcal.model.errors import InputError

Phases = TypeVar("Phases", F32, F64)
MIN_FRINGES = 1.5  # fewest fringes across a window for the search of a peak
# fewest fringes for maps with correct errors: with 1.3 to 1.8 the gauge mistakes true offsets for
# fringes, and errors were 2 to 4 times SIGMA (measured on 80 x 80 px)
MIN_FRINGES_FOR_MAPS = 1.95
# least cosine between the fringes' axis and the nominal one: the nominal vector gives the sign
MOST_TURNED = 0.5
RESOLVED = 1e-7  # last step to the peak of the spectrum, rad/px
MOST_STEPS = 20  # a few suffice from the highest bin
# approximate number of pixels to which a smooth phasor is fitted: ten terms then have 4 % of the
# noise of one pixel
MOST_PIXELS = 6000


@dataclass(frozen=True)
class FrameParameters:
    """Parameters of each frame."""

    g: F64  # (t, 3) (B, A cos phi, A sin phi) at the reference point
    dk: F64  # (t, 2) change of the fringe vector along x and y (rad/px); all zero if fixed
    reference: tuple[float, float]  # point (y, x) where `g` holds, in pixels

    @cached_property
    def moving(self) -> bool:
        """Whether the fringe vector is free in each frame."""
        return bool(np.any(self.dk != 0))

    def at(self, y: float, x: float) -> F64:
        """Frame parameters (t, 3) at another point: the phase changes by dk times the distance."""
        if not self.moving:
            return self.g
        turn = self.dk[:, 0] * (x - self.reference[1]) + self.dk[:, 1] * (y - self.reference[0])
        phasor = (self.g[:, 1] + 1j * self.g[:, 2]) * np.exp(1j * turn)
        return np.stack([self.g[:, 0], phasor.real, phasor.imag], axis=1)

    @property
    def B(self) -> F64:
        """Mean intensity of each frame."""
        return self.g[:, 0]

    @property
    def A(self) -> F64:
        """Fringe amplitude of each frame."""
        return np.hypot(self.g[:, 1], self.g[:, 2])

    @property
    def phi(self) -> F64:
        """Phase of each frame (rad, in ±pi)."""
        return np.arctan2(self.g[:, 2], self.g[:, 1])


def grid(shape: tuple[int, ...]) -> tuple[F64, F64]:
    """Pixel coordinates (y, 1) and (1, x) relative to the centre of a tile."""
    ny, nx = shape
    y = np.arange(ny, dtype=float)[:, None] - (ny - 1) / 2
    x = np.arange(nx, dtype=float)[None, :] - (nx - 1) / 2
    return y, x


def find_fringe_vector(maps: F64, good: Mask, nominal: tuple[float, float]) -> tuple[float, float]:
    """Fringe vector (kx, ky), rad/px, of a tile, from maps (n, y, x) over their mean light.

    The highest peak of the summed power spectra, with the sign of the ``nominal`` vector. Raises
    InputError if no peak stands out, or fringes are fewer than `MIN_FRINGES` or lie across the
    nominal ones.
    """
    shape = maps.shape[1:]
    window = np.hanning(shape[0] + 2)[1:-1, None] * np.hanning(shape[1] + 2)[None, 1:-1]
    weight = window * good
    y, x = grid(shape)
    # Each map minus a plane, lest a gradient of the illumination be the highest peak.
    basis = np.stack(np.broadcast_arrays(1.0, x, y), axis=-1).reshape(-1, 3) * weight.reshape(-1, 1)
    flat = np.where(good, maps, 0.0).reshape(len(maps), -1) * weight.reshape(1, -1)
    coefficients = np.linalg.lstsq(basis, flat.T, rcond=None)[0]
    light = (flat - (basis @ coefficients).T).reshape(maps.shape)

    start = _peak(light, nominal)
    if start is None:
        raise InputError(
            "no fringes found: the phase or the signal is constant, or the fringe period is too "
            f"long for the window of {shape[1]} x {shape[0]} px; check the frames, and which "
            "files the set lists"
        )
    vector = _refined(light, start)
    cosine = vector @ np.array(nominal) / max(np.hypot(*vector) * np.hypot(*nominal), 1e-300)
    if abs(cosine) < MOST_TURNED:
        raise InputError(
            f"the fringes are {np.degrees(np.arccos(abs(cosine))):.0f} degrees from the "
            "direction of baseline_mm; correct it, or list the files of the right set"
        )
    sign = np.sign(cosine)
    return float(sign * vector[0]), float(sign * vector[1])


def _peak(light: F64, nominal: tuple[float, float]) -> F64 | None:
    """Highest peak (kx, ky), rad/px, of the spectra of maps (n, y, x); None if none stands out."""
    # Nominal positions are accurate to some 10 %: a peak there has priority.
    shape = light.shape[1:]
    size = [2 * n for n in shape]
    power = (np.abs(np.fft.fft2(light, s=size)) ** 2).sum(axis=0)
    fy, fx = np.meshgrid(*(np.fft.fftfreq(n) for n in size), indexing="ij")
    allowed = np.hypot(fy * shape[0], fx * shape[1]) >= MIN_FRINGES
    near = np.hypot(2 * np.pi * fx - nominal[0], 2 * np.pi * fy - nominal[1])
    reach = 0.25 * np.hypot(*nominal) + 2 * np.pi * 1.5 / min(shape)
    floor = np.median(power[allowed]) if allowed.any() else np.inf
    # Neither the wing of a peak outside the region nor its side lobes are peaks.
    within = np.where(allowed, power, 0.0)
    crest = (power >= maximum_filter(within, 3, mode="wrap")) & (power > 0.1 * within.max())
    for region in (allowed & crest & (near < reach), allowed):
        if region.any():
            at = int(np.argmax(np.where(region, power, -1)))
            if power.flat[at] > 50 * floor:
                return 2 * np.pi * np.array([fx.flat[at], fy.flat[at]])
    return None


def _refined(light: F64, start: F64) -> F64:
    """Peak (kx, ky), rad/px, of the power spectrum of maps (n, y, x), by Newton's method."""
    y, x = grid(light.shape[1:])
    orders, k = np.arange(3)[:, None], start
    for _ in range(MOST_STEPS):
        across = (-1j * x) ** orders * np.exp(-1j * k[0] * x)
        along = (-1j * y.T) ** orders * np.exp(-1j * k[1] * y.T)
        # (n, order along y, order along x)
        f = along @ (light @ across.T.real + 1j * (light @ across.T.imag))
        first = np.stack([f[:, 0, 1], f[:, 1, 0]])
        second = np.array([[f[:, 0, 2], f[:, 1, 1]], [f[:, 1, 1], f[:, 2, 0]]])
        curvature = (first @ first.conj().T + second @ f[:, 0, 0].conj()).real
        if np.linalg.eigvalsh(curvature)[-1] >= 0:
            break
        step = -np.linalg.solve(curvature, (first @ f[:, 0, 0].conj()).real)
        k = k + step
        if np.abs(step).max() < RESOLVED:
            break
    return np.asarray(k)


def powers(degree: int) -> list[tuple[int, int]]:
    """Powers (of x, of y) of a polynomial's terms."""
    return [(n - j, j) for n in range(degree + 1) for j in range(n + 1)]


def monomials(y: F64, x: F64, degree: int) -> F64:
    """The terms (term, ...) at coordinates, which broadcast."""
    # Powers of single columns and rows take little time; the products take most.
    xs, ys = ([np.asarray(v**n) for n in range(degree + 1)] for v in (x, y))
    return np.stack([xs[i] * ys[j] for i, j in powers(degree)])


@lru_cache(maxsize=8)
def polynomial_basis(shape: tuple[int, ...], degree: int, step: int = 1) -> F64:
    """Terms x^i y^j, i + j up to ``degree``, on ±1, at every ``step``-th pixel: (y * x, terms)."""
    y, x = grid(shape)
    terms = monomials(y / max(1.0, shape[0] / 2), x / max(1.0, shape[1] / 2), degree)
    return np.ascontiguousarray(terms.reshape(len(terms), -1)[:, ::step].T)


@dataclass(frozen=True)
class SmoothPhasor:
    """A smooth phasor over a tile."""

    map: C128  # (y, x) visibility times exp(i psi), on every pixel
    k: tuple[float, float]  # fringe vector (kx, ky), the mean over the tile, rad/px


def smooth_phasor(phasor: C128, good: Mask, k: tuple[float, float]) -> SmoothPhasor:
    """Smooth version of a noisy phasor map alpha exp(i psi) / iota (y, x), from its good pixels."""
    # A complex polynomial times the wave of the corrected fringe vector k (rad/px), no outliers.
    shape, (kx, ky) = phasor.shape, k
    turned = np.where(good, phasor, 0) * plane_wave(shape, (-kx, -ky))
    if shape[1] > 1:
        kx += float(np.angle(np.vdot(turned[:, :-1], turned[:, 1:])))
    if shape[0] > 1:
        ky += float(np.angle(np.vdot(turned[:-1], turned[1:])))
    carrier = plane_wave(shape, (kx, ky))
    turned = (np.where(good, phasor, 0) * carrier.conj()).ravel()
    # Real and imaginary part are two right-hand sides of the same real fit.
    parts = np.ascontiguousarray(turned).view(float).reshape(-1, 2)
    use = good.ravel()
    degree = min(3, max(0, min(shape) // 4 - 1))
    # A few thousand pixels suffice. A step coprime to the number of columns covers all columns.
    step = max(1, len(parts) // MOST_PIXELS)
    while gcd(step, shape[1]) > 1:
        step += 1
    parts, use = parts[::step], use[::step]
    every, basis = polynomial_basis(shape, degree), polynomial_basis(shape, degree, step)
    fit = np.zeros((basis.shape[1], 2))
    for _ in range(3):
        n = np.count_nonzero(use)
        if n < 2 * basis.shape[1]:
            every = polynomial_basis(shape, 0)
            fit = parts[use].mean(axis=0)[None] if n else np.zeros((1, 2))
            break
        # Terms of low degree on ±1 are nearly orthogonal, so normal equations stay accurate.
        # A tile with few good rows does not determine all of them: least squares, not solve.
        inside = basis if n == use.size else basis * use[:, None]
        fit = np.linalg.lstsq(inside.T @ basis, inside.T @ parts, rcond=1e-10)[0]
        rest = ((parts - basis @ fit) ** 2).sum(axis=1)
        kept = good.ravel()[::step] & (rest <= 25 * median(rest[use]) + 1e-24)
        if np.array_equal(kept, use):
            break
        use = kept
    return SmoothPhasor((every @ fit).view(complex).reshape(shape) * carrier, (kx, ky))


def plane_wave(shape: tuple[int, ...], k: tuple[float, float], phase: float = 0.0) -> C128:
    """``exp(i (phase + k . r))`` over a tile (y, x), r from its centre; an outer product."""
    y, x = grid(shape)
    return np.asarray(np.exp(1j * (phase + k[1] * y)) * np.exp(1j * k[0] * x))


def wrapped(phase: Phases) -> Phases:
    """Phases in ±pi, rad."""
    turn = phase.dtype.type(2 * np.pi)
    return np.asarray(phase - turn * np.rint(phase / turn))
