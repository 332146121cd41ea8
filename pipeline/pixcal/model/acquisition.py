"""An acquisition: the directory that a bench writes, described by ``acquisition.yaml``.

The layout is fixed by the interface (schema ``pixcal/acquisition/1``).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from pixcal.model.config import parse, quantity
from pixcal.model.errors import InputError
from pixcal.model.yaml_file import read_yaml

SCHEMA = "pixcal/acquisition/1"
# shortest period along x and y: below 2 px fringes are aliased to wider ones of another direction,
# and nominal vectors are accurate to some 10 %
SHORTEST_PX = 2.2


@dataclass(frozen=True)
class Detector:
    """The detector as declared."""

    pitch_um: float = quantity(unit="um", low=0.01, high=1000, doc="pixel pitch")
    read_noise_e: float = quantity(unit="e-", low=0, high=1e6, doc="read noise, rms")
    gain_e_per_adu: float | None = quantity(None, unit="e-/ADU", low=1e-6, high=1e6)
    """conversion gain; default: that of the flats"""
    name: str = quantity("", doc="free text")
    full_well_e: float | None = quantity(None, unit="e-", low=1, high=1e12, doc="full well")
    saturation_adu: float | None = quantity(None, unit="ADU", above=0, high=1e12)
    """samples at or above this level are saturated"""

    def __post_init__(self) -> None:
        check_printable(self.name)


@dataclass(frozen=True)
class Optics:
    """The bench's nominal optics."""

    wavelength_nm: float = quantity(unit="nm", low=1, high=1e6, doc="laser wavelength")
    distance_mm: float = quantity(unit="mm", low=0.1, high=1e7, doc="fibres to detector, nominal")
    frame_period_s: float | None = quantity(None, unit="s", low=1e-9, high=1e9)
    """used where the headers hold no time stamps"""


def check_printable(name: str) -> None:
    """Raise InputError if a name cannot be printed."""
    if not name.isprintable():
        raise InputError(
            f"name: {name!r:.80} must be text without line breaks and control characters"
        )


def _check_globs(key: str, globs: tuple[str, ...]) -> None:
    for number, glob in enumerate(globs):
        if not glob.isprintable() or not glob.strip() or Path(glob).is_absolute():
            raise InputError(
                f"{key}[{number}]: {glob!r:.80} is not a glob relative to acquisition.yaml"
            )


def check_set(name: str, baseline_mm: tuple[float, float]) -> None:
    """Raise InputError if the name or baseline of a fringe set, real or simulated, is invalid."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_-]{0,63}", name):
        raise InputError(f"name: {name!r:.80} is not made of letters, digits, '-' and '_'")
    if baseline_mm == (0.0, 0.0):
        raise InputError(
            "baseline_mm: both components are zero, so there are no fringes; give the vector "
            "from fibre A to fibre B"
        )


def check_names(key: str, names: Sequence[str]) -> None:
    """Raise InputError if two fringe sets have the same name."""
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"{key}: two sets are named {name!r}; rename one")


@dataclass(frozen=True)
class FringeScan:
    """One scan of the fringes of one pair of fibres."""

    name: str = quantity(doc="letters, digits, '-' and '_'")
    files: tuple[str, ...] = quantity(doc="globs relative to acquisition.yaml")
    baseline_mm: tuple[float, float] = quantity(unit="mm", low=-1e4, high=1e4)
    """fibre B minus fibre A along x and y"""

    def __post_init__(self) -> None:
        check_set(self.name, self.baseline_mm)
        if re.fullmatch("mask|delta_(x|y|fringe)(_sigma)?", self.name):
            raise InputError(f"name: {self.name!r} is reserved for a result; choose another")
        if not self.files:
            raise InputError("files: the list is empty; give globs")
        _check_globs("files", self.files)


@dataclass(frozen=True)
class Frames:
    """Globs of the frames of each kind."""

    bias: tuple[str, ...] = quantity((), doc="no light, shortest exposure")
    dark: tuple[str, ...] = quantity((), doc="no light, any exposure times")
    flat: tuple[str, ...] = quantity((), doc="uniform light, any exposure times")
    fringes: tuple[FringeScan, ...] = quantity((), doc="the fringe sets")

    def __post_init__(self) -> None:
        for kind in ("bias", "dark", "flat"):
            _check_globs(kind, getattr(self, kind))


@dataclass(frozen=True, kw_only=True)
class Acquisition:
    """Contents of ``acquisition.yaml``."""

    schema: str = quantity(choices=(SCHEMA,))
    detector: Detector = quantity()
    optics: Optics | None = quantity(None)
    frames: Frames = quantity()

    def __post_init__(self) -> None:
        check_names("frames.fringes", [s.name for s in self.frames.fringes])
        if self.frames.fringes and self.optics is None:
            raise InputError("optics: missing; with fringes give its wavelength_nm and distance_mm")
        for number, one in enumerate(self.frames.fringes):
            shift = max(map(abs, one.baseline_mm)) * self.detector.pitch_um
            period = 1e-3 * self.fibres.wavelength_nm * self.fibres.distance_mm / shift
            if period < SHORTEST_PX:
                raise InputError(
                    f"frames.fringes[{number}].baseline_mm: wavelength_nm × distance_mm / (1000 × "
                    f"pitch_um × baseline_mm) is a fringe period of {period:.2g} px, below "
                    f"{SHORTEST_PX:g} px along x or y; check these four numbers and their units"
                )
        kinds = (self.frames.bias, self.frames.dark, self.frames.flat, self.frames.fringes)
        if not any(kinds):
            raise InputError("frames: no files are listed; give globs")
        if self.detector.gain_e_per_adu is None and not self.frames.flat:
            raise InputError(
                "detector.gain_e_per_adu: missing, and without flat frames it cannot be measured; "
                "give it in e-/ADU"
            )

    @property
    def fibres(self) -> Optics:
        """The bench's optics; without fringes, placeholder values that no result depends on."""
        return self.optics or Optics(wavelength_nm=632.8, distance_mm=400.0)


def load_acquisition(path: Path) -> Acquisition:
    """Read an acquisition description: a directory, or the YAML file itself."""
    file = path / "acquisition.yaml" if path.is_dir() else path
    if not file.exists():
        raise InputError(f"{file}: not found; an acquisition is a directory with acquisition.yaml")
    return parse(Acquisition, read_yaml(file), str(file))
