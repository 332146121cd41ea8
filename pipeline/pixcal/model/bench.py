"""Every key of a bench file, in one place: what ``pixcal simulate`` needs (``pixcal/bench/1``)."""

from dataclasses import MISSING, dataclass, field, fields, replace
from datetime import datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from pixcal.model import acquisition
from pixcal.model.config import as_in, parse, quantity
from pixcal.model.errors import InputError
from pixcal.model.yaml_file import read_yaml

SCHEMA = "pixcal/bench/1"

# kinds of calibration frames, and their folders; no fringe set may have these names
CALIBRATIONS = ("bias", "dark", "flat")

MAX_FRAMES = 10_000_000
MAX_DURATION_S = 1e10

# quantities of one unit and range
_adu = partial(quantity, unit="ADU", low=0, high=65535)
_count = partial(quantity, high=MAX_FRAMES, doc="number of frames")
_length = partial(quantity, unit="mm", low=0.1, high=1e7)
_place = partial(quantity, (0.0, 0.0), unit="mm", low=-1e5, high=1e5)
_px = partial(quantity, unit="px", low=1, high=65536)
_rate = partial(quantity, unit="e-/s", low=0, high=1e7)
_seed = partial(quantity, 0, low=0, high=10**18)
_share = partial(quantity, 0.0, low=0, high=0.5)
_time = partial(quantity, unit="s", low=0, high=1e6)


@dataclass(frozen=True)
class SimulatedDetector:
    """The chip, the window of it that is read, and its truth maps, which ``seed`` and chip fix."""

    shape: tuple[int, int] = _px(doc="window that is read out: [rows, columns]")
    pitch_um: float = as_in(acquisition.Detector, "pitch_um")
    gain_e_per_adu: float = as_in(
        acquisition.Detector, "gain_e_per_adu", default=MISSING, doc="conversion gain"
    )
    read_noise_e: float = as_in(acquisition.Detector, "read_noise_e")
    name: str = as_in(acquisition.Detector, "name")
    seed: int = _seed(doc="random seed of the detector: its fixed patterns")
    chip: tuple[int, int] | None = _px(None, doc="whole chip: [rows, columns]; default: the window")
    origin_px: tuple[int, int] | None = _px(None, low=0)
    """first pixel of the window; default: window in the centre"""
    bits: int = quantity(16, low=1, high=16, doc="of the analogue-to-digital converter")
    step_adu: int = quantity(1, unit="ADU", low=1, high=4096)
    """step of the samples (16: 12 bits written as 16)"""
    saturation_adu: float | None = quantity(None, unit="ADU", above=0)
    """samples are clipped here; default: highest code"""
    lowest_adu: int = _adu(0, doc="lowest code: lower samples are read as this")
    full_well_e: float | None = quantity(None, unit="e-", low=1, high=1e7)
    """charge is clipped here; default: never"""
    bias_adu: float = _adu(500.0, doc="mean bias")
    bias_pixel_rms_adu: float = _adu(0.0, doc="rms of the bias pattern from pixel to pixel")
    bias_column_rms_adu: float = _adu(0.0, doc="rms of the bias pattern from column to column")
    dark_e_s: float = _rate(0.0, doc="dark current")
    hot_fraction: float = _share(doc="share of the pixels that are hot")
    hot_rate_e_s: float = _rate(0.0)
    """mean dark current of hot pixels; each has at least half of it"""
    dead_fraction: float = _share(doc="share of the pixels without response")
    prnu_rms: float = _share(doc="relative rms of the response from pixel to pixel")
    delta_rms_px: float = _share(unit="px", doc="rms offset from pixel to pixel, each axis")
    stitch_rms_px: float = _share(unit="px")
    """rms offset from stitching block to block, each axis"""
    stitch_px: tuple[int, int] = _px((64, 64), doc="stitching block: [rows, columns]")
    temperature_c: float = quantity(35.0, unit="C", low=-273.15, high=200, doc="for the headers")

    def __post_init__(self) -> None:
        acquisition.check_printable(self.name)
        for axis, name in enumerate(("rows", "columns")):
            first, size, whole = self.origin[axis], self.shape[axis], self.chip_shape[axis]
            if first < 0 or first + size > whole:
                raise InputError(
                    f"origin_px: {size} {name} from number {first} do not fit on the chip of "
                    f"{whole}; correct origin_px, shape or chip"
                )
        if self.saturation_adu is not None and self.saturation_adu > (1 << self.bits) - 1:
            raise InputError(
                f"saturation_adu: {self.saturation_adu:g} ADU is above the largest code of "
                f"{self.bits} bits, {(1 << self.bits) - 1}; give less, or more bits"
            )
        if self.lowest_adu >= self.top_adu or self.lowest_adu % self.step_adu:
            raise InputError(
                f"lowest_adu: {self.lowest_adu} ADU is no code below saturation; give a multiple "
                "of step_adu below saturation_adu"
            )
        if self.bias_adu >= self.top_adu:
            raise InputError(f"bias_adu: {self.bias_adu:g} ADU leaves no room below saturation")
        if self.hot_fraction + self.dead_fraction > 0.5:
            raise InputError("hot_fraction: its sum with dead_fraction exceeds 0.5; give less")

    @property
    def chip_shape(self) -> tuple[int, int]:
        """Rows and columns of the chip."""
        return self.chip or self.shape

    @property
    def origin(self) -> tuple[int, int]:
        """Chip row and column of the window's first pixel."""
        if self.origin_px is not None:
            return self.origin_px
        (rows, columns), (ny, nx) = self.chip_shape, self.shape
        return (rows - ny) // 2, (columns - nx) // 2

    @property
    def top_adu(self) -> int:
        """Largest value that is read, in ADU."""
        top = (1 << self.bits) - 1
        top = top if self.saturation_adu is None else min(top, int(self.saturation_adu))
        return top // self.step_adu * self.step_adu

    @property
    def chip_centre_px(self) -> tuple[float, float]:
        """The chip's centre as (x, y) in pixels of the window."""
        (rows, columns), (row, column) = self.chip_shape, self.origin
        return (columns - 1) / 2 - column, (rows - 1) / 2 - row


@dataclass(frozen=True)
class SimulatedOptics:
    """Laser, fibres and their light; lengths on the detector are from the chip's centre."""

    wavelength_nm: float = as_in(acquisition.Optics, "wavelength_nm")
    distance_mm: float = _length(doc="fibres to detector, true")
    beam_radius_mm: float = quantity(unit="mm", low=1e-3, high=1e7)
    """1/e² radius of each fibre's light on the detector"""
    nominal_distance_mm: float | None = _length(None)
    """declared distance; default: the true one"""
    offset_mm: tuple[float, float] = _place(doc="projected centre of the fibres: [x, y]")
    pointing_a_mm: tuple[float, float] = _place(doc="peak of A's light from the projection of A")
    pointing_b_mm: tuple[float, float] = _place(doc="peak of B's light from the projection of B")
    power_ratio: float = quantity(1.0, low=1e-3, high=1e3, doc="power of B over that of A")
    visibility: float = quantity(1.0, above=0, high=1)
    """contrast where both fibres give the same intensity"""

    moved: ClassVar = {
        "laser_noise_rms": "effects.intensity_noise.rms",
        "fringes": "effects.hyperbolic_fringes, {foot_mm: null}, if not straight",
    }


def _of_pair(name: str, doc: str) -> Any:
    """Declare an optical setting that a fringe set may override."""
    return as_in(SimulatedOptics, name, default=None, doc=f"{doc}; default: that in optics")


@dataclass(frozen=True)
class SimulatedSet:
    """One scan of the fringes of a pair of fibres."""

    name: str = as_in(acquisition.FringeScan, "name")
    baseline_mm: tuple[float, float] = as_in(acquisition.FringeScan, "baseline_mm")
    count: int = _count(low=1)
    peak_e: float = quantity(unit="e-", low=1e-3, high=1e7)
    """signal of the brightest fringe in the window, for unit response and mean power"""
    baseline_z_mm: float = quantity(0.0, unit="mm", low=-1e4, high=1e4)
    """fibre B minus fibre A along the optical axis (tilt)"""
    offset_mm: tuple[float, float] | None = _of_pair("offset_mm", "centre of this pair")
    distance_mm: float | None = _of_pair("distance_mm", "of this pair, true")
    beam_radius_mm: float | None = _of_pair("beam_radius_mm", "of this pair's light")
    pointing_a_mm: tuple[float, float] | None = _of_pair("pointing_a_mm", "of this pair's fibre A")
    pointing_b_mm: tuple[float, float] | None = _of_pair("pointing_b_mm", "of this pair's fibre B")
    power_ratio: float | None = _of_pair("power_ratio", "of this pair, B over A")
    visibility: float | None = _of_pair("visibility", "of this pair")
    phase_law: str = quantity("random", choices=("random", "ramp"))
    """random: uniform over 2π; ramp: equal steps"""
    phase_step_rad: float = quantity(0.0, unit="rad", low=-1e3, high=1e3, doc="step of a ramp")

    moved: ClassVar = {
        "visibility_jitter_rms": "effects.contrast_noise.polarisation, with polarisation_s: 0",
        "vector_jitter_rad": "effects.fringe_jitter.rms, in rad/px",
    }

    def __post_init__(self) -> None:
        acquisition.check_set(self.name, self.baseline_mm)
        if self.name in CALIBRATIONS:
            raise InputError(
                f"name: {self.name!r} is the folder of calibration frames; choose another"
            )
        if self.phase_law == "ramp" and self.phase_step_rad == 0:
            raise InputError(
                "phase_step_rad: zero, so the phase does not change; give the step of the ramp"
            )


@dataclass(frozen=True)
class ExposureStep:
    """Calibration frames of one exposure time."""

    exptime_s: float = _time(doc="exposure time")
    count: int = _count(low=1)


@dataclass(frozen=True)
class SimulatedFrames:
    """What is recorded, in the order bias, dark, flat, fringes, and how it is filed."""

    exptime_s: float = _time(low=1e-9, doc="of the fringe frames")
    period_s: float = _time(low=1e-9, doc="time from frame to frame; longer exposures take longer")
    start: str = quantity("2026-01-01T00:00:00", doc="time of the first frame, ISO 8601, UTC")
    per_file: int = quantity(1, low=1, high=100_000, doc="1: 2-D frames; more: 3-D cubes")
    compress: tuple[str, ...] = quantity((), doc="bias, dark, flat or sets to tile-compress (RICE)")
    bias: int = _count(0, low=0, doc="number of bias frames")
    bias_exptime_s: float = _time(0.0, doc="of the bias frames")
    darks: tuple[ExposureStep, ...] = quantity(())
    """dark frames, one entry for each exposure time"""
    flats: tuple[ExposureStep, ...] = quantity(())
    """flats under a steady lamp, one entry for each exposure time"""
    flat_rate_e_s: float | None = quantity(None, unit="e-/s", low=1e-3, high=1e12)
    """signal rate under the lamp, for unit response"""
    fringes: tuple[SimulatedSet, ...] = quantity((), doc="the fringe sets")

    def __post_init__(self) -> None:
        names = [*CALIBRATIONS, *(s.name for s in self.fringes)]
        acquisition.check_names("fringes", names)
        for name in self.compress:
            if name not in names:
                raise InputError(f"compress: {name!r} is not one of {', '.join(names)}")
        for key, steps in (("darks", self.darks), ("flats", self.flats)):
            times = [step.exptime_s for step in steps]
            if len(set(times)) < len(times):
                raise InputError(f"{key}: two entries have the same exptime_s; join them")
        if self.flats and self.flat_rate_e_s is None:
            raise InputError("flat_rate_e_s: missing (in e-/s); flats need it")
        if not (self.bias or self.darks or self.flats or self.fringes):
            raise InputError("bias, darks, flats, fringes: no frames at all; give some")
        if self.period_s < self.exptime_s:
            raise InputError(f"period_s: shorter than exptime_s ({self.exptime_s:g} s)")
        try:
            moment = datetime.fromisoformat(self.start)
        except ValueError as error:
            raise InputError(
                f"start: {self.start!r:.80} is not like 2026-01-01T00:00:00"
            ) from error
        if moment.tzinfo is not None and moment.utcoffset() != timedelta(0):
            raise InputError(f"start: {self.start!r:.80} is not in UTC; omit the time zone")
        counts = [(self.bias, self.bias_exptime_s), *((s.count, 0.0) for s in self.fringes)]
        counts += [(step.count, step.exptime_s) for step in (*self.darks, *self.flats)]
        seconds = sum(count * max(self.period_s, exptime) for count, exptime in counts)
        if seconds > MAX_DURATION_S or not 1858 < moment.year < 2200:
            raise InputError(f"start: {self.start!r:.80} and {seconds:g} s later: not a date")


# Computed once, because a diagnosis uses them thousands of times.
_OPTICS_OF_SETS = {f.name for f in fields(SimulatedOptics)} & {f.name for f in fields(SimulatedSet)}


@dataclass(frozen=True)
class Bench:
    """Contents of a bench file."""

    schema: str = quantity(choices=(SCHEMA,))
    detector: SimulatedDetector = quantity()
    optics: SimulatedOptics = quantity()
    frames: SimulatedFrames = quantity()
    seed: int = _seed(doc="random seed of all that changes from frame to frame")
    shot_noise: bool = quantity(True, doc="false: no shot noise")
    effects: dict[str, Any] = field(
        default_factory=dict,
        hash=False,
        metadata={"doc": "effects to add: their names and parameters"},
    )

    def optics_of(self, number: int) -> SimulatedOptics:
        """Optics of a fringe set, by its number: settings of the set override ``optics``."""
        scan = self.frames.fringes[number]
        given = {n: v for n in _OPTICS_OF_SETS if (v := getattr(scan, n)) is not None}
        return replace(self.optics, **given) if given else self.optics


def load_bench(path: Path) -> Bench:
    """Read a bench file."""
    if not path.is_file():
        raise InputError(f"{path}: not found; give a bench file such as configs/demo.yaml")
    return parse(Bench, read_yaml(path), str(path))
