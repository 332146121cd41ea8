"""Fringes that are hyperbolas, not the straight lines of the paraxial limit."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels import optics
from pixcal.kernels.beams import MODULATED, Light
from pixcal.kernels.optics import Geometry
from pixcal.kernels.scene import DetectorMaps, Rows, geometry
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, LightStart, Stage
from pixcal.simulation.recording import Recording


@dataclass(frozen=True)
class FibrePair:
    """Position of the fibre pair of one fringe set."""

    set: str = quantity()
    """name of the fringe set"""
    foot_mm: tuple[float, float] = quantity(unit="mm", low=-1e4, high=1e4)
    """position of the fibre pair relative to the chip centre"""
    height_mm: float = quantity(0.0, unit="mm", low=-100, high=100)
    """fibre B further from the detector than A"""


@dataclass(frozen=True)
class HyperbolicFringes(Effect):
    """Difference between the exact phase of two fibre tips and its paraxial limit."""

    name = "hyperbolic_fringes"
    title = "hyperbolic fringes"
    acts_at = Stage.LIGHT
    order = 6
    domains = ("space",)
    strengths = ("share",)
    fit_model = "hyperbolic"
    smooth_degree = 1  # keeps the curvature of the phase, which is the effect
    frames_needed = ("axis",)
    sources = (
        "Rousset et al., section 5.2 and figures 5, 14 and 15: fibres at 40 cm, (18 mm, 18 mm) "
        "from the centre of the window",
        "Born & Wolf, Principles of Optics, section 7.3: fringes of two point sources",
    )

    foot_mm: tuple[float, float] | None = quantity((18.0, 18.0), unit="mm", low=-1e4, high=1e4)
    """position of the fibre pair relative to the chip centre; null: that of the bench"""
    distance_mm: float | None = quantity(None, unit="mm", above=0, high=1e7)
    """distance from the fibres to the detector; default: that of the bench"""
    share: float = quantity(1.0, low=-100, high=100)
    """share of the exact curvature: 1 exact, 0 straight"""
    pairs: tuple[FibrePair, ...] = quantity(())
    """position of the fibre pair of each set"""

    def light(self, light: Light, recording: Recording, rows: Rows, maps: DetectorMaps) -> Light:
        if recording.kind != "fringes":
            return light
        bench = recording.bench
        x = np.arange(bench.detector.shape[1]) + maps.delta_x.astype(float)
        y = np.arange(*rows)[:, None] + maps.delta_y.astype(float)
        turn = self.share * curvature_phase(x, y, self.geometry(bench, recording.number))
        beams = (b.delayed(turn) if b.fibre == MODULATED else b for b in light.beams)
        return replace(light, beams=tuple(beams))

    def geometry(self, bench: Bench, number: int) -> Geometry:
        """Geometry of a fringe set with given foot and distance, and the same fringe vector."""
        placed, pitch = geometry(bench, number), bench.detector.pitch_um * 1e-3
        distance = self.distance_mm or placed.distance
        wider = distance / placed.distance
        scan, (x, y) = bench.frames.fringes[number], bench.detector.chip_centre_px
        pair = next((p for p in self.pairs if p.set == scan.name), None)
        if pair is None and self.foot_mm is not None:
            pair = FibrePair(scan.name, self.foot_mm)
        if pair is not None:
            foot_x, foot_y = pair.foot_mm
            placed = replace(
                placed,
                centre_x=x * pitch + foot_x,
                centre_y=y * pitch + foot_y,
                baseline_z=pair.height_mm,
            )
        return replace(
            placed,
            distance=distance,
            baseline_x=placed.baseline_x * wider,
            baseline_y=placed.baseline_y * wider,
        )

    @classmethod
    def starts(cls, evidence: Evidence) -> list[LightStart]:
        """A common foot of all sets, or one position per set, at the nominal distance."""
        pairs = tuple(FibrePair(name, (0.0, 0.0)) for name in evidence.fringes)
        common = cls((0.0, 0.0), evidence.distance_mm)
        separate = cls(None, evidence.distance_mm, pairs=pairs)
        return [
            LightStart(common, ("foot_mm",), "one fibre position for all sets"),
            LightStart(separate, ("pairs",), "a separate fibre position for each set"),
        ]


def curvature_phase(x: F64, y: F64, where: Geometry) -> F64:
    """Exact minus paraxial phase, rad, at pixels x, y."""
    return optics.phase(x, y, where) - optics.paraxial_phase(x, y, where)
