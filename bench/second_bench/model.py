"""Parts of the bench: beams, runs of frames, and the detector."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
WARM_UP = 3
"""Frames of each run that are exposed before the first that is recorded."""
EXPTIME_S = 0.02
"""Of fringes and flats."""
TOP_ADU = 65535
MARGIN = 4
"""Pixels that are simulated on every side of those that are written: the sensor goes on there."""


def stream(seed: int, *names: str | int) -> np.random.Generator:
    """Separate random numbers for a purpose."""
    return np.random.default_rng([seed, *(crc32(str(name).encode()) for name in names)])


@dataclass
class Beam:
    """Light from the tip of a fibre, or from its image in a reflecting surface.

    Attributes
    ----------
    fibre : int
        0 or 1; the light of the second passes through the phase modulator.
    tip_mm : ndarray (3,)
        Position from the centre of the plane at the nominal distance, z towards the detector.
    aim_mm : ndarray (2,)
        Intersection of the beam's axis with the detector, from the centre of the window.
    waist_um : float
        1/e^2 radius of the fibre's mode.
    amplitude : float
        Of the field on the axis, at the nominal distance.
    jones : (float, float)
        Direction of the polarisation.
    delay_rad : float
    """

    fibre: int
    tip_mm: F64
    aim_mm: F64
    waist_um: float
    amplitude: float = 1.0
    jones: tuple[float, float] = (1.0, 0.0)
    delay_rad: float = 0.0


@dataclass
class FringeSet:
    """Light of one fringe set.

    Attributes
    ----------
    name : str
    declared_mm : (float, float)
        Baseline that the acquisition declares.
    beams : list of Beam
    peak_e : float
        Mean of the brightest pixel in the brightest frame.
    coherence : float
    stray : ndarray (y, x)
        Light that does not interfere, as a share of the mean light.
    """

    name: str
    declared_mm: tuple[float, float]
    beams: list[Beam]
    peak_e: float
    coherence: float
    stray: F64


@dataclass
class Run:
    """Consecutive frames of one kind, including unrecorded ones.

    Attributes
    ----------
    name, kind : str
        The kind is ``bias``, ``dark``, ``flat`` or ``fringes``.
    exptime_s, start_s : float
    number : int
        Of the fringe set.
    phase : ndarray (t,)
        Of the modulator, rad.
    power : ndarray (t, 2)
        Of the two fibres (of the lamp: the first), 1 on average.
    contrast : ndarray (t,)
        Factor on the coherence.
    tilt : ndarray (t, 2)
        Added to the fringe vector along x and y, rad/px.
    row_phase : ndarray (t, y)
        Added to the phase of each row, rad.
    level_e : ndarray (t,)
        Added to the bias.
    """

    name: str
    kind: str
    exptime_s: float
    start_s: float
    number: int
    phase: F64
    power: F64
    contrast: F64
    tilt: F64
    row_phase: F64
    level_e: F64

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
    """Optics and detector; effects change them, or add steps to the readout of a frame.

    Attributes
    ----------
    seed : int
    pitch_um, wavelength_nm, distance_mm, period_s : float
    delta_x, delta_y : ndarray (y, x)
        Offsets of the pixels, px.
    response, flat_response : ndarray (y, x)
        To the fringes' light and to the lamp's.
    dark_e : ndarray (y, x)
        Electrons in an exposure of the fringes.
    read_noise_e, bias_adu, relative_gain : ndarray (y, x)
    gain_e_per_adu, declared_gain : float
    full_well_e, flat_e, peak_e : float
    sets : list of FringeSet
    runs : list of Run
    charge, signal, offset, samples : list of callables
        Steps on collected electrons, on their voltage, on offsets of the readout (e-), and on
        samples before rounding (ADU).
    notes : dict
        Ordinary variations that were drawn.
    stamped : bool
        Whether headers have the time and duration of exposures.
    """

    seed: int
    pitch_um: float
    wavelength_nm: float
    distance_mm: float
    period_s: float
    delta_x: F64
    delta_y: F64
    response: F64
    flat_response: F64
    dark_e: F64
    read_noise_e: F64
    bias_adu: F64
    relative_gain: F64
    gain_e_per_adu: float
    declared_gain: float
    full_well_e: float
    flat_e: float
    peak_e: float
    sets: list[FringeSet] = field(default_factory=list)
    runs: list[Run] = field(default_factory=list)
    charge: list[Step] = field(default_factory=list)
    signal: list[Step] = field(default_factory=list)
    offset: list[Step] = field(default_factory=list)
    samples: list[Step] = field(default_factory=list)
    notes: dict[str, Any] = field(default_factory=dict)
    stamped: bool = True

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        ny, nx = self.response.shape
        return ny, nx

    def fringe_runs(self) -> list[Run]:
        """Runs of the fringe sets."""
        return [run for run in self.runs if run.kind == "fringes"]

    def grid(self) -> tuple[F64, F64]:
        """Column and row from the centre of the window: (1, x) and (y, 1), px."""
        ny, nx = self.shape
        x, y = np.arange(nx, dtype=float), np.arange(ny, dtype=float)
        return x[None, :] - (nx - 1) / 2, y[:, None] - (ny - 1) / 2
