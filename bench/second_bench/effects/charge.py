"""Charge that goes to other pixels or other frames."""

from typing import Any

import galsim
import numpy as np

from second_bench.effects.law import Drawn, law
from second_bench.model import F64, Bench, Frame, Step


def coupled(e: F64, kernel: F64) -> F64:
    """Voltages after capacitive coupling by a 3 x 3 kernel (y, x), by GalSim.

    An entry is the share that a pixel receives from its neighbour on that side.
    """
    image = galsim.ImageD(np.ascontiguousarray(e))
    image.applyIPC(galsim.ImageD(np.ascontiguousarray(kernel)), edge_treatment="extend")
    return np.asarray(image.array)


def _given(kernel: F64) -> Drawn:
    """Shares (y, x) that a pixel gives to its neighbours, from a kernel of received shares."""
    return {"kernel": kernel[::-1, ::-1].tolist()}


def _kernel(sides: F64, corners: F64) -> F64:
    """Kernel from shares of the left, right, lower and upper pixel, and of the four corners."""
    left, right, low, up = sides
    kernel = np.array(
        [[corners[0], low, corners[1]], [left, 0, right], [corners[2], up, corners[3]]]
    )
    kernel[1, 1] = 1 - kernel.sum()
    return kernel


@law("ipc", "symmetric", 1.5e-3, 0.02, "to each next pixel")
def symmetric(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Capacitances between neighbours, and about a tenth of them between diagonal ones."""
    kernel = _kernel(np.full(4, size), np.full(4, size * rng.uniform(0.05, 0.15)))
    bench.signal.append(lambda e, _: coupled(e, kernel))
    return _given(kernel)


@law("ipc", "asymmetric", 1.5e-3, 0.02, "to the next pixel, the largest")
def asymmetric(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Each direction has its own share; wiring couples one way as well."""
    sides = size * rng.uniform(0.1, 1, 4)
    sides *= size / sides.max()
    kernel = _kernel(sides, size * rng.uniform(0.02, 0.2, 4))
    bench.signal.append(lambda e, _: coupled(e, kernel))
    return _given(kernel)


@law("ipc", "four_rows", 3e-3, 0.03, "to the next row, the largest")
def four_rows(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Readout lines shared by groups of four rows: coupling differs from row to row."""
    rows = np.arange(bench.shape[0]) % 4
    up, down, across = rng.uniform(0, 1, (3, 4)) * np.array([[1], [1], [0.25]])
    scale = size / max(up.max(), down.max())
    shares = [scale * s[rows][:, None] for s in (up, down, across)]

    def couples(e: F64, _: Frame) -> F64:
        # A row gives shares to the one above, the one below, and to the right.
        above, below, right = (s * e for s in shares)
        out = e - above - below - right
        out[1:] += above[:-1]
        out[-1] += above[-1]
        out[:-1] += below[1:]
        out[0] += below[0]
        out[:, 1:] += right[:, :-1]
        out[:, -1] += right[:, -1]
        return np.asarray(out)

    bench.signal.append(couples)
    drawn = {"above": up, "below": down, "right": across}
    return {name: (scale * s).tolist() for name, s in drawn.items()}


def _left_behind(shares: F64, frames: F64) -> Step:
    """Traps that capture shares of the charge, each with a release time in frames."""
    kept: dict[str, F64] = {}
    given = 1 - np.exp(-1 / frames)

    def lags(e: F64, frame: Frame) -> F64:
        if frame.index == 0:
            kept["traps"] = np.zeros((len(shares), *e.shape))
        back = given[:, None, None] * kept["traps"]
        taken = shares[:, None, None] * e
        kept["traps"] += taken - back
        return np.asarray(e + back.sum(0) - taken.sum(0))

    return lags


@law("lag", "linear", 2e-4, 0.02, "of the last frame", varied_phases=True)
def linear_lag(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """All remaining charge appears in the next frame."""
    bench.charge.append(_left_behind(np.array([size]), np.array([1e-9])))


@law("lag", "exponentials", 4e-4, 0.02, "of a frame, in all", varied_phases=True)
def exponentials(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Two kinds of traps."""
    share = float(rng.uniform(0.3, 0.7))
    frames = np.array([rng.uniform(0.5, 1.5), rng.uniform(4, 15)])
    bench.charge.append(_left_behind(size * np.array([share, 1 - share]), frames))
    return {"shares": [size * share, size * (1 - share)], "frames": frames.tolist()}


@law("lag", "traps", 20, 800, "e- that traps hold", varied_phases=True, needs="pyxel")
def traps(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Traps of limited capacity, by Pyxel's model of persistence."""
    from pyxel.models.charge_collection.utils_persistence import compute_simple_persistence

    frames = float(rng.uniform(1.2, 3))
    level = float(rng.uniform(0.15, 0.5)) * bench.peak_e
    density = np.array([size / level])
    kept: dict[str, F64] = {}

    def lags(e: F64, frame: Frame) -> F64:
        if frame.index == 0:
            kept["traps"] = np.zeros((1, *e.shape))
        out, kept["traps"] = compute_simple_persistence(
            pixel_array=e.copy(),
            all_trapped_charge=kept["traps"],
            trap_densities=density,
            trap_time_constants=np.array([frames]),
            delta_t=1.0,
            trap_capacities=np.array([size]),
        )
        return np.asarray(out)

    bench.charge.append(lags)
    return {"density": float(density[0]), "frames": frames}


def _deflecting(model: Any) -> Step:
    def moves(e: F64, _: Frame) -> F64:
        return np.asarray(model.applyForward(galsim.ImageD(np.ascontiguousarray(e))).array)

    return moves


@law("brighter_fatter", "power_law", 5e-8, 6e-7, "px/e- of the next border")
def power_law(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Shifts of borders by charge, a power law of distance (Antilogus et al. 2014)."""
    across, alpha = float(rng.uniform(0.6, 1.4)), float(rng.uniform(1.8, 3))
    far = size * 0.2
    model = galsim.cdmodel.PowerLawCD(
        3, size, size * across, far / 2, far / 2 * across, far, far * across, alpha
    )
    bench.charge.append(_deflecting(model))
    return {"ratio_y_x": across, "alpha": alpha}


@law("brighter_fatter", "table", 5e-8, 6e-7, "px/e- of the next border")
def table(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Coefficients as measured: no power law, with individual scatter (Gruen et al. 2015).

    A border belongs to two pixels, so both have the same coefficient for the same charge.
    """
    n = 2
    near = np.arange(-n, n + 1.0)
    scatter = rng.lognormal(0, 0.25, (2, n + 1, n + 1))
    fall = float(rng.uniform(0.6, 1.2))

    def border(axis: int, ahead: Any, beside: Any) -> F64:
        """Coefficient of a border half a pixel ahead for charge at (beside, ahead) from it."""
        r = np.hypot(ahead, beside)
        i, j = (np.abs(ahead) - 0.5).astype(int), np.abs(beside).astype(int)
        size_here = np.where(i <= n, scatter[axis][np.minimum(i, n), np.minimum(j, n)], 0.0)
        return np.asarray(np.sign(ahead) * np.exp(-(r - 0.5) / fall) * size_here * 0.5 / r)

    dy, dx = np.meshgrid(near, near, indexing="ij")
    right, left = border(0, dx - 0.5, dy), -border(0, dx + 0.5, dy)
    top, low = border(1, dy - 0.5, dx), -border(1, dy + 0.5, dx)
    # Charge outside the table of one of the two pixels of a border is ignored for both.
    right[:, 0], left[:, -1], top[0], low[-1] = 0, 0, 0, 0
    scale = size / right[n, n + 1]
    tables = [scale * t for t in (left, right, low, top)]
    bench.charge.append(_deflecting(galsim.cdmodel.BaseCDModel(*tables)))
    return {"right": tables[1].tolist(), "top": tables[3].tolist()}


@law("charge_transfer", "traps", 150, 5000, "e- that the traps of a column hold", needs="pyxel")
def charge_transfer(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Charge captured by traps during its transfer to the output, and released later.

    By Pyxel's model of distortion (Short et al. 2013): the tail grows with the number of transfers,
    and less than in proportion to the charge.
    """
    from pyxel.models.charge_transfer.utils_cdm import run_cdm_parallel

    beta, volume, well = 0.37, 1e-10, 1.5 * bench.peak_e
    step = 1e-3
    release = np.array([step * rng.uniform(0.6, 3)])
    density = np.array([size / (2 * volume * bench.shape[0])])

    def transfers(e: F64, _: Frame) -> F64:
        return np.asarray(
            run_cdm_parallel(
                np.ascontiguousarray(e),
                beta,
                volume,
                step,
                well,
                1.2e7,
                release,
                density,
                np.array([1e-10]),
            )
        )

    bench.charge.append(transfers)
    return {"release_rows": float(release[0] / step)}
