"""A sensor without fringes and its recorded frames; named kinds of sensors."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
LADDERS = ("exposure", "lamp", "both")
DARKS_S = (1.0, 4.0)


@dataclass
class Series:
    """Consecutive frames: their number, exposure time (s) and light (e- in the usual pixel)."""

    kind: str
    frames: int
    exptime_s: float
    light_e: float


@dataclass
class Sensor:
    """A sensor and its recorded series; steps change an image (y, x) in electrons."""

    rng: np.random.Generator
    gain: float  # gain, declared_gain: e-/ADU
    declared_gain: float
    bits: int
    read_noise_e: F64  # (y, x), as bias_adu, response and dark_e_s
    bias_adu: F64
    response: F64
    dark_e_s: F64
    well_e: float  # full well
    top_e: float  # light of the brightest flats that are not meant to saturate
    flicker: float  # of the lamp, from frame to frame, relative rms
    defects: NDArray[np.bool_]  # (y, x) pixels to mask
    unclear: NDArray[np.bool_]  # (y, x) pixels that may be masked or not
    series: list[Series] = field(default_factory=list)
    response_curve: Callable[[F64], F64] = lambda e: e  # signal (e-) of the charge (e-)
    # lighting, collected, amplified: steps on the mean light, on the charge, and on what readout
    # adds; given the frame's number
    lighting: list[Callable[[F64, int], F64]] = field(default_factory=list)
    collected: list[Callable[[F64, int], F64]] = field(default_factory=list)
    amplified: list[Callable[[F64, int], F64]] = field(default_factory=list)
    converter: Callable[[F64], F64] = np.rint  # codes of real samples (ADU)
    shift: int = 0  # shift of the codes in the files, bits
    # of the samples in the files
    stored: type[np.uint16] | type[np.float32] = np.uint16
    # rms noise common to the pixels of an output, not to the frame; part of the read noise
    shared_e: float = 0.0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ny, nx = self.response.shape
        return ny, nx

    def frames(self) -> Iterator[tuple[Series, NDArray[Any]]]:
        """Samples (t, y, x) of every series, in the order of recording."""
        number = 0
        for one in self.series:
            cube = []
            for _ in range(one.frames):
                number += 1
                cube.append(self._frame(one, number))
            yield one, np.stack(cube)

    def _frame(self, one: Series, number: int) -> NDArray[Any]:
        rng = self.rng
        light = one.light_e * (1 + self.flicker * rng.standard_normal())
        lit = light * self.response
        for step in self.lighting:
            lit = step(lit, number)
        mean = lit + self.dark_e_s * one.exptime_s
        charge = rng.poisson(mean).astype(float)
        for step in self.collected:
            charge = step(charge, number)
        signal = self.response_curve(np.minimum(charge, self.well_e))
        signal = signal + self.read_noise_e * rng.standard_normal(self.shape)
        for step in self.amplified:
            signal = step(signal, number)
        codes = self.converter(self.bias_adu + signal / self.gain)
        samples = np.clip(codes, 0, 2**self.bits - 1).astype(self.stored)
        return np.left_shift(samples, self.shift) if self.shift else samples


Converter = Callable[[np.random.Generator], tuple[int, float, float]]
"""Draws bits, gain (e-/ADU) and read noise (e-)."""


def _ladder(rng: np.random.Generator, ladder: str, top_e: float, highest: float) -> list[Series]:
    """Pairs of flats, from the dimmest to the brightest level."""
    count = int(rng.integers(8, 17))
    levels = np.linspace(rng.uniform(0.01, 0.06), highest, count) * top_e
    times = {
        "exposure": 0.02 * levels / levels[0],
        "lamp": np.full(count, 0.05),
        "both": 0.02 * np.cumsum(rng.uniform(0.3, 1.7, count)),
    }[ladder]
    return [Series("flat", 2, float(t), float(e)) for t, e in zip(times, levels, strict=True)]


def ordinary(
    rng: np.random.Generator,
    shape: tuple[int, int],
    ladder: str,
    highest: float = 0.9,
    counts: tuple[int, int] = (0, 0),
    converter: Converter | None = None,
) -> Sensor:
    """A sensor that bias, dark and flat maps describe completely."""
    bits, gain, read = (converter or _converter)(rng)
    bias = float(rng.uniform(15, 40) if bits < 12 else rng.uniform(60, 400)) + 4 * read / gain
    range_e = gain * (2**bits - 1 - bias)
    well_e = range_e * float(rng.choice([0.7, 2.0]))
    top_e = 0.93 * min(well_e, range_e)
    y, x = places(shape)
    response = (1 - rng.uniform(0, 0.3) * (x**2 + y**2)) * (
        1 + rng.uniform(0.003, 0.02) * rng.standard_normal(shape)
    )
    dark = rng.uniform(0.2, 5) * read * rng.lognormal(0, 0.15, shape) / DARKS_S[-1]
    offsets = rng.uniform(0, 1.5) * rng.standard_normal(shape)
    pixels = rng.lognormal(0, rng.uniform(0, 0.1), shape)
    sensor = Sensor(
        rng,
        gain,
        gain * float(rng.uniform(0.98, 1.02)),
        bits,
        read * pixels,
        np.maximum(bias + offsets, 8),
        response,
        dark,
        well_e,
        top_e,
        0.001,
        np.zeros(shape, np.bool_),
        np.zeros(shape, np.bool_),
    )
    sensor.declared_gain = gain
    biases, flats = counts
    sensor.series = [Series("bias", biases or int(rng.choice([20, 40, 100])), 0.0, 0.0)]
    sensor.series += [Series("dark", 10, time, 0.0) for time in DARKS_S]
    sensor.series += _ladder(rng, ladder, top_e, highest)
    if flats:
        usual = middle(sensor)
        sensor.series.append(Series("flat", flats, 1.1 * usual.exptime_s, 1.1 * usual.light_e))
    return sensor


def _converter(rng: np.random.Generator) -> tuple[int, float, float]:
    """Bits, gain (e-/ADU) and read noise (e-) of a realistic camera."""
    while True:
        bits = int(rng.integers(8, 17))
        gain, codes = np.exp(rng.uniform(np.log([0.05, 0.4]), np.log([40, 20])))
        if gain * codes > 0.7 and codes < 2**bits / 250 and 1e3 < gain * 2**bits < 1e6:
            return bits, float(gain), float(gain * codes)


def places(shape: tuple[int, int]) -> F64:
    """Rows and columns over the shape, from -0.5 to 0.5, (2, y, x)."""
    ny, nx = shape
    return np.asarray(np.mgrid[:ny, :nx] / np.array([ny, nx])[:, None, None] - 0.5)


def middle(sensor: Sensor) -> Series:
    """Middle level of the ladder."""
    flats = [one for one in sensor.series if one.kind == "flat"]
    return flats[len(flats) // 2]


Drawn = dict[str, Any]
Change = Callable[[Sensor], Drawn | None]
C = TypeVar("C", bound=Change)


@dataclass(frozen=True)
class Kind:
    """Kind of camera."""

    change: Change  # changes an ordinary sensor; returns the drawn values, if any
    # causes to name, joined by " + ", each with its alternatives; empty: none, and no gap; "?":
    # none, as the change is not a listed effect
    cause: str
    highest: float  # highest level of the flats, over `top_e`
    converter: Converter | None


KINDS: dict[str, Kind] = {}


def kind(
    cause: str = "", highest: float = 0.9, converter: Converter | None = None
) -> Callable[[C], C]:
    """Register a kind in `KINDS`."""

    def entered(change: C) -> C:
        KINDS[change.__name__] = Kind(change, cause, highest, converter)
        return change

    return entered
