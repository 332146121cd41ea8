"""Errors of the shape, position or phase of fringes."""

from functools import partial

import numpy as np

from second_bench.effects.law import Drawn, law
from second_bench.model import F64, Bench, Run


@law("hyperbolic_fringes", "foot", 4, 20, "mm")
def foot(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Fibre pairs offset from the detector's axis, differently for each set."""
    drawn = {}
    for one in bench.sets:
        angle = rng.uniform(0, 2 * np.pi)
        aside = size * rng.uniform(0.8, 1.2) * np.array([np.cos(angle), np.sin(angle), 0.0])
        for beam in one.beams:
            beam.tip_mm = beam.tip_mm + aside
        drawn[one.name] = aside[:2].tolist()
    return {"foot_mm": drawn}


@law("hyperbolic_fringes", "depth", 0.1, 0.6, "mm")
def depth(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """One tip behind the other: fringes are sections of rings far from their centre."""
    drawn = {}
    for one in bench.sets:
        behind = float(size * rng.uniform(0.8, 1.2) * rng.choice([-1, 1]))
        one.beams[1].tip_mm = one.beams[1].tip_mm + np.array([0, 0, behind])
        drawn[one.name] = behind
    return {"depth_mm": drawn}


def _tilt(bench: Bench, moved_um: F64) -> F64:
    """Change of the fringe vector (rad/px) by displacements of a tip (t, 2), um."""
    per_mm = 2e6 * np.pi / (bench.wavelength_nm * bench.distance_mm) * bench.pitch_um * 1e-3
    return np.asarray(per_mm * moved_um * 1e-3)


def _directions(rng: np.random.Generator) -> F64:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


@law("fringe_jitter", "white", 0.05, 0.8, "um rms of a tip")
def white(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """White vibration of a tip in both directions."""
    for run in bench.fringe_runs():
        run.tilt = run.tilt + _tilt(bench, size * rng.standard_normal((run.frames, 2)))


@law("fringe_jitter", "resonance", 0.05, 0.8, "um rms of a tip")
def resonance(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """A resonance of the mount in one direction, sampled far below its frequency."""
    hertz = float(rng.uniform(20, 90))
    for run in bench.fringe_runs():
        turns = hertz * bench.period_s * np.arange(run.frames) + rng.normal(0, 0.05, run.frames)
        swing = size * np.sqrt(2) * np.sin(2 * np.pi * turns)
        run.tilt = run.tilt + _tilt(bench, swing[:, None] * _directions(rng))
    return {"frequency_hz": hertz}


@law("fringe_jitter", "knocks", 0.05, 0.8, "um rms of a tip")
def knocks(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """Rare large excursions among small ones."""
    for run in bench.fringe_runs():
        moved = rng.standard_t(3, (run.frames, 2)) / np.sqrt(3)
        run.tilt = run.tilt + _tilt(bench, size * moved)


def _ramp(n: int, rng: np.random.Generator) -> F64:
    return np.linspace(0, 1, n)


def _walk(n: int, rng: np.random.Generator) -> F64:
    path = np.cumsum(rng.standard_normal(n))
    return np.asarray((path - path[0]) / np.ptp(path))


def _settling(n: int, rng: np.random.Generator) -> F64:
    return np.asarray(np.exp(-np.arange(n) / (n * rng.uniform(0.05, 0.3))))


SLOW = {"ramp": _ramp, "walk": _walk, "settling": _settling}
"""Slow courses of a run, with a range of about one."""


def _drifts(bench: Bench, size: float, rng: np.random.Generator, *, course: str) -> None:
    for run in bench.fringe_runs():
        moved = size * rng.uniform(0.7, 1.3) * SLOW[course](run.frames, rng)
        run.tilt = run.tilt + _tilt(bench, moved[:, None] * _directions(rng))


for _course in SLOW:
    law("fringe_drift", _course, 0.15, 4, "um of a tip over a run")(
        partial(_drifts, course=_course)
    )


def _steps(run: Run) -> F64:
    """Step of the modulator before each frame, rad."""
    step = np.diff(run.phase, prepend=run.phase[0])
    return np.asarray((step + np.pi) % (2 * np.pi) - np.pi)


@law("rolling_shutter", "exponential", 0.004, 0.08, "of the step", varied_phases=True)
def settles(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """Rows that are read first include the end of the modulator's step."""
    rows = np.arange(bench.shape[0]) / bench.shape[0]
    scale = float(rng.uniform(0.15, 1))
    for run in bench.fringe_runs():
        run.row_phase = run.row_phase - size * _steps(run)[:, None] * np.exp(-rows / scale)
    return {"decay_windows": scale}


@law("rolling_shutter", "ringing", 0.004, 0.08, "of the step", varied_phases=True)
def rings(bench: Bench, size: float, rng: np.random.Generator) -> Drawn:
    """The modulator overshoots, with damped ringing."""
    rows = np.arange(bench.shape[0]) / bench.shape[0]
    scale, turns = float(rng.uniform(0.3, 1)), float(rng.uniform(0.5, 2))
    left = np.exp(-rows / scale) * np.cos(2 * np.pi * turns * rows)
    for run in bench.fringe_runs():
        run.row_phase = run.row_phase - size * _steps(run)[:, None] * left
    return {"decay_windows": scale, "turns": turns}


@law("rolling_shutter", "linear", 0.004, 0.08, "of the step", varied_phases=True)
def creeps(bench: Bench, size: float, rng: np.random.Generator) -> None:
    """The modulator creeps at a constant rate until the last row is read."""
    rows = np.arange(bench.shape[0]) / bench.shape[0]
    for run in bench.fringe_runs():
        run.row_phase = run.row_phase - size * _steps(run)[:, None] * (1 - rows)
