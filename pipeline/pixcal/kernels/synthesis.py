"""Compiled simulation of samples from light, and random numbers keyed by purpose.

A frame is made in separate steps, each over arrays (y, x) of the rows at hand, so that an effect
can act between any two: `illuminate` (light and pixel response: mean electrons), `collect`
(charge: dark current, shot noise, full well), `amplify` (gain, bias, read noise), `convert`
(codes).

Random numbers are keyed by (purpose, place): noise of pixels comes from `pixcal.kernels.normals`,
all else from a separate `numpy.random.Generator` (PCG64), for example one per tile of the chip for
its maps. Results thus do not depend on how the work is divided.
"""

import math
from collections.abc import Callable
from enum import IntEnum
from functools import lru_cache
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels import kernel
from pixcal.kernels.normals import Key
from pixcal.model.arrays import F32, U16

# Rows of the window that are simulated at a time.
BLOCK_ROWS = 64
# mean (e-) below which the Poisson quantile is found by summing the distribution
EXACT_BELOW = 16.0


class Stream(IntEnum):
    """Purposes of random numbers; a number is never reused."""

    DELTA_X = 1
    DELTA_Y = 2
    RESPONSE = 3
    BIAS = 4
    BIAS_COLUMN = 5
    DEFECT = 6
    STITCH = 7
    PHASE = 8
    NOISE = 12
    EFFECT = 13


def generator(seed: int, stream: Stream, *key: int) -> np.random.Generator:
    """The random generator of one purpose and place, independent of the order of calls."""
    return np.random.Generator(np.random.PCG64(_Seed.of(seed, int(stream), *key)))


def walk_normals(seed: int, effect: str, first: int, *last: int) -> Callable[[int, int], float]:
    """Normals of an effect's walk through all frames (`pixcal.kernels.processes.brownian`)."""
    name = crc32(effect.encode())

    def normal(level: int, place: int) -> float:
        rng = generator(seed, Stream.EFFECT, name, first + level, place, *last)
        return float(rng.standard_normal())

    return normal


def pixel_key(seed: int, stream: Stream, *key: int) -> Key:
    """Key of one purpose and place for normals of pixels (`pixcal.kernels.normals`)."""
    word = int(_Seed.of(seed, int(stream), *key).words[0])
    return word >> 32, word & 0xFFFFFFFF


class _Seed(np.random.SeedSequence):
    """Seed of a generator, cached because mixing it takes as long as a thousand normals."""

    def __init__(self, seed: int, *key: int) -> None:
        super().__init__(seed, spawn_key=key)
        self.words = super().generate_state(4, np.uint64)

    @classmethod
    @lru_cache(maxsize=4096)
    def of(cls, seed: int, *key: int) -> "_Seed":
        return cls(seed, *key)

    def generate_state(self, n_words: int, dtype: Any = np.uint32) -> Any:
        """The words that PCG64 requests, always four of 64 bits."""
        return self.words


def fill_normal(rng: np.random.Generator, out: F32) -> None:
    """Fill a 2-D array with ``rng.standard_normal``, rounded to float32."""
    out[...] = rng.standard_normal(out.shape)


@kernel()
def illuminate(
    iota: F32,
    alpha_sin: F32,
    alpha_cos: F32,
    level: float,
    amplitude: float,
    column_turn: F32,
    row_turn: F32,
    out: F32,
) -> None:
    """Mean electrons from the light: ``B iota + A alpha sin(psi + phi)`` (physics note, section 1).

    iota, alpha_sin, alpha_cos : (y, x) float32 mean; alpha times sin psi and cos psi, e-
    level, amplitude : B and A of the frame
    column_turn, row_turn : (2, x), (2, y) float32, cos and sin of the frame's phase: phi and the
        part that varies along y in the rows, the part that varies along x in the columns
    out : (y, x) float32 electrons, written
    """
    b, a = np.float32(level), np.float32(amplitude)
    for i in range(out.shape[0]):
        row_cos, row_sin = a * row_turn[0, i], a * row_turn[1, i]
        for j in range(out.shape[1]):
            c = row_cos * column_turn[0, j] - row_sin * column_turn[1, j]
            s = row_sin * column_turn[0, j] + row_cos * column_turn[1, j]
            out[i, j] = b * iota[i, j] + alpha_sin[i, j] * c + alpha_cos[i, j] * s


@kernel(error_model="numpy")
def collect(light: F32, dark: F32, normal: F32, shot: bool, full_well: float, out: F32) -> None:
    """Charge ``out`` of each pixel, (y, x) e-, clipped at the full well; whole with shot noise.

    The Poisson variate is the quantile of its distribution at the probability of a standard normal
    w, so that the same random numbers serve every level. From `EXACT_BELOW` up the quantile is
    Giles' expansion in 1/sqrt(mean) to second order (ACM TOMS 42(1), 6, 2016, function Q_N2),
    rounded down: its distribution function is within 2e-5 of the exact one, and its mean, variance
    and skewness within 1e-8, 1.1e-4 and 2e-4 (at mean 16, with a fast fall above it; the tests
    repeat this). Below, it is exact. ``light`` and ``dark`` are mean electrons, ``normal`` standard
    normals; without ``shot`` the charge is its mean.
    """
    well, least = np.float32(full_well), np.float32(EXACT_BELOW)
    if not shot:
        for i in range(out.shape[0]):
            for j in range(out.shape[1]):
                out[i, j] = min(max(light[i, j] + dark[i, j], np.float32(0)), well)
        return
    for i in range(out.shape[0]):
        faint = 0
        for j in range(out.shape[1]):
            mean = light[i, j] + dark[i, j]
            faint += mean < least
            out[i, j] = min(_poisson_expansion(max(mean, least), normal[i, j]), well)
        if faint:
            for j in range(out.shape[1]):
                mean = light[i, j] + dark[i, j]
                if mean < least:
                    out[i, j] = min(np.float32(poisson_quantile(mean, normal[i, j])), well)


@kernel(inline="always")
def _poisson_expansion(mean: np.float32, w: np.float32) -> np.float32:
    w2 = w * w
    root = math.sqrt(mean)
    first = -w * (np.float32(1 / 36) + w2 * np.float32(1 / 72))
    second = np.float32(-8 / 405) + w2 * (np.float32(7 / 810) + w2 * np.float32(1 / 270))
    rest = np.float32(1 / 3) + w2 * np.float32(1 / 6) + first / root + second / mean
    return np.float32(np.floor(mean + root * w + rest))


@kernel()
def poisson_quantile(mean: float, w: float) -> int:
    """Smallest n whose Poisson distribution function reaches that of a standard normal at ``w``.

    A sum, hence for means below `EXACT_BELOW`; zero for means of zero or less.
    """
    if mean <= 0:
        return 0
    # The upper tail is accurate for large ``w``: stop where the remaining probability reaches it.
    upper = 0.5 * math.erfc(w / math.sqrt(2.0))
    term = math.exp(-mean)
    rest = 1.0 - term
    n = 0
    while rest > upper and term > 1e-18:
        n += 1
        term *= mean / n
        rest -= term
    return n


@kernel()
def amplify(signal: F32, bias: F32, normal: F32, read_noise: F32, adu_per_e: F32, out: F32) -> None:
    """Electrons (y, x) in ADU, with read noise (e- rms) times standard normals, and bias (ADU)."""
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            electrons = signal[i, j] + read_noise[i, j] * normal[i, j]
            out[i, j] = electrons * adu_per_e[i, j] + bias[i, j]


@kernel()
def add_waves(down: F32, along: F32, out: F32) -> None:
    """Add waves to an array (y, x): products of cos and sin, (2, y, n) times (2, n, x)."""
    for i in range(out.shape[0]):
        for n in range(along.shape[1]):
            c, s = down[0, i, n], down[1, i, n]
            for j in range(out.shape[1]):
                out[i, j] += c * along[0, n, j] - s * along[1, n, j]


@kernel()
def convert(adu: F32, step: int, lowest: int, top: int, out: U16) -> None:
    """Codes of the converter: multiples of ``step`` from ``lowest`` to ``top`` (ADU)."""
    low, high, half = np.float32(lowest), np.float32(top // step), np.float32(0.5)
    codes = np.float32(1 / step)
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            code = np.int32(min(max(adu[i, j], low) * codes + half, high))
            out[i, j] = np.uint16(code * step)


def turns(angles: NDArray[Any]) -> F32:
    """cos and sin of angles (rad), shape (2, *angles.shape)."""
    cos_sin = np.empty((2, *angles.shape), np.float32)
    np.cos(angles, out=cos_sin[0])
    np.sin(angles, out=cos_sin[1])
    return cos_sin
