"""Benches without faults, in their usual variety."""

from dataclasses import dataclass

import numpy as np

from second_bench import less_common
from second_bench.model import EXPTIME_S, F64, TOP_ADU, Beam, Bench, FringeSet, Run, new_run, stream

VARIATIONS = {
    "aim": 1.0,
    "centred": 0.1,
    "radii": 1.0,
    "powers": 1.0,
    "read_noise": 1.0,
    "dust": 0.5,
    "phases": 1.0,
    "amplifiers": 0.3,
    "bad_pixels": 1.0,
    "gain": 0.5,
    "period": 1.0,
    "rotated": 0.25,
    "ambient": 0.3,
    "declared_gain": 0.3,
    "stitches": 0.3,
    "noisy_pixels": 0.3,
    "lamp": 0.5,
    **dict.fromkeys(less_common.LESS_COMMON, less_common.CHANCE),
}
"""What differs from bench to bench, and its probability."""
PITCH_UM, WAVELENGTH_NM, DISTANCE_MM, PERIOD_S = 4.4, 632.8, 400.0, 0.14
PAUSE_S = 60.0
"""Between two runs."""


@dataclass(frozen=True)
class Layout:
    """What is recorded."""

    shape: tuple[int, int] = (128, 128)  # rows and columns
    frames: int = 600  # of each fringe set
    bias: int = 40  # bias, dark, flat: frames; darks last 1 s
    dark: int = 0
    flat: int = 40
    sets: int = 2  # fringe sets: 2, or 1 with the first direction alone


def draw_variations(seed: int) -> set[str]:
    """Variations of an ordinary bench."""
    rng = stream(seed, "variations")
    return {name for name, chance in VARIATIONS.items() if rng.random() < chance}


def draw_bench(layout: Layout, seed: int, varied: set[str]) -> Bench:
    """A bench without faults; ``varied``: deviations from the simplest, of `VARIATIONS`."""
    rng = stream(seed, "detector")
    shape = layout.shape
    gain = float(np.exp(rng.uniform(np.log(0.5), np.log(4)))) if "gain" in varied else 1.0
    peak = min(rng.uniform(36_000, 46_000), 0.8 * TOP_ADU * gain)
    read = max(rng.uniform(8, 20), 1.5 * gain)
    bench = Bench(
        seed=seed,
        pitch_um=PITCH_UM,
        wavelength_nm=WAVELENGTH_NM,
        distance_mm=DISTANCE_MM,
        period_s=PERIOD_S,
        delta_x=rng.normal(0, 6e-3, shape),
        delta_y=rng.normal(0, 6e-3, shape),
        response=rng.normal(1, rng.uniform(0.004, 0.015), shape),
        flat_response=np.ones(shape),
        dark_e=np.full(shape, rng.uniform(0, 2)),
        read_noise_e=np.full(shape, read),
        bias_adu=rng.uniform(300, 1000)
        + (
            rng.normal(0, rng.uniform(2, 8), shape)
            + rng.normal(0, rng.uniform(1, 4), shape[1])
            + rng.normal(0, rng.uniform(0.5, 2), (shape[0], 1))
        )
        / gain,
        relative_gain=np.ones(shape),
        gain_e_per_adu=gain,
        declared_gain=gain,
        full_well_e=1.5 * peak,
        flat_e=0.6 * peak,
        peak_e=peak,
    )
    bench.notes = {"gain_e_per_adu": gain, "read_noise_e": read, "peak_e": peak}
    _vary_detector(bench, varied)
    less_common.vary_camera(bench, varied)
    bench.sets = _draw_sets(bench, varied)[: layout.sets]
    less_common.vary_light(bench, varied)
    bench.flat_response = bench.response * (_lamp(bench) if "lamp" in varied else 1.0)
    bench.runs = _draw_runs(bench, layout, varied)
    less_common.vary_runs(bench, varied)
    return bench


def _vary_detector(bench: Bench, varied: set[str]) -> None:
    rng = stream(bench.seed, "variation of the detector")
    shape = bench.shape
    if "read_noise" in varied:
        spread = rng.uniform(0.05, 0.2)
        bench.read_noise_e *= rng.lognormal(0, spread, shape)
        bench.notes["read_noise_spread"] = spread
    if "bad_pixels" in varied:
        dead, hot = rng.random((2, *shape)) < rng.uniform(2e-4, 1.5e-3, (2, 1, 1))
        bench.response[dead] *= rng.uniform(0, 0.6, dead.sum())
        bench.dark_e[hot] += np.exp(rng.uniform(np.log(300), np.log(15_000), hot.sum()))
        bench.notes |= {"dead_pixels": int(dead.sum()), "hot_pixels": int(hot.sum())}
    if "dust" in varied:
        specks = int(rng.integers(2, 9))
        bench.response *= _dust(bench, specks, rng)
        bench.notes["dust_specks"] = specks
    if "amplifiers" in varied:
        _amplifiers(bench, rng)
    if "stitches" in varied:
        _stitch(bench)
    if "noisy_pixels" in varied:
        rng = stream(bench.seed, "noisy pixels")
        noisy = rng.random(shape) < rng.uniform(0.002, 0.02)
        bench.read_noise_e[noisy] *= rng.uniform(2, 8, noisy.sum())
        bench.notes["noisy_pixels"] = int(noisy.sum())
    if "declared_gain" in varied:
        # Flats measure it better than the data sheet says.
        wrong = float(rng.choice([-1, 1])) * rng.uniform(0.01, 0.1)
        bench.declared_gain *= 1 + wrong
        bench.notes["declared_gain"] = bench.declared_gain


def _dust(bench: Bench, specks: int, rng: np.random.Generator) -> F64:
    """Transmission of a dusty window: soft round shadows, with a brighter rim."""
    x, y = bench.grid()
    ny, nx = bench.shape
    left = np.ones(bench.shape)
    for _ in range(specks):
        r = np.hypot(x - nx * rng.uniform(-0.5, 0.5), y - ny * rng.uniform(-0.5, 0.5))
        radius, depth = rng.uniform(2, 10), rng.uniform(0.01, 0.08)
        left *= 1 - depth * (
            1 / (1 + (r / radius) ** 6) - 0.2 * np.exp(-((r / radius - 1.5) ** 2) * 8)
        )
    return left


def _stitch(bench: Bench) -> None:
    """Adjacent masks of the foundry, each with a small misalignment."""
    rng = stream(bench.seed, "stitches")
    size, first = rng.integers(20, 70, 2), rng.integers(0, 60, 2)
    rms = rng.uniform(1e-3, 4e-3)
    rows, columns = (
        (np.arange(n) + start) // side
        for n, start, side in zip(bench.shape, first, size, strict=True)
    )
    for offsets in (bench.delta_x, bench.delta_y):
        steps = rng.normal(0, rms, (rows[-1] + 1, columns[-1] + 1))
        offsets += steps[rows][:, columns]
    bench.notes["stitches"] = {"size_px": size.tolist(), "rms_px": rms}


def _lamp(bench: Bench) -> F64:
    """Light of the flats, which decreases towards one side."""
    rng = stream(bench.seed, "lamp")
    x, y = bench.grid()
    u, v = x / bench.shape[1], y / bench.shape[0]
    slopes = rng.uniform(-0.1, 0.1, 5)
    bench.notes["lamp"] = slopes.tolist()
    terms = (u, v, u**2, v**2, u * v)
    return np.asarray(1 + sum(a * term for a, term in zip(slopes, terms, strict=True)))


def _amplifiers(bench: Bench, rng: np.random.Generator) -> None:
    """Two halves or four quarters with different gains and offsets."""
    ny, nx = bench.shape
    count = int(rng.choice([2, 4]))
    gains, offsets = rng.uniform(-0.01, 0.01, count), rng.uniform(-20, 20, count)
    for n in range(count):
        rows = slice(None) if count == 2 else (slice(0, ny // 2), slice(ny // 2, ny))[n // 2]
        columns = (slice(0, nx // 2), slice(nx // 2, nx))[n % 2]
        bench.relative_gain[rows, columns] = 1 + gains[n]
        bench.bias_adu[rows, columns] += offsets[n] / bench.gain_e_per_adu
    # The declared gain is the mean of all amplifiers.
    bench.relative_gain /= bench.relative_gain.mean()
    bench.notes["amplifiers"] = gains.tolist()


def _draw_sets(bench: Bench, varied: set[str]) -> list[FringeSet]:
    rng = stream(bench.seed, "optics")
    turn = rng.uniform(0, np.pi / 2) if "rotated" in varied else 0.0
    found = []
    for n, name in enumerate(("vertical", "horizontal")):
        period = np.exp(rng.uniform(np.log(5), np.log(20))) if "period" in varied else 9.0
        if "long_period" in varied:
            period = stream(bench.seed, "long period", name).uniform(20, 32)
        # Fewer than two fringes in the window (without its margin) cannot be fitted.
        period = min(period, min(bench.shape) / 3)
        angle = turn + n * np.pi / 2
        length = WAVELENGTH_NM * 1e-6 * DISTANCE_MM / (period * PITCH_UM * 1e-3)
        declared = np.round(length * np.array([np.cos(angle), np.sin(angle)]), 3)
        # The declared value was read from a scale.
        true = np.append(declared * rng.normal(1, 0.002), 0.0)
        true[:2] += rng.normal(0, 0.002, 2) * true[1::-1] * (-1, 1)
        foot = np.append(rng.normal(0, 0.2, 2), 0.0)
        beams = [
            Beam(fibre, foot + side * true / 2, aim, waist, amplitude)
            for fibre, (side, aim, waist, amplitude) in enumerate(
                zip((1, -1), *_draw_beams(rng, varied), strict=True)
            )
        ]
        beams[1].tip_mm[2] = rng.normal(0, 0.005)
        share = rng.uniform(0.005, 0.04) if "ambient" in varied else 0.0
        found.append(
            FringeSet(
                name,
                (float(declared[0]), float(declared[1])),
                beams,
                bench.peak_e * rng.uniform(0.9, 1),
                rng.uniform(0.85, 0.98),
                np.full(bench.shape, share),
            )
        )
        bench.notes[name] = {
            "period_px": float(period),
            "aims_mm": [b.aim_mm.tolist() for b in beams],
            "waists_um": [b.waist_um for b in beams],
            "amplitudes": [b.amplitude for b in beams],
            "ambient": share,
        }
    return found


def _draw_beams(
    rng: np.random.Generator, varied: set[str]
) -> tuple[list[F64], list[float], list[float]]:
    """Aims (mm), waists (um) and amplitudes of both beams."""
    angle, apart = rng.uniform(0, 2 * np.pi), rng.uniform(0, 10) if "aim" in varied else 2.0
    middle = rng.normal(0, 2.0, 2)
    half = apart / 2 * np.array([np.cos(angle), np.sin(angle)])
    aims = [middle + half, middle - half]
    if "centred" in varied:
        aims = [np.zeros(2), np.zeros(2)]
    # 1/e^2 radii at the detector of 45 down to 30 mm.
    waists = rng.uniform(1.8, 2.7, 2)
    if "radii" not in varied:
        waists[:] = 2.3
    power = rng.uniform(-0.15, 0.15) if "powers" in varied else 0.0
    return aims, waists.tolist(), [float(np.sqrt(1 + power / 2)), float(np.sqrt(1 - power / 2))]


def _draw_runs(bench: Bench, layout: Layout, varied: set[str]) -> list[Run]:
    rng = stream(bench.seed, "phases")
    kinds = [
        ("bias", 0.0, layout.bias),
        ("dark", 1.0, layout.dark),
        ("flat", EXPTIME_S, layout.flat),
    ]
    runs, start = [], 0.0
    for kind, exptime, count in kinds:
        if count:
            runs.append(new_run(kind, kind, count, layout.shape[0], exptime, start))
            start += runs[-1].frames * (PERIOD_S + exptime) + PAUSE_S
    for n, one in enumerate(bench.sets):
        run = new_run(one.name, "fringes", layout.frames, layout.shape[0], EXPTIME_S, start, n)
        start += run.frames * PERIOD_S + PAUSE_S
        law = str(rng.choice(PHASE_LAWS)) if "phases" in varied else "random"
        lost = 3 if "dropped_frames" in varied else 0
        phases = draw_phases(law, run.frames + lost, rng)
        run.phase = less_common.without_dropped(
            phases, lost, stream(bench.seed, "dropped", one.name)
        )
        bench.notes[one.name]["phases"] = law
        runs.append(run)
    return runs


PHASE_LAWS = ("random", "random", "ramp", "four_bucket", "walk")


def draw_phases(law: str, count: int, rng: np.random.Generator) -> F64:
    """Phases of a run, rad."""
    start = rng.uniform(0, 2 * np.pi)
    if law == "random":
        return rng.uniform(0, 2 * np.pi, count)
    if law == "ramp":
        return start + rng.uniform(0.4, 2.6) * np.arange(count, dtype=float)
    if law == "four_bucket":
        return np.asarray(start + np.pi / 2 * (np.arange(count) % 4), float)
    return np.asarray(start + np.cumsum(rng.normal(0, rng.uniform(0.3, 1.2), count)), float)
