"""Readout: noise of rows, outputs and converters, the level of the bias."""

import numpy as np
from numpy.typing import NDArray

from second_bench.sensors.model import F64, Drawn, Sensor, kind


def _rows(sensor: Sensor, size_e: float, coefficients: F64, apart: int) -> None:
    ny = sensor.shape[0]

    def adds(e: F64, _: int) -> F64:
        white = sensor.rng.standard_normal(ny + apart * (len(coefficients) - 1))
        level = sum(c * white[n * apart : n * apart + ny] for n, c in enumerate(coefficients))
        return np.asarray(e + size_e * np.asarray(level)[:, None])

    sensor.amplified.append(adds)


@kind("row_noise")
def rows(sensor: Sensor) -> Drawn:
    """Every row of every frame has an offset."""
    size = float(sensor.rng.uniform(0.2, 1.0) * sensor.read_noise_e.mean())
    _rows(sensor, size, np.ones(1), 1)
    return {"row_e": size}


@kind("row_noise")
def row_pairs(sensor: Sensor) -> Drawn:
    """The same, and every second row shares much of it."""
    size = float(sensor.rng.uniform(0.2, 1.0) * sensor.read_noise_e.mean())
    _rows(sensor, size, np.array([0.8, 0.6]), 2)
    return {"row_e": size}


@kind("row_noise")
def row_groups(sensor: Sensor) -> Drawn:
    """Two or four rows are read together, and share an offset in every frame."""
    rng, ny = sensor.rng, sensor.shape[0]
    size, rows = float(rng.uniform(0.2, 1.0) * sensor.read_noise_e.mean()), int(rng.choice([2, 4]))
    of = np.arange(ny) // rows
    sensor.amplified.append(lambda e, _: e + size * rng.standard_normal(ny)[of][:, None])
    return {"row_e": size, "rows": rows}


@kind()
def amplifiers(sensor: Sensor) -> Drawn:
    """Two halves with separate amplifiers, and separate converters for columns."""
    rng, nx = sensor.rng, sensor.shape[1]
    apart, columns = float(rng.uniform(-0.03, 0.03)), float(rng.uniform(0.001, 0.01))
    gains = 1 + columns * rng.standard_normal(nx) + apart * (np.arange(nx) >= nx // 2)
    sensor.amplified.append(lambda e, _: e * gains)
    offsets = rng.uniform(0.2, 3) * rng.standard_normal(nx) + 5 * (np.arange(nx) >= nx // 2)
    sensor.bias_adu = np.maximum(sensor.bias_adu + offsets, 8)
    # Signals in electrons refer to the mean gain.
    sensor.amplified.append(lambda e, _: np.asarray(e / gains.mean()))
    return {"apart": apart, "columns": columns}


@kind()
def clipped(sensor: Sensor) -> Drawn:
    """A black level so low that the noise of bias frames is cut at code zero."""
    size = float(sensor.rng.uniform(0.0, 1.5) * sensor.read_noise_e.mean() / sensor.gain)
    sensor.bias_adu = np.full(sensor.shape, size)
    return {"bias_adu": size}


@kind()
def declared_gain(sensor: Sensor) -> Drawn:
    """A declared gain that is wrong: flats show the true one, so it is no gap."""
    factor = float(sensor.rng.choice([-1, 1]) * np.exp(sensor.rng.uniform(np.log(0.04), -1.2)))
    sensor.declared_gain = sensor.gain / (1 + factor)
    return {"relative": factor}


@kind("quantisation")
def codes(sensor: Sensor) -> Drawn:
    """A tenth of the codes never occurs; the next higher one takes their place."""
    # Read noise of many codes would hide missing ones.
    sensor.read_noise_e = sensor.read_noise_e * min(1, 2 * sensor.gain / sensor.read_noise_e.mean())
    there = sensor.rng.random(2**sensor.bits) >= 0.1
    there[-1] = True
    following = np.flatnonzero(there)
    code = following[np.searchsorted(following, np.arange(len(there)))].astype(float)
    last = len(code) - 1
    sensor.converter = lambda adu: code[np.clip(np.rint(adu), 0, last).astype(int)]
    return {"missing": 0.1}


@kind("bias_drift")
def drift(sensor: Sensor) -> Drawn:
    """The level of the bias wanders from frame to frame."""
    step = float(sensor.rng.uniform(0.03, 0.15) * sensor.read_noise_e.mean())
    level = 0.0

    def wanders(e: F64, _: int) -> F64:
        nonlocal level
        level += step * float(sensor.rng.standard_normal())
        return e + level

    sensor.amplified.append(wanders)
    return {"step_e": step}


@kind()
def stretched(sensor: Sensor) -> Drawn:
    """Codes are written from the highest bits on: each is a multiple of 16, or less."""
    sensor.shift = min(4, 16 - sensor.bits)
    return {"factor": 2**sensor.shift}


@kind("row_noise")
def rows_and_columns(sensor: Sensor) -> Drawn:
    """Rows and columns both have an offset of their own in every frame."""
    rng, nx = sensor.rng, sensor.shape[1]
    row, column = rng.uniform(0.2, 1.0, 2) * sensor.read_noise_e.mean()
    _rows(sensor, float(row), np.ones(1), 1)
    sensor.amplified.append(lambda e, _: np.asarray(e + column * rng.standard_normal(nx)))
    return {"row_e": float(row), "column_e": float(column)}


def _wave(sensor: Sensor, size: float, columns: float, rows: float) -> None:
    """A wave of this rms (e-) and these cycles per pixel, with a phase of its own in each frame."""
    ny, nx = sensor.shape
    phase = 2 * np.pi * (rows * np.arange(ny)[:, None] + columns * np.arange(nx))

    def adds(e: F64, _: int) -> F64:
        return np.asarray(e + np.sqrt(2) * size * np.sin(phase + sensor.rng.uniform(0, 2 * np.pi)))

    sensor.amplified.append(adds)


@kind("pickup")
def hum(sensor: Sensor) -> Drawn:
    """Mains hum: one cycle takes several rows, so it hardly changes along a row."""
    rng = sensor.rng
    size = float(rng.uniform(0.15, 0.8) * sensor.read_noise_e.mean())
    rows = float(rng.uniform(0.06, 0.44))
    _wave(sensor, size, rows / 2000, rows)
    return {"hum_e": size, "rows": rows}


@kind("pickup")
def tones(sensor: Sensor) -> Drawn:
    """Two signals of high frequency."""
    rng = sensor.rng
    sizes = rng.uniform(0.1, 0.5, 2) * sensor.read_noise_e.mean()
    waves = rng.uniform((0.05, -0.5), (0.45, 0.5), (2, 2))
    for size, (columns, rows) in zip(sizes.tolist(), waves.tolist(), strict=True):
        _wave(sensor, size, columns, rows)
    sensor.shared_e = float(np.hypot(*sizes))
    return {"tones_e": sensor.shared_e}


def _outputs(sensor: Sensor, at: tuple[float, float]) -> NDArray[np.int_]:
    """Number (y, x) of each pixel's output; four meet at a place, relative to the shape."""
    ny, nx = sensor.shape
    right = np.arange(nx) >= round(at[1] * nx)
    return 2 * (np.arange(ny)[:, None] >= round(at[0] * ny)) + right


# Scatter of four outputs' levels about their mean, the frame's level.
_APART = np.sqrt(3 / 4)


@kind("output_jitter")
def drifting_outputs(sensor: Sensor) -> Drawn:
    """Four outputs whose levels jump independently from frame to frame."""
    rng, outputs = sensor.rng, _outputs(sensor, (0.5, 0.5))
    size = float(rng.uniform(0.1, 0.5) * sensor.read_noise_e.mean())
    sensor.shared_e = size * _APART
    sensor.amplified.append(lambda e, _: e + size * rng.standard_normal(4)[outputs])
    return {"output_e": size}


@kind("output_jitter")
def wandering_outputs(sensor: Sensor) -> Drawn:
    """Four outputs whose levels walk and jump independently; they meet off-centre."""
    rng, at = sensor.rng, sensor.rng.uniform(0.3, 0.7, 2)
    outputs = _outputs(sensor, (float(at[0]), float(at[1])))
    step, size = rng.uniform(0.03, 0.15, 2) * sensor.read_noise_e.mean()
    sensor.shared_e = float(np.hypot(size, step / np.sqrt(2))) * _APART
    levels = np.zeros(4)

    def walks(e: F64, _: int) -> F64:
        levels[:] += step * rng.standard_normal(4)
        return np.asarray(e + (levels + size * rng.standard_normal(4))[outputs])

    sensor.amplified.append(walks)
    return {"step_e": float(step), "jump_e": float(size), "at": at.tolist()}


@kind()
def output_boundary(sensor: Sensor) -> Drawn:
    """Four outputs with different offsets and gains, which do not meet in the centre."""
    rng = sensor.rng
    at = rng.uniform(0.2, 0.8, 2)
    outputs = _outputs(sensor, (float(at[0]), float(at[1])))
    gains = 1 + rng.uniform(-0.03, 0.03, 4)[outputs]
    gains /= gains.mean()
    sensor.amplified.append(lambda e, _: e * gains)
    sensor.bias_adu = sensor.bias_adu + rng.uniform(0, 10, 4)[outputs]
    return {"at": at.tolist()}


@kind()
def two_amplifiers(sensor: Sensor) -> Drawn:
    """Two halves of quite different gain and read noise."""
    rng = sensor.rng
    right = np.arange(sensor.shape[1]) >= sensor.shape[1] // 2
    apart, noisier = float(rng.uniform(0.05, 0.15)), float(rng.uniform(1.2, 1.6))
    gains = 1 + apart * (right - right.mean())
    # Read noise of all pixels is in electrons of the common gain.
    sensor.read_noise_e = sensor.read_noise_e * np.where(right, noisier, 1.0)
    sensor.collected.append(lambda e, _: np.asarray(e * gains))
    return {"apart": apart, "noisier": noisier}


def _eight_bits(rng: np.random.Generator) -> tuple[int, float, float]:
    gain = float(rng.uniform(10, 80))
    return 8, gain, gain * float(rng.uniform(0.4, 1.5))


@kind(converter=_eight_bits)
def eight_bits(sensor: Sensor) -> None:
    """Eight bits above a black level."""


@kind(converter=lambda rng: (int(rng.integers(10, 15)), 10.0, 30.0))
def noisy(sensor: Sensor) -> None:
    """30 e- of read noise."""


@kind()
def binned(sensor: Sensor) -> Drawn:
    """Each sample is the mean of four pixels' codes: whole, or in steps of a quarter."""
    rng, whole = sensor.rng, bool(sensor.rng.integers(2))
    # Keep read noise above rounding: a program cannot know that four codes were rounded.
    sensor.read_noise_e = sensor.read_noise_e * max(1, 2 * sensor.gain / sensor.read_noise_e.mean())

    def means(adu: F64) -> F64:
        apart = (
            2 * np.median(sensor.read_noise_e) / sensor.gain * rng.standard_normal((4, *adu.shape))
        )
        mean = np.rint(adu + apart - apart.mean(axis=0)).mean(axis=0)
        return np.asarray(np.floor(mean + 0.5) if whole else mean)

    sensor.converter = means
    sensor.stored = np.float32
    return {"whole": whole}
