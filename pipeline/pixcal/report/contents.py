"""Contents of a report as plain data, which the stage reads and the page draws."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pixcal.model.arrays import F64
from pixcal.report.map_summary import Detail, FlagSummary, MapSummary, Spectrum


@dataclass(frozen=True)
class MapContents:
    """One product of the fit; all maps in px."""

    name: str  # ``delta_x``, ``delta_y`` or ``delta_fringe``
    delta: MapSummary
    sigma: MapSummary
    spectrum: Spectrum | None
    detail: Detail | None = None  # where the whole map is shown in means of blocks


@dataclass(frozen=True)
class SetContents:
    """One fringe set."""

    name: str
    facts: dict[str, Any]  # its entry in ``fit.json``
    iota: MapSummary  # iota, visibility, chi2: mean level (e-), alpha / iota, reduced chi-square
    visibility: MapSummary
    chi2: MapSummary
    flags: FlagSummary
    # parameters of each frame (t,): `time` in s, `B`, `A`, `phi` in rad, `dkx`, `dky` in rad/px
    series: Mapping[str, F64]
    allan: dict[str, Any] | None = None  # its entry in ``allan.json``

    @property
    def moving(self) -> bool:
        """Whether the fringe vector was free in each frame."""
        return bool(np.any(self.series["dkx"] != 0) or np.any(self.series["dky"] != 0))


# title and unit of each map of the reduction
DETECTOR_MAPS = {
    "bias": ("bias", "ADU"),
    "dark_rate": ("dark current", "e⁻/s"),
    "flat": ("flat", "relative response"),
    "read_noise": ("read noise", "e⁻"),
}


@dataclass(frozen=True)
class DetectorContents:
    """Results of ``pixcal reduce``."""

    facts: dict[str, Any] = field(default_factory=dict)  # `reduce.json`; empty where there is none
    # `bias` (ADU), `dark_rate` (e-/s), `flat`, `read_noise` (e-), those that exist
    maps: dict[str, MapSummary] = field(default_factory=dict)
    # `figures_of_merit.json`; empty where there is none
    curves: dict[str, Any] = field(default_factory=dict)
    flags: FlagSummary | None = None

    def shown(self) -> list[tuple[str, str, MapSummary]]:
        """Title, unit and summary of each map that was measured."""
        # Without frames, the reduction assumes a map of one value.
        there = {key: self.maps[key] for key in DETECTOR_MAPS if key in self.maps}
        return [(*DETECTOR_MAPS[key], m) for key, m in there.items() if m.std > 0]


@dataclass(frozen=True)
class DiagnosisContents:
    """Results of ``pixcal diagnose``."""

    facts: dict[str, Any]  # `diagnosis.json`
    # of `curves.json`: each statistic as measured, as simulated, and with the effects
    curves: Sequence[dict[str, Any]]
    titles: Mapping[str, str]  # of the effects of pixcal, by name
    # significance (sigma) above which a statistic differs; that of the curves is corrected for
    # the number of statistics
    noticed: float
    nothing_to_do: bool = False  # whether no cause requires action


@dataclass(frozen=True)
class Contents:
    """A whole run."""

    acquisition: dict[str, Any]  # as in `acquisition.json`
    stages: tuple[Mapping[str, Any], ...]  # as in the manifest of each
    # by array, its ``frames.json`` and the shape (y, x) of its frames; empty where not ingested
    arrays: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    detector: DetectorContents = field(default_factory=DetectorContents)
    fit: dict[str, Any] | None = None  # `fit.json`
    offsets: tuple[MapContents, ...] = ()
    corrected: tuple[MapContents, ...] = ()  # corrected for the causes, if there are any
    sets: tuple[SetContents, ...] = ()
    flags: FlagSummary | None = None  # of the products
    diagnosis: DiagnosisContents | None = None  # if the run was diagnosed
    warnings: tuple[str, ...] = ()  # warnings of the stages
    advice: tuple[str, ...] = ()  # which map to use, and its limits
    # effect of each cause on the map, and its treatment; the header first
    causes: tuple[tuple[str, ...], ...] = ()

    @property
    def has_fringes(self) -> bool:
        """Whether the acquisition lists fringes."""
        return bool(self.acquisition.get("frames", {}).get("fringes"))

    @property
    def pitch_um(self) -> float:
        """Pixel pitch."""
        return float(self.acquisition["detector"]["pitch_um"])

    @property
    def fringe_vectors(self) -> dict[str, tuple[float, float]]:
        """Fringe vector (kx, ky), rad/px, of each set."""
        return {s.name: (s.facts["kx"], s.facts["ky"]) for s in self.sets}

    @property
    def nominal_effects(self) -> list[str]:
        """Effects of the nominal simulation (``--nominal``)."""
        given = [s["config"].get("nominal") for s in self.stages if s["stage"] == "diagnose"]
        return list(given[0] or ()) if given else []

    def masks(self) -> dict[str, FlagSummary]:
        """All masks by title."""
        masks = {f"set {s.name}": s.flags for s in self.sets}
        if self.detector.flags is not None:
            masks = {"calibration frames": self.detector.flags} | masks
        return masks if self.flags is None else masks | {"products": self.flags}
