"""Time and memory of a method on one reduced cube, in a separate process."""

import re
import shutil
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from comparators import advanced_iterative, alternating, curve_fit
from pixcal.engine.run import Runtime
from pixcal.stages import fit

F64 = NDArray[np.float64]

PIXCAL = "pixcal fit"


@dataclass(frozen=True)
class Task:
    """Input of a method."""

    run: Path  # that has been reduced
    name: str  # of the fringe set
    vector: tuple[float, float]  # nominal fringe vector, rad/px
    read_noise: float  # e- rms
    pixels: int  # how many pixels are fitted by the method that takes them one by one


@dataclass(frozen=True)
class Result:
    """One run of a method."""

    seconds: float  # from the reduced cube on disk to the phases of all pixels
    # of it, until all frames are in memory as float64; 0 where a method reads as it goes
    reading: float
    # (y, x) rad, NaN where not fitted; None where the run's products have the map
    phase: F64 | None


def read_cube(run: Path, name: str) -> F64:
    """Frames (t, y, x) of a set in electrons, as a user of zarr reads them.

    Raises ValueError if samples are missing, which the comparators cannot handle.
    """
    stored = zarr.open_array(run / "reduce" / "reduced.zarr" / name / "signal", mode="r")
    codes, attrs = np.asarray(stored[:]), dict[str, Any](stored.attrs)
    if (codes == attrs["_FillValue"]).any():
        raise ValueError(f"{run}: samples are missing; take a bench that never saturates")
    cube: F64 = np.multiply(codes, attrs["scale_factor"], dtype=np.float64)
    cube += attrs["add_offset"]
    return cube


def whole(fit_phases: Callable[[F64, tuple[float, float]], F64], task: Task) -> Result:
    """A method that takes all pixels at once."""
    begin = time.perf_counter()
    cube = read_cube(task.run, task.name)
    reading = time.perf_counter() - begin
    phase = fit_phases(cube, task.vector)
    return Result(time.perf_counter() - begin, reading, phase)


def pixel_by_pixel(task: Task) -> Result:
    """``curve_fit`` on some pixels; the time that they took is scaled to all."""
    begin = time.perf_counter()
    cube = read_cube(task.run, task.name)
    reading = time.perf_counter() - begin
    frames = curve_fit.demodulate(cube, task.vector)
    ready = time.perf_counter() - begin
    chosen = np.zeros(cube.shape[1:], bool)
    rng = np.random.default_rng(0)
    chosen.flat[rng.choice(chosen.size, min(task.pixels, chosen.size), replace=False)] = True
    phase = curve_fit.fit_phases(cube, task.vector, frames, chosen, task.read_noise)
    fitting = time.perf_counter() - begin - ready
    return Result(ready + fitting * chosen.size / chosen.sum(), reading, phase)


def pixcal(task: Task) -> Result:
    """``pixcal fit`` with its defaults, Allan batches and products included."""
    for stage in ("sweep", "fit"):
        shutil.rmtree(task.run / stage, ignore_errors=True)
    begin = time.perf_counter()
    fit.run(task.run, fit.Config(), Runtime())
    return Result(time.perf_counter() - begin, 0.0, None)


METHODS: dict[str, Callable[[Task], Result]] = {
    PIXCAL: pixcal,
    "alternating, A and B constant": partial(whole, partial(alternating.fit_phases, constant=True)),
    "alternating, A and B free": partial(whole, partial(alternating.fit_phases, constant=False)),
    "advanced iterative": partial(whole, advanced_iterative.fit_phases),
    "curve_fit per pixel": pixel_by_pixel,
}


def memory(field: str) -> int:
    """Bytes of memory of this process: ``VmRSS`` now, ``VmHWM`` at most.

    Not ru_maxrss, which starts at the peak of the parent process.
    """
    (kibibytes,) = re.findall(rf"{field}:\s+(\d+)", Path("/proc/self/status").read_text())
    return int(kibibytes) * 1024


def cost(method: str, task: Task, repeat: int) -> tuple[dict[str, float], F64 | None]:
    """Time and memory of a method, and its map of phases if the run's products lack it.

    It runs once for its memory and to warm up, then ``repeat`` times for its time.
    """
    run = METHODS[method]
    start = memory("VmRSS")
    first = run(task)
    peak = memory("VmHWM")
    best = min((run(task) for _ in range(repeat)), key=lambda result: result.seconds)
    told = {
        "seconds": best.seconds,
        "reading_seconds": best.reading,
        "first_seconds": first.seconds,
        "memory_bytes": peak - start,
        "imports_bytes": start,
    }
    return told, first.phase


def cost_apart(method: str, task: Task, repeat: int) -> tuple[dict[str, float], F64 | None]:
    """`cost`, in a new process."""
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return pool.submit(cost, method, task, repeat).result()
