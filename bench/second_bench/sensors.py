"""Cameras without fringes: bias, dark and flat frames of a sensor with a known truth.

Plain numpy, frame by frame; gain, depth of the converter, level of the bias, ladder of flats and
counts of frames are drawn anew for every seed::

    python -m second_bench.sensors nonlinearity --seed 3 --out acq --truth truth.json
    python -m second_bench.sensors --list

``acquisition.yaml`` declares neither saturation nor full well.
"""

import argparse
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy.io import fits
from astropy.time import Time, TimeDelta
from numpy.typing import NDArray

F64 = NDArray[np.float64]
LADDERS = ("exposure", "lamp", "both")
NIGHT = Time("2026-03-01T20:00:00")
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
    """A sensor and what is recorded with it; steps change an image (y, x) in electrons.

    Attributes
    ----------
    gain, declared_gain : float
        e-/ADU.
    bits : int
    read_noise_e, bias_adu, response, dark_e_s : ndarray (y, x)
    well_e, top_e : float
        Full well; light of the brightest flats that are not meant to saturate.
    defects, unclear : ndarray (y, x)
        Pixels to mask, and those that may be masked or not.
    flicker : float
        Of the lamp, from frame to frame, relative rms.
    response_curve : callable
        Signal (e-) of the collected charge (e-).
    collected, amplified : list of callables
        Steps after the light is collected, and on what readout adds; given the frame's number.
    converter : callable
        Codes of real samples (ADU).
    shift : int
        Bits that the codes are shifted by in the files.
    """

    rng: np.random.Generator
    gain: float
    declared_gain: float
    bits: int
    read_noise_e: F64
    bias_adu: F64
    response: F64
    dark_e_s: F64
    well_e: float
    top_e: float
    flicker: float
    defects: NDArray[np.bool_]
    unclear: NDArray[np.bool_]
    series: list[Series] = field(default_factory=list)
    response_curve: Callable[[F64], F64] = lambda e: e
    collected: list[Callable[[F64, int], F64]] = field(default_factory=list)
    amplified: list[Callable[[F64, int], F64]] = field(default_factory=list)
    converter: Callable[[F64], F64] = np.rint
    shift: int = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ny, nx = self.response.shape
        return ny, nx

    def frames(self) -> Iterator[tuple[Series, NDArray[np.uint16]]]:
        """Samples (t, y, x) of every series, in the order in which they are recorded."""
        number = 0
        for one in self.series:
            cube = []
            for _ in range(one.frames):
                number += 1
                cube.append(self._frame(one, number))
            yield one, np.stack(cube)

    def _frame(self, one: Series, number: int) -> NDArray[np.uint16]:
        rng = self.rng
        light = one.light_e * (1 + self.flicker * rng.standard_normal())
        mean = light * self.response + self.dark_e_s * one.exptime_s
        charge = rng.poisson(mean).astype(float)
        for step in self.collected:
            charge = step(charge, number)
        signal = self.response_curve(np.minimum(charge, self.well_e))
        signal = signal + self.read_noise_e * rng.standard_normal(self.shape)
        for step in self.amplified:
            signal = step(signal, number)
        codes = self.converter(self.bias_adu + signal / self.gain)
        whole = np.clip(codes, 0, 2**self.bits - 1).astype(np.uint16)
        return np.left_shift(whole, self.shift, dtype=np.uint16)


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
) -> Sensor:
    """A sensor without anything that bias, dark and flat maps do not hold."""
    ny, nx = shape
    bits, gain, read = _converter(rng)
    bias = float(rng.uniform(15, 40) if bits < 12 else rng.uniform(60, 400)) + 4 * read / gain
    range_e = gain * (2**bits - 1 - bias)
    well_e = range_e * float(rng.choice([0.7, 2.0]))
    top_e = 0.93 * min(well_e, range_e)
    y, x = np.mgrid[:ny, :nx] / np.array([ny, nx])[:, None, None] - 0.5
    response = (1 - rng.uniform(0, 0.3) * (x**2 + y**2)) * (
        1 + rng.uniform(0.003, 0.02) * rng.standard_normal(shape)
    )
    dark = rng.uniform(0.2, 5) * read * rng.lognormal(0, 0.15, shape) / DARKS_S[-1]
    offsets = rng.uniform(0, 1.5) * rng.standard_normal(shape)
    pixels = rng.lognormal(0, rng.uniform(0, 0.1), shape)
    sensor = Sensor(
        rng, gain, gain * float(rng.uniform(0.98, 1.02)), bits, read * pixels,
        np.maximum(bias + offsets, 8), response, dark, well_e, top_e, 0.001,
        np.zeros(shape, np.bool_), np.zeros(shape, np.bool_),
    )  # fmt: skip
    sensor.declared_gain = gain
    biases, flats = counts
    sensor.series = [Series("bias", biases or int(rng.choice([20, 40, 100])), 0.0, 0.0)]
    sensor.series += [Series("dark", 10, time, 0.0) for time in DARKS_S]
    sensor.series += _ladder(rng, ladder, top_e, highest)
    if flats:
        middle = _middle(sensor)
        sensor.series.append(Series("flat", flats, 1.1 * middle.exptime_s, 1.1 * middle.light_e))
    return sensor


def _converter(rng: np.random.Generator) -> tuple[int, float, float]:
    """Bits, gain (e-/ADU) and read noise (e-) of a camera that somebody could build."""
    while True:
        bits = int(rng.integers(8, 17))
        gain, codes = np.exp(rng.uniform(np.log([0.05, 0.4]), np.log([40, 20])))
        if gain * codes > 0.7 and codes < 2**bits / 250 and 1e3 < gain * 2**bits < 1e6:
            return bits, float(gain), float(gain * codes)


def _middle(sensor: Sensor) -> Series:
    """Middle level of the ladder."""
    flats = [one for one in sensor.series if one.kind == "flat"]
    return flats[len(flats) // 2]


Drawn = dict[str, Any]
Kind = Callable[[Sensor], Drawn]
KINDS: dict[str, tuple[Kind, str, float]] = {}
"""By name: what is changed, the cause to name (empty: none), the highest level of the ladder."""


def kind(cause: str = "", highest: float = 0.9) -> Callable[[Kind], Kind]:
    """Enter a kind into `KINDS`."""

    def entered(change: Kind) -> Kind:
        KINDS[change.__name__] = (change, cause, highest)
        return change

    return entered


@kind()
def plain(sensor: Sensor) -> Drawn:
    """Nothing."""
    return {}


@kind(highest=1.35)
def saturated(sensor: Sensor) -> Drawn:
    """Levels beyond the end of the converter or of the wells."""
    return {}


@kind()
def pattern(sensor: Sensor) -> Drawn:
    """Every second row or column of the bias is higher."""
    size = sensor.rng.uniform(1, 8)
    ny, nx = sensor.shape
    axis = int(sensor.rng.integers(2))
    line = (-1.0) ** np.arange(ny if axis == 0 else nx) * size
    sensor.bias_adu = sensor.bias_adu + size + (line[:, None] if axis == 0 else line)
    return {"amplitude_adu": size, "lines": ("rows", "columns")[axis]}


@kind()
def defects(sensor: Sensor) -> Drawn:
    """Hot, dead and noisy pixels."""
    rng, shape = sensor.rng, sensor.shape
    read = sensor.read_noise_e.mean()
    hot, dead, noisy = (rng.random(shape) < share for share in (2e-3, 1e-3, 1e-3))
    sensor.dark_e_s = np.where(hot, rng.uniform(20, 200, shape) * read, sensor.dark_e_s)
    sensor.response = np.where(dead, rng.uniform(0, 0.3, shape), 1) * sensor.response
    sensor.read_noise_e = np.where(noisy, rng.uniform(5, 15, shape), 1) * sensor.read_noise_e
    sensor.defects = hot | dead | noisy
    return {"hot": int(hot.sum()), "dead": int(dead.sum()), "noisy": int(noisy.sum())}


@kind()
def stack(sensor: Sensor) -> Drawn:
    """A hundred flats for which the lamp was brighter than for the ladder."""
    off = float(sensor.rng.uniform(0.02, 0.06))
    of = _middle(sensor)
    sensor.series.append(Series("flat", 100, of.exptime_s, of.light_e * (1 + off)))
    return {"off": off}


def _rows(sensor: Sensor, size_e: float, coefficients: F64, apart: int) -> None:
    ny = sensor.shape[0]

    def adds(e: F64, _: int) -> F64:
        white = sensor.rng.standard_normal(ny + apart * (len(coefficients) - 1))
        level = sum(c * white[n * apart : n * apart + ny] for n, c in enumerate(coefficients))
        return np.asarray(e + size_e * np.asarray(level)[:, None])

    sensor.amplified.append(adds)


@kind()
def fading_lamp(sensor: Sensor) -> Drawn:
    """A lamp that warms up along the ladder, repeats its levels badly, and exposures with a lag."""
    rng, flats = sensor.rng, [one for one in sensor.series if one.kind == "flat"]
    drift, scatter = float(rng.uniform(-0.05, 0.05)), float(rng.uniform(0.001, 0.005))
    late = float(rng.uniform(0, 0.05)) * min(one.exptime_s for one in flats)
    for n, one in enumerate(flats):
        lamp = 1 + drift * n / len(flats) + scatter * rng.standard_normal()
        one.light_e *= lamp * (1 + late / one.exptime_s)
    return {"drift": drift, "scatter": scatter, "late_s": late}


@kind()
def amplifiers(sensor: Sensor) -> Drawn:
    """Two halves with amplifiers of their own, and converters of their own for columns."""
    rng, nx = sensor.rng, sensor.shape[1]
    apart, columns = float(rng.uniform(-0.03, 0.03)), float(rng.uniform(0.001, 0.01))
    gains = 1 + columns * rng.standard_normal(nx) + apart * (np.arange(nx) >= nx // 2)
    sensor.amplified.append(lambda e, _: e * gains)
    offsets = rng.uniform(0.2, 3) * rng.standard_normal(nx) + 5 * (np.arange(nx) >= nx // 2)
    sensor.bias_adu = np.maximum(sensor.bias_adu + offsets, 8)
    # Electrons are counted with the mean.
    sensor.amplified.append(lambda e, _: np.asarray(e / gains.mean()))
    return {"apart": apart, "columns": columns}


@kind()
def vignetted(sensor: Sensor) -> Drawn:
    """Dark corners, dust, pixels with dark current of a long tail, exposure times with jitter."""
    rng, (ny, nx) = sensor.rng, sensor.shape
    y, x = np.mgrid[:ny, :nx] / np.array([ny, nx])[:, None, None] - 0.5
    shade = np.exp(-rng.uniform(0.5, 3) * (x**2 + y**2))
    for _ in range(6):
        at, size = rng.uniform(-0.5, 0.5, 2), rng.uniform(0.01, 0.04)
        ring = np.hypot(y - at[0], x - at[1]) / size
        shade *= 1 - rng.uniform(0.02, 0.15) * np.exp(-(ring**4))
    sensor.response = sensor.response * shade
    tail = rng.pareto(1.5, sensor.shape) * np.median(sensor.dark_e_s)
    sensor.dark_e_s = sensor.dark_e_s + np.minimum(tail, 20 * sensor.read_noise_e.mean())
    # A tail has no end: from where on a pixel is a hot one is for each program to say.
    off = np.abs(sensor.dark_e_s - np.median(sensor.dark_e_s))
    sensor.unclear = off > 4 * 1.4826 * np.median(off)
    return {"corner": float(shade.min())}


@kind()
def clipped(sensor: Sensor) -> Drawn:
    """A black level so low that the noise of bias frames is cut at code zero."""
    size = float(sensor.rng.uniform(0.0, 1.5) * sensor.read_noise_e.mean() / sensor.gain)
    sensor.bias_adu = np.full(sensor.shape, size)
    return {"bias_adu": size}


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


def _to_neighbours(sensor: Sensor, along_x: float, along_y: float, rising: bool) -> None:
    top = sensor.top_e

    def shares(e: F64, _: int) -> F64:
        out = e.copy()
        moved = e * (e / top) if rising else e
        for axis, share in ((1, along_x), (0, along_y)):
            for by in (-1, 1):
                out += share * (np.roll(moved, by, axis) - moved)
        return out

    sensor.collected.append(shares)


@kind("ipc")
def ipc(sensor: Sensor) -> Drawn:
    """A part of the signal shows in the neighbours."""
    x, y = sensor.rng.uniform(0.004, 0.02, 2)
    _to_neighbours(sensor, float(x), float(y), rising=False)
    return {"x": float(x), "y": float(y)}


@kind("ipc brighter_fatter")
def coupling(sensor: Sensor) -> Drawn:
    """A part of the signal that rises with it shows in the neighbours of the row."""
    x = float(sensor.rng.uniform(0.004, 0.02))
    _to_neighbours(sensor, x, 0.0, rising=True)
    return {"x": x}


@kind("nonlinearity")
def nonlinearity(sensor: Sensor) -> Drawn:
    """A response curve that falls behind, in proportion to the signal."""
    size, top = float(np.exp(sensor.rng.uniform(np.log(0.01), np.log(0.12)))), sensor.top_e
    sensor.response_curve = lambda e: e * (1 - size * e / top)
    return {"quadratic": -size}


@kind()
def declared_gain(sensor: Sensor) -> Drawn:
    """A declared gain that is wrong: flats show the true one, so it is no gap."""
    factor = float(sensor.rng.choice([-1, 1]) * np.exp(sensor.rng.uniform(np.log(0.04), -1.2)))
    sensor.declared_gain = sensor.gain / (1 + factor)
    return {"relative": factor}


@kind("nonlinearity")
def curved(sensor: Sensor) -> Drawn:
    """Response curves of other shapes: bent near the full well only, ever softer, or like an S."""
    rng, top = sensor.rng, sensor.top_e
    size = float(np.exp(rng.uniform(np.log(0.01), np.log(0.12))))
    soft = np.sqrt(3 * size) / top
    curves: dict[str, Callable[[F64], F64]] = {
        "top": lambda e: e * (1 - size * (e / top) ** 3),
        "soft": lambda e: np.tanh(soft * e) / soft,
        "S": lambda e: e * (1 + size * (e / top) * (1 - 1.5 * e / top)),
    }
    shape = str(rng.choice(list(curves)))
    sensor.response_curve = curves[shape]
    return {"size": size, "shape": shape}


@kind("lag")
def lag(sensor: Sensor) -> Drawn:
    """A part of the charge of a frame comes with the next."""
    share = float(np.exp(sensor.rng.uniform(np.log(0.005), np.log(0.03))))
    kept = np.zeros(sensor.shape)

    def carries(e: F64, _: int) -> F64:
        nonlocal kept
        out = e - sensor.rng.binomial(e.astype(int), share) + kept
        kept = e - (out - kept)
        return out

    sensor.collected.append(carries)
    return {"share": share}


@kind("telegraph_noise")
def telegraph(sensor: Sensor) -> Drawn:
    """A hundredth of the pixels jumps between two levels."""
    rng = sensor.rng
    jumping = rng.random(sensor.shape) < 0.01
    read = sensor.read_noise_e.mean()
    amplitude = np.where(jumping, read * rng.uniform(3, 12), 0)
    state = rng.random(sensor.shape) < 0.5

    def jumps(e: F64, _: int) -> F64:
        nonlocal state
        state = state ^ (rng.random(sensor.shape) < 0.2)
        return np.asarray(e + amplitude * state)

    sensor.amplified.append(jumps)
    sensor.defects = jumping
    return {"share": 0.01, "amplitude_e": float(amplitude.max())}


@kind("quantisation")
def codes(sensor: Sensor) -> Drawn:
    """A tenth of the codes never comes; the next higher one comes instead."""
    # Noise of many codes hides them.
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


@kind(highest=1.35)
def harmless(sensor: Sensor) -> Drawn:
    """Hot, dead and noisy pixels, a fixed pattern, saturated flats and a steep dark signal."""
    return defects(sensor) | pattern(sensor)


@kind("nonlinearity", highest=1.35)
def bent_harmless(sensor: Sensor) -> Drawn:
    """The same with a response that bends."""
    return nonlinearity(sensor) | harmless(sensor)


@kind("row_noise + ipc brighter_fatter")
def rows_and_coupling(sensor: Sensor) -> Drawn:
    """Noise of rows that every second row shares, and a coupling that grows with the level."""
    return row_pairs(sensor) | coupling(sensor)


@kind()
def stretched(sensor: Sensor) -> Drawn:
    """Codes are written from the highest bits on: each is a multiple of 16, or less."""
    sensor.shift = min(4, 16 - sensor.bits)
    return {"factor": 2**sensor.shift}


@kind()
def few(sensor: Sensor) -> Drawn:
    """Two bias frames, no darks, pairs of flats at three levels."""
    flats = [one for one in sensor.series if one.kind == "flat"]
    chosen = [flats[0], flats[len(flats) // 2], flats[-1]]
    sensor.series = [Series("bias", 2, 0.0, 0.0), *chosen]
    return {}


@kind()
def without_bias(sensor: Sensor) -> Drawn:
    """Darks at two exposure times, no bias frames."""
    sensor.series = [one for one in sensor.series if one.kind != "bias"]
    return {}


def make(
    name: str,
    seed: int,
    shape: tuple[int, int],
    ladder: str | None = None,
    counts: tuple[int, int] = (0, 0),
) -> tuple[Sensor, Drawn]:
    """A sensor with a kind of fault, and the truth about it."""
    change, cause, highest = KINDS[name]
    rng = np.random.default_rng([seed, *name.encode()])
    # A lamp that is changed with the exposure time tells no levels.
    ladder = ladder or LADDERS[seed % len(LADDERS)]
    sensor = ordinary(rng, shape, ladder, highest, counts)
    drawn = change(sensor)
    sensor.declared_gain /= 2**sensor.shift
    good = ~sensor.defects
    truth = {
        "kind": name, "seed": seed, "ladder": ladder, "bits": sensor.bits, "drawn": drawn,
        "causes": [one.split() for one in cause.split("+")] if cause else [],
        "gain": sensor.gain / 2**sensor.shift, "declared_gain": sensor.declared_gain,
        "read_noise_e": float(np.sqrt(np.mean(sensor.read_noise_e[good] ** 2))),
        "bias_adu": float(np.median(sensor.bias_adu)), "well_e": sensor.well_e,
        "top_e": sensor.top_e, "defects": np.flatnonzero(sensor.defects).tolist(),
        "unclear": np.flatnonzero(sensor.unclear).tolist(),
    }  # fmt: skip
    return sensor, truth


def write(sensor: Sensor, out: Path) -> None:
    """Write frames and ``acquisition.yaml`` into a new folder."""
    seconds = 0.0
    for number, (one, cube) in enumerate(sensor.frames()):
        folder = out / one.kind
        folder.mkdir(parents=True, exist_ok=True)
        header = fits.Header()
        header["DATE-OBS"] = (NIGHT + TimeDelta(seconds, format="sec")).isot
        header["EXPTIME"] = one.exptime_s
        fits.PrimaryHDU(cube, header).writeto(folder / f"{one.kind}_{number:03d}.fits")
        seconds += one.frames * (one.exptime_s + 1.0)
    described = {
        "schema": "pixcal/acquisition/1",
        "detector": {
            "name": "simulated camera",
            "pitch_um": 5.0,
            "gain_e_per_adu": float(f"{sensor.declared_gain:.6g}"),
            "read_noise_e": float(f"{np.median(sensor.read_noise_e):.3g}"),
        },
        "frames": {one.kind: [f"{one.kind}/*.fits"] for one in sensor.series},
    }
    (out / "acquisition.yaml").write_text(yaml.safe_dump(described, sort_keys=False))


def main(arguments: list[str] | None = None) -> None:
    """Make one set of frames."""
    parser = argparse.ArgumentParser("second_bench.sensors", description=__doc__)
    parser.add_argument("kind", nargs="?", choices=KINDS)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--truth", type=Path)
    parser.add_argument("--size", type=int, nargs=2, default=(257, 383))
    parser.add_argument("--ladder", choices=LADDERS, help="else by the seed")
    parser.add_argument("--bias", type=int, default=0, help="frames; 0: by the seed")
    parser.add_argument("--flats", type=int, default=0, help="of one level beside the ladder")
    parser.add_argument("--list", action="store_true", help="list the kinds")
    asked = parser.parse_args(arguments)
    if asked.list:
        for name, (change, cause, _) in KINDS.items():
            print(f"{name}: {change.__doc__} [{cause or 'no gap'}]")
        return
    if not (asked.kind and asked.out and asked.truth):
        parser.error("KIND, --out and --truth are needed")
    sensor, truth = make(
        asked.kind, asked.seed, tuple(asked.size), asked.ladder, (asked.bias, asked.flats)
    )
    write(sensor, asked.out)
    asked.truth.parent.mkdir(parents=True, exist_ok=True)
    asked.truth.write_text(json.dumps(truth))


if __name__ == "__main__":
    main()
