"""Pixels: defects, fixed patterns, crosstalk, lag and response."""

from collections.abc import Callable

import numpy as np

from second_bench.sensors.model import F64, Drawn, Sensor, kind


@kind()
def plain(sensor: Sensor) -> None:
    """Nothing."""


@kind(highest=1.35)
def saturated(sensor: Sensor) -> None:
    """Levels beyond the end of the converter or of the wells."""


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


@kind("nonlinearity")
def nonlinearity(sensor: Sensor) -> Drawn:
    """A response curve that falls in proportion to the signal."""
    size, top = float(np.exp(sensor.rng.uniform(np.log(0.01), np.log(0.12)))), sensor.top_e
    sensor.response_curve = lambda e: e * (1 - size * e / top)
    return {"quadratic": -size}


@kind("nonlinearity")
def curved(sensor: Sensor) -> Drawn:
    """Response curves of other shapes: bent near the full well, increasingly flat, or S-shaped."""
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


def _to_neighbours(
    sensor: Sensor, along_x: float, along_y: float, steady: float = 1.0, rising: float = 0.0
) -> None:
    top = sensor.top_e

    def shares(e: F64, _: int) -> F64:
        out = e.copy()
        moved = e * (steady + rising * e / top)
        for axis, share in ((1, along_x), (0, along_y)):
            for by in (-1, 1):
                out += share * (np.roll(moved, by, axis) - moved)
        return out

    sensor.collected.append(shares)


@kind("ipc")
def ipc(sensor: Sensor) -> Drawn:
    """A part of the signal appears in the neighbours."""
    x, y = sensor.rng.uniform(0.004, 0.02, 2)
    _to_neighbours(sensor, float(x), float(y))
    return {"x": float(x), "y": float(y)}


@kind("ipc brighter_fatter")
def coupling(sensor: Sensor) -> Drawn:
    """A share of the signal, which rises with it, appears in the neighbours along the row."""
    x = float(sensor.rng.uniform(0.004, 0.02))
    _to_neighbours(sensor, x, 0.0, 0.0, 1.0)
    return {"x": x}


@kind("ipc")
def growing(sensor: Sensor) -> Drawn:
    """The share that appears in the neighbours grows to two to four times that of small signals."""
    (x, y), rise = sensor.rng.uniform(0.004, 0.012, 2), float(sensor.rng.uniform(1, 3))
    _to_neighbours(sensor, float(x), float(y), 1.0, rise)
    return {"x": float(x), "y": float(y), "rise": rise, "per_ke": 1e3 * rise / sensor.top_e}


@kind("lag")
def lag(sensor: Sensor) -> Drawn:
    """A part of the charge of a frame is read with the next frame."""
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


@kind()
def dead_columns(sensor: Sensor) -> Drawn:
    """Columns that collect nothing, and columns that are hot from some row on."""
    rng, (ny, nx) = sensor.rng, sensor.shape
    dead, hot = np.split(rng.choice(nx, 6, replace=False), 2)
    bad = np.zeros(sensor.shape, np.bool_)
    bad[:, dead] = True
    sensor.response = np.where(bad, 0.0, sensor.response)
    first = int(rng.integers(ny // 2))
    sensor.dark_e_s[first:, hot] += 50 * sensor.read_noise_e.mean()
    bad[first:, hot] = True
    sensor.defects = bad
    return {"dead": dead.tolist(), "hot": hot.tolist(), "from_row": first}


@kind()
def fixed_rows(sensor: Sensor) -> Drawn:
    """Every row and every column of the bias has a level of its own."""
    rng, (ny, nx) = sensor.rng, sensor.shape
    rows, columns = rng.uniform(1, 8), rng.uniform(0, 3)
    level = rows * rng.standard_normal((ny, 1)) + columns * rng.standard_normal(nx)
    sensor.bias_adu = sensor.bias_adu + level - min(level.min(), 0.0)
    return {"rows_adu": rows, "columns_adu": columns}
