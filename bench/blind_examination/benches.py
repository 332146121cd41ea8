"""The bench of a case, drawn independently of the truth."""

from dataclasses import dataclass

import numpy as np

from pixcal.model.bench import (
    SCHEMA,
    Bench,
    ExposureStep,
    SimulatedDetector,
    SimulatedFrames,
    SimulatedOptics,
    SimulatedSet,
)

PITCH_UM, WAVELENGTH_NM, DISTANCE_MM = 4.4, 632.8, 400.0
LAMP_E_S = 1.2e6
# phase step of a ramp: near the golden angle, so that phases of any run of frames spread evenly
STEP_RAD = (2.37, 2.43)


@dataclass(frozen=True)
class Layout:
    """What is recorded in every case of an examination."""

    shape: tuple[int, int]  # rows and columns
    frames: int  # of each fringe set
    bias: int  # bias, dark, flat: number of frames; for flats per level
    dark: int
    flat: int
    second: float  # share of the cases with a second baseline along one axis


# by name of the size; `tiny` is for tests of the procedure, too small to detect much
LAYOUTS = {
    "tiny": Layout((33, 35), 60, 12, 8, 8, 0.0),
    "small": Layout((61, 67), 300, 60, 20, 20, 0.0),
    "standard": Layout((128, 128), 600, 100, 24, 24, 0.3),
}

MAX_SETS = 3  # most fringe sets of a case
FLATS_S = (0.006, 0.014, 0.022, 0.03)


def draw_bench(layout: Layout, rng: np.random.Generator) -> Bench:
    """A bench within the ranges of real ones; ``rng`` is separate from that of the case's truth.

    One fringe set has random phases and the other a ramp, because some effects are detectable only
    with one of these.
    """
    detector = SimulatedDetector(
        shape=layout.shape,
        pitch_um=PITCH_UM,
        gain_e_per_adu=_round(rng.uniform(0.85, 1.4)),
        read_noise_e=_round(rng.uniform(9.0, 20.0)),
        seed=int(rng.integers(1 << 40)),
        full_well_e=60_000.0,
        bias_adu=_round(rng.uniform(300, 900)),
        bias_pixel_rms_adu=_round(rng.uniform(2, 8)),
        bias_column_rms_adu=_round(rng.uniform(0, 4)),
        dark_e_s=_round(rng.uniform(5, 40)),
        hot_fraction=_round(rng.uniform(0.001, 0.005)),
        hot_rate_e_s=_round(rng.uniform(1e4, 4e4)),
        prnu_rms=_round(rng.uniform(0.005, 0.015)),
        delta_rms_px=_round(rng.uniform(1e-3, 4e-3)),
    )
    optics = SimulatedOptics(
        wavelength_nm=WAVELENGTH_NM,
        distance_mm=DISTANCE_MM,
        beam_radius_mm=_round(rng.uniform(25, 45)),
        visibility=_round(rng.uniform(0.85, 0.97)),
    )
    frames = SimulatedFrames(
        exptime_s=0.02,
        period_s=0.14,
        per_file=layout.frames,
        bias=layout.bias,
        darks=(ExposureStep(0.5, layout.dark),),
        flats=tuple(ExposureStep(seconds, layout.flat) for seconds in FLATS_S),
        flat_rate_e_s=LAMP_E_S,
        fringes=_sets(layout, rng),
    )
    return Bench(SCHEMA, detector, optics, frames, seed=int(rng.integers(1 << 40)))


def _sets(layout: Layout, rng: np.random.Generator) -> tuple[SimulatedSet, ...]:
    """Two axes of different fringe period; in some cases a third set along one axis."""
    spacings = [rng.uniform(4.2, 5.6), rng.uniform(6.4, 9.0)]
    rng.shuffle(spacings)
    ramp = int(rng.integers(2))
    step = _round(rng.uniform(*STEP_RAD))
    peak = _round(rng.uniform(30_000, 45_000))
    third = rng.random() < layout.second, int(rng.integers(2)), rng.uniform(10.0, 13.0)

    def scan(name: str, axis: int, spacing: float, ramped: bool) -> SimulatedSet:
        length = _round(WAVELENGTH_NM * 1e-6 * DISTANCE_MM / (spacing * PITCH_UM * 1e-3))
        return SimulatedSet(
            name=name,
            baseline_mm=(length, 0.0) if axis == 0 else (0.0, length),
            count=layout.frames,
            peak_e=peak,
            phase_law="ramp" if ramped else "random",
            phase_step_rad=step if ramped else 0.0,
        )

    sets = [
        scan(name, axis, spacings[axis], axis == ramp)
        for axis, name in enumerate(("vertical", "horizontal"))
    ]
    if third[0]:
        sets.append(scan("second", third[1], third[2], False))
    return tuple(sets)


def _round(value: float) -> float:
    """Round to four significant digits."""
    return float(f"{value:.4g}")
