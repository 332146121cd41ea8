"""Readout: noise of lines, drifting levels, telegraph noise and converters."""

from functools import partial
from typing import Any

import numpy as np

from second_bench.effects.fringes import SLOW
from second_bench.effects.law import Drawn, law
from second_bench.model import F64, Bench, Frame, Run, stream


def _lines(bench: Bench, size: float, rng: np.random.Generator, *, axis: int) -> None:
    """Every row (axis 0) or column of every frame has an offset."""

    def adds(e: F64, frame: Frame) -> F64:
        one: F64 = frame.rng.standard_normal((e.shape[0], 1) if axis == 0 else (1, e.shape[1]))
        return e + size * one

    bench.offset.append(adds)


for _axis, _name in enumerate(("rows", "columns")):
    law("row_noise", _name, 0.5, 10, "e- rms")(partial(_lines, axis=_axis))


@law("row_noise", "correlated", 0.5, 10, "e- rms")
def correlated(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """The reference drifts during readout, so noise of neighbouring rows is correlated."""
    kept = float(rng.uniform(0.4, 0.85))

    def adds(e: F64, frame: Frame) -> F64:
        steps: F64 = frame.rng.standard_normal((e.shape[0],))
        level = np.empty_like(steps)
        level[0] = steps[0]
        for n in range(1, len(steps)):
            level[n] = kept * level[n - 1] + np.sqrt(1 - kept**2) * steps[n]
        return np.asarray(e + size * level[:, None])

    bench.offset.append(adds)
    return {"correlation": kept}


def _drifts(bench: Bench, size: float, rng: np.random.Generator, *, course: str) -> None:
    for run in bench.runs:
        moved = size * rng.uniform(0.7, 1.3) * SLOW[course](run.frames, rng)
        run.level_e = run.level_e + moved


for _course in SLOW:
    law("bias_drift", _course, 2, 80, "e- over each run")(partial(_drifts, course=_course))


@law("bias_drift", "night", 4, 120, "e- over the night")
def night(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Warming-up through all runs."""
    end = max(run.start_s + run.frames * bench.period_s for run in bench.runs)
    scale = float(rng.uniform(0.3, 2)) * end
    for run in bench.runs:
        seconds = run.start_s + np.arange(run.frames) * bench.period_s
        share = (1 - np.exp(-seconds / scale)) / (1 - np.exp(-end / scale))
        run.level_e = run.level_e + size * share
    return {"scale_s": scale}


def switching(run: Run, dwell_s: F64, period_s: float, rng: np.random.Generator) -> F64:
    """Two-level states (t, pixel) of traps with mean dwell times low and high (2, pixel), s."""
    leave = 1 - np.exp(-period_s / dwell_s)
    state = np.empty((run.frames, dwell_s.shape[1]))
    high = rng.random(dwell_s.shape[1]) < dwell_s[1] / dwell_s.sum(0)
    for n in range(run.frames):
        high ^= rng.random(high.shape) < np.where(high, leave[1], leave[0])
        state[n] = high
    return state


def _telegraph(
    bench: Bench, share: float, amplitude: Any, rng: np.random.Generator, high: float | None = None
) -> None:
    ny, nx = bench.shape
    where = np.flatnonzero(rng.random(ny * nx) < share)
    dwell = np.exp(rng.uniform(np.log(0.1), np.log(3), (2, len(where))))
    own = amplitude(len(where)) * rng.choice([-1, 1], len(where))
    if high is not None:
        dwell[1] = dwell[0] * high / (1 - high)
        own = np.abs(own)
    state = {
        run.name: switching(run, dwell, bench.period_s, stream(bench.seed, "traps", run.name))
        for run in bench.runs
    }

    def switches(e: F64, frame: Frame) -> F64:
        out = e.copy()
        out.flat[where] += own * state[frame.run.name][frame.index]
        return out

    bench.offset.append(switches)


@law("telegraph_noise", "population", 15, 250, "e-, the median")
def population(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Amplitudes over a decade, dwell times over more, unequal in the two levels."""
    share = float(np.exp(rng.uniform(np.log(0.005), np.log(0.04))))
    _telegraph(bench, share, lambda n: size * np.exp(rng.uniform(-1.15, 1.15, n)), rng)
    return {"share": share}


@law("telegraph_noise", "exponential", 15, 250, "e-, the mean")
def exponential(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Exponentially distributed amplitudes, as in MOS transistors (Wang et al. 2006)."""
    share = float(np.exp(rng.uniform(np.log(0.005), np.log(0.04))))
    _telegraph(bench, share, lambda n: rng.exponential(size, n), rng)
    return {"share": share}


@law("telegraph_noise", "spikes", 40, 400, "e-, the median")
def spikes(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Pixels that are in the upper level for a small part of the time."""
    share, high = (float(np.exp(rng.uniform(*np.log(r)))) for r in ((0.005, 0.04), (0.03, 0.15)))
    _telegraph(bench, share, lambda n: size * np.exp(rng.uniform(-0.6, 0.6, n)), rng, high)
    return {"share": share, "high": high}


def _coarse(bench: Bench, rng: np.random.Generator) -> Drawn:
    """A converter of about 12 bits with steps similar to the noise."""
    bench.coarsen(float(rng.uniform(8, 30)) / bench.gain_e_per_adu)
    return {"gain_e_per_adu": bench.gain_e_per_adu}


def _codes(bench: Bench) -> int:
    return int(1.6 * bench.peak_e / bench.gain_e_per_adu + bench.bias_adu.max()) + 64


@law("quantisation", "missing", 0.02, 0.3, "of the codes")
def missing(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Codes that never occur and are replaced by the next one."""
    drawn = _coarse(bench, rng)
    there = rng.random(_codes(bench)) >= size
    there[-1] = True
    following = np.flatnonzero(there)
    code = following[np.searchsorted(following, np.arange(len(there)))].astype(float)

    def converts(adu: F64, _: Frame) -> F64:
        return np.asarray(code[np.clip(np.rint(adu), 0, len(code) - 1).astype(int)])

    bench.samples.append(converts)
    return drawn


@law("quantisation", "steps", 0.05, 0.6, "codes rms")
def steps(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Displaced thresholds, as in a flash or ramp converter."""
    drawn = _coarse(bench, rng)
    count = _codes(bench)
    thresholds = np.sort(np.arange(1, count) - 0.5 + rng.normal(0, size, count - 1))
    bench.samples.append(lambda adu, _: np.searchsorted(thresholds, adu).astype(float))
    return drawn


@law("quantisation", "weights", 5e-4, 0.01, "rms of a bit's weight")
def weights(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Successive approximation with inaccurate references."""
    drawn = _coarse(bench, rng)
    bits = int(np.ceil(np.log2(_codes(bench))))
    true = 2.0 ** np.arange(bits) * (1 + size * rng.standard_normal(bits))

    def converts(adu: F64, _: Frame) -> F64:
        rest, code = adu + 0.5, np.zeros_like(adu)
        for bit in reversed(range(bits)):
            reached = rest >= true[bit]
            rest = rest - reached * true[bit]
            code += reached * 2.0**bit
        return code

    bench.samples.append(converts)
    return drawn | {"weights": true.tolist()}


@law("quantisation", "levels", 5e-4, 0.01, "rms of a bit's weight")
def levels(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """The nearest of the levels of inaccurate weights."""
    drawn = _coarse(bench, rng)
    codes = np.arange(_codes(bench))
    bits = int(np.ceil(np.log2(len(codes))))
    true = 2.0 ** np.arange(bits) * (1 + size * rng.standard_normal(bits))
    level = (codes[:, None] >> np.arange(bits) & 1) @ true
    order = np.argsort(level, kind="stable")
    between = (level[order][1:] + level[order][:-1]) / 2
    bench.samples.append(lambda adu, _: order[np.searchsorted(between, adu)].astype(float))
    return drawn | {"weights": true.tolist()}


@law("quantisation", "references", 0.1, 1.0, "codes rms")
def references(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Coarse steps between independently inaccurate references, with uniform fine steps."""
    drawn = _coarse(bench, rng)
    fine = 2 ** int(rng.integers(4, 7))
    count = _codes(bench)
    off = np.repeat(rng.normal(0, size, count // fine + 1), fine)[: count - 1]
    thresholds = np.maximum.accumulate(np.arange(1, count) - 0.5 + off)
    bench.samples.append(lambda adu, _: np.searchsorted(thresholds, adu).astype(float))
    return drawn | {"fine": fine}
