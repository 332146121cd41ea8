"""Parts of the bench: beams, runs of frames, and the detector."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
WARM_UP = 3
"""Frames exposed before the first recorded frame of each run."""
EXPTIME_S = 0.02
"""Of fringes and flats."""
TOP_ADU = 65535
MARGIN = 4
"""Pixels simulated beyond each side of the written window, where the sensor continues."""


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Separate random numbers for a purpose."""
    return np.random.default_rng([seed, *(crc32(str(name).encode()) for name in names)])


@dataclass
class Beam:
    """Light from the tip of a fibre, or from its image in a reflecting surface."""

    fibre: int  # 0 or 1; the light of the second passes through the phase modulator
    tip_mm: F64  # (3,) from the centre of the plane at the nominal distance, z towards the detector
    aim_mm: F64  # (2,) intersection of the beam's axis with the detector, from the window's centre
    waist_um: float  # 1/e² radius of the fibre's mode
    amplitude: float = 1.0  # of the field on the axis, at the nominal distance
    jones: tuple[float, float] = (1.0, 0.0)  # direction of the polarisation
    delay_rad: float = 0.0


@dataclass
class FringeSet:
    """Light of one fringe set."""

    name: str
    declared_mm: tuple[float, float]  # baseline that the acquisition declares
    beams: list[Beam]
    peak_e: float  # mean of the brightest pixel in the brightest frame
    coherence: float
    stray: F64  # (y, x) light that does not interfere, as a share of the mean light


@dataclass
class Run:
    """Consecutive frames of one kind, including unrecorded ones."""

    name: str
    kind: str  # `bias`, `dark`, `flat` or `fringes`
    exptime_s: float
    start_s: float
    number: int  # of the fringe set
    phase: F64  # (t,) of the modulator, rad
    power: F64  # (t, 2) of the two fibres (of the lamp: the first), 1 on average
    contrast: F64  # (t,) factor on the coherence
    tilt: F64  # (t, 2) added to the fringe vector along x and y, rad/px
    row_phase: F64  # (t, y) added to the phase of each row, rad
    level_e: F64  # (t,) added to the bias

    @property
    def frames(self) -> int:
        """Number of frames, including unrecorded ones."""
        return len(self.phase)


def new_run(
    name: str, kind: str, count: int, rows: int, exptime_s: float, start_s: float, number: int = 0
) -> Run:
    """A run without any change in time."""
    n = count + WARM_UP
    return Run(
        name,
        kind,
        exptime_s,
        start_s,
        number,
        np.zeros(n),
        np.ones((n, 2)),
        np.ones(n),
        np.zeros((n, 2)),
        np.zeros((n, rows)),
        np.zeros(n),
    )


@dataclass(frozen=True)
class Frame:
    """One exposure: its run, its number in it, and random numbers."""

    run: Run
    index: int
    rng: np.random.Generator


Step = Callable[[F64, Frame], F64]
"""A change of an image (y, x)."""


@dataclass
class Bench:
    """Optics and detector; effects change them, or add steps to the readout of a frame."""

    seed: int
    pitch_um: float
    wavelength_nm: float
    distance_mm: float
    period_s: float
    # delta_x, delta_y: (y, x) offsets of the pixels, px
    delta_x: F64
    delta_y: F64
    # response, flat_response: (y, x) to the fringes' light and to the lamp's
    response: F64
    flat_response: F64
    dark_e: F64  # (y, x) in an exposure of the fringes
    read_noise_e: F64  # (y, x), as bias_adu and relative_gain
    bias_adu: F64
    relative_gain: F64
    gain_e_per_adu: float
    declared_gain: float
    full_well_e: float
    flat_e: float
    peak_e: float
    sets: list[FringeSet] = field(default_factory=list)
    runs: list[Run] = field(default_factory=list)
    # charge, signal, offset, samples: steps on collected electrons, on their voltage, on
    # offsets of the readout (e-), and on samples before rounding (ADU)
    charge: list[Step] = field(default_factory=list)
    signal: list[Step] = field(default_factory=list)
    offset: list[Step] = field(default_factory=list)
    samples: list[Step] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)  # ordinary variations that were drawn
    stamped: bool = True  # whether headers have the time and duration of exposures

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ny, nx = self.response.shape
        return ny, nx

    def fringe_runs(self) -> list[Run]:
        """Runs of the fringe sets."""
        return [run for run in self.runs if run.kind == "fringes"]

    def coarsen(self, factor: float) -> None:
        """Enlarge the steps of the converter; the level stays well above the first code."""
        self.gain_e_per_adu *= factor
        self.declared_gain *= factor
        self.bias_adu = 100 + (self.bias_adu - self.bias_adu.mean()) / factor
        self.notes["gain_e_per_adu"] = self.gain_e_per_adu

    def grid(self) -> tuple[F64, F64]:
        """Column and row from the centre of the window: (1, x) and (y, 1), px."""
        ny, nx = self.shape
        x, y = np.arange(nx, dtype=float), np.arange(ny, dtype=float)
        return x[None, :] - (nx - 1) / 2, y[:, None] - (ny - 1) / 2
