"""Less common variations of ordinary benches: the camera, the phases and the levels."""

import numpy as np

from second_bench.model import F64, WARM_UP, Bench, Frame, stream

LESS_COMMON = (
    "noise_tail",
    "coarse_gain",
    "hot_clusters",
    "bad_frames",
    "dropped_frames",
    "phase_errors",
    "dim_fringes",
    "far_aims",
    "long_period",
    "levels",
    "no_stamps",
)
CHANCE = 0.15
"""Probability of each."""


def vary_camera(bench: Bench, varied: set[str]) -> None:
    """Read noise, gain and hot pixels."""
    shape = bench.shape
    if "noise_tail" in varied:
        # Every pixel of a CMOS sensor has its own amplifier; a few are much noisier.
        rng = stream(bench.seed, "noise tail")
        tail = rng.uniform(0.1, 0.5)
        bench.read_noise_e *= (1 + rng.exponential(tail, shape)) * rng.lognormal(0, 0.1, shape)
        bench.notes["noise_tail"] = tail
    if "coarse_gain" in varied:
        bench.coarsen(stream(bench.seed, "coarse gain").uniform(10, 16) / bench.gain_e_per_adu)
    if "hot_clusters" in varied:
        rng = stream(bench.seed, "hot clusters")
        count = int(rng.integers(2, 7))
        for _ in range(count):
            middle = [int(rng.integers(3, n - 3)) for n in shape]
            for row, column in np.rint(rng.normal(middle, 1.0, (int(rng.integers(4, 13)), 2))):
                place = int(np.clip(row, 0, shape[0] - 1)), int(np.clip(column, 0, shape[1] - 1))
                bench.dark_e[place] += np.exp(rng.uniform(np.log(300), np.log(15_000)))
        bench.notes["hot_clusters"] = count


def vary_light(bench: Bench, varied: set[str]) -> None:
    """Visibility, aims and levels of the fringe sets."""
    for number, one in enumerate(bench.sets):
        rng = stream(bench.seed, "light", number)
        if "dim_fringes" in varied:
            one.coherence = rng.uniform(0.25, 0.45)
        if "levels" in varied:
            one.peak_e *= rng.uniform(0.3, 1)
        if "far_aims" in varied:
            first, second = (beam.aim_mm for beam in one.beams)
            apart = second - first
            apart *= 10 / max(float(np.linalg.norm(apart)), 1e-3) - 1
            one.beams[0].aim_mm, one.beams[1].aim_mm = first - apart / 2, second + apart / 2
        bench.notes[one.name] |= {"coherence": one.coherence, "peak_e": one.peak_e}


def vary_runs(bench: Bench, varied: set[str]) -> None:
    """Irregular phase steps, and incomplete frames."""
    for run in bench.fringe_runs():
        rng = stream(bench.seed, "frames", run.name)
        if "phase_errors" in varied:
            rms = rng.uniform(0.02, 0.15)
            run.phase = run.phase + rng.normal(0, rms, run.frames)
            bench.notes[run.name]["phase_errors"] = rms
    if "bad_frames" in varied:
        _cut_frames(bench)
    if "no_stamps" in varied:
        bench.stamped = False
        bench.notes["no_stamps"] = True


def _cut_frames(bench: Bench) -> None:
    """The transfer of one or two frames of a set stops at a random row; the rest is zero."""
    cut: dict[tuple[str, int], int] = {}
    for run in bench.fringe_runs():
        rng = stream(bench.seed, "bad frames", run.name)
        for index in rng.integers(WARM_UP, run.frames, int(rng.integers(1, 3))):
            cut[run.name, int(index)] = int(rng.integers(0, bench.shape[0]))
    bench.notes["bad_frames"] = [[*frame, row] for frame, row in cut.items()]

    def cuts(adu: F64, frame: Frame) -> F64:
        row = cut.get((frame.run.name, frame.index))
        if row is None:
            return adu
        return np.where(np.arange(len(adu))[:, None] < row, adu, 0.0)

    bench.samples.append(cuts)


def without_dropped(phase: F64, lost: int, rng: np.random.Generator) -> F64:
    """Phases of a run with missing frames."""
    return np.delete(phase, rng.choice(np.arange(WARM_UP, len(phase)), lost, replace=False))
