"""Samples from light, frame by frame."""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from second_bench.model import EXPTIME_S, F64, TOP_ADU, WARM_UP, Bench, Frame, Run, stream
from second_bench.optics import Light, expose, light_of


def record(bench: Bench) -> Iterator[tuple[Run, NDArray[np.uint16]]]:
    """Runs with their samples (t, y, x), ADU."""
    lights = [light_of(bench, one) for one in bench.sets]
    for run in bench.runs:
        frames = [samples(bench, lights, run, n) for n in range(run.frames)]
        yield run, np.stack(frames[WARM_UP:])


def samples(bench: Bench, lights: list[Light], run: Run, index: int) -> NDArray[np.uint16]:
    """Samples (y, x) of a frame."""
    rng = stream(bench.seed, "frame", run.name, index)
    frame = Frame(run, index, rng)
    signal = rng.poisson(mean_electrons(bench, lights, run, index)).astype(float)
    for step in bench.charge:
        signal = step(signal, frame)
    signal = np.minimum(signal, bench.full_well_e)
    for step in bench.signal:
        signal = step(signal, frame)
    signal += bench.read_noise_e * rng.standard_normal(bench.shape) + run.level_e[index]
    for step in bench.offset:
        signal = step(signal, frame)
    adu = bench.bias_adu + signal * bench.relative_gain / bench.gain_e_per_adu
    for step in bench.samples:
        adu = step(adu, frame)
    return np.clip(np.rint(adu), 0, TOP_ADU).astype(np.uint16)


def mean_electrons(bench: Bench, lights: list[Light], run: Run, index: int) -> F64:
    """Mean electrons of light and dark current."""
    if run.kind == "bias":
        return np.zeros(bench.shape)
    if run.kind == "dark":
        return bench.dark_e * (run.exptime_s / EXPTIME_S)
    if run.kind == "flat":
        return bench.flat_response * (bench.flat_e * float(run.power[index, 0])) + bench.dark_e
    return bench.response * expose(lights[run.number], run, index, bench.grid()) + bench.dark_e
