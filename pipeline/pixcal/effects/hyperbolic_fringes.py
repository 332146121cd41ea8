"""Fringes that are hyperbolas, not the straight lines of the paraxial limit."""

from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.maps.map_fit import (
    MapFit,
    MapPart,
    centred,
    fit_maps,
    gauge_terms,
    phase_map,
    polynomial,
)
from pixcal.kernels import optics
from pixcal.kernels.optics import Geometry
from pixcal.kernels.scene import DetectorMaps, LightMaps, Rows, geometry
from pixcal.kernels.significance import sigmas_of_chi2
from pixcal.model.arrays import F64
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording

_ITERATIONS = 4
# chi-square by which positions of their own must fit the sets better than a common one,
_APART = 25.0
_MODEL = 0.02  # and the share of all of it


@dataclass(frozen=True)
class FibrePair:
    """Where the fibre pair of one fringe set stands."""

    set: str = quantity(doc="name of the fringe set")
    foot_mm: tuple[float, float] = quantity(
        unit="mm", low=-1e4, high=1e4, doc="position of the fibre pair relative to the chip centre"
    )
    height_mm: float = quantity(
        0.0, unit="mm", low=-100, high=100, doc="fibre B further from the detector than A"
    )


@dataclass(frozen=True)
class HyperbolicFringes(Effect):
    """Difference between the exact phase of two fibre tips and its paraxial limit.

    To leading order the curvature is ``-K·q q² / (2 D²)``, q from the foot of the fibres' centre:
    in proportion to the fringe vector, so in pixels it does not depend on the baseline, and sets
    of other fringe period do not tell it from true offsets. Its shape does: the foot and the
    difference in height of the tips rule the curvature of a set. The arms of a mount do not move
    together: ``pairs`` has the position of each set's fibres, where it is not that of all.

    The maps of a fit do not say where on the chip they lie, so `predict` cannot tell; ``fit --model
    hyperbolic`` takes it up.
    """

    name = "hyperbolic_fringes"
    title = "hyperbolic fringes"
    acts_at = Stage.LIGHT
    order = 6
    domains = ("space",)
    strengths = ("share",)
    fit_model = "hyperbolic"
    frames_needed = ("axis",)
    sources = (
        "Rousset et al., section 5.2 and figures 5, 14 and 15: fibres at 40 cm, (18 mm, 18 mm) "
        "from the middle of the window",
        "Born & Wolf, Principles of Optics, section 7.3: fringes of two point sources",
    )

    foot_mm: tuple[float, float] | None = quantity(
        (18.0, 18.0),
        unit="mm",
        low=-1e4,
        high=1e4,
        doc="position of the fibre pair relative to the chip centre; null: that of the bench",
    )
    distance_mm: float | None = quantity(
        None,
        unit="mm",
        above=0,
        high=1e7,
        doc="distance from the fibres to the detector; default: that of the bench",
    )
    share: float = quantity(
        1.0, low=-100, high=100, doc="share of the exact curvature: 1 exact, 0 straight"
    )
    pairs: tuple[FibrePair, ...] = quantity((), doc="position of the fibre pair of each set")

    def light(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        if recording.kind != "fringes":
            return light
        bench = recording.bench
        x = np.arange(bench.detector.shape[1]) + maps.delta_x.astype(float)
        y = np.arange(*rows)[:, None] + maps.delta_y.astype(float)
        turn = self.share * bending(x, y, self.geometry(bench, recording.number))
        cos, sin = np.cos(turn).astype(np.float32), np.sin(turn).astype(np.float32)
        return replace(
            light,
            alpha_sin=light.alpha_sin * cos + light.alpha_cos * sin,
            alpha_cos=light.alpha_cos * cos - light.alpha_sin * sin,
        )

    def geometry(self, bench: Bench, number: int) -> Geometry:
        """That of a fringe set, with the foot and the distance given, of the same fringe vector."""
        own, pitch = geometry(bench, number), bench.detector.pitch_um * 1e-3
        distance = self.distance_mm or own.distance
        wider = distance / own.distance
        scan, (x, y) = bench.frames.fringes[number], bench.detector.chip_centre_px
        pair = next((p for p in self.pairs if p.set == scan.name), None)
        if pair is None and self.foot_mm is not None:
            pair = FibrePair(scan.name, self.foot_mm)
        if pair is not None:
            foot_x, foot_y = pair.foot_mm
            own = replace(
                own,
                centre_x=x * pitch + foot_x,
                centre_y=y * pitch + foot_y,
                baseline_z=pair.height_mm,
            )
        return replace(
            own,
            distance=distance,
            baseline_x=own.baseline_x * wider,
            baseline_y=own.baseline_y * wider,
        )

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Positions of the fibres from the curvature of the phase maps, at the nominal distance.

        Free beside it are the plane and the fringe modes that the fit leaves open. One foot for all
        sets is preferred where it explains their curvature as well as positions of their own. The
        share, and the distance, would need the third order, which a small window does not show; the
        foot is counted from the middle of the window that was read.
        """
        sets = [f for f in evidence.fringes.values() if _enough(f)]
        if not sets:
            return None
        common, fit = _positions(evidence, sets, 2)
        own = [_positions(evidence, [f], 3) for f in sets]
        by_common = _gain(evidence, sets, [common] * len(sets))
        by_own = _gain(evidence, sets, [values for values, _ in own])
        details = {f"foot_of_{f.name}_mm": v.tolist() for f, (v, _) in zip(sets, own, strict=True)}
        why = "the phase maps are curved as two fibres make them"
        foot = _foot(common)
        if by_own - by_common < max(_APART, _MODEL * by_own):
            errors = np.sqrt(np.diag(fit.covariance))
            return Estimate(
                cls(foot, evidence.distance_mm),
                {f"foot_mm[{n}]": float(errors[n]) for n in (0, 1)},
                sigmas_of_chi2(by_common, 2), why, details, law="one fibre position for all sets",
            )  # fmt: skip
        pairs, named = [], {}
        for n, (f, (values, own_fit)) in enumerate(zip(sets, own, strict=True)):
            pairs.append(FibrePair(f.name, _foot(values), float(np.clip(values[2], -100, 100))))
            keys = ("foot_mm[0]", "foot_mm[1]", "height_mm")
            for key, error in zip(keys, np.sqrt(np.diag(own_fit.covariance)), strict=True):
                named[f"pairs[{n}].{key}"] = float(error)
        return Estimate(
            cls(foot, evidence.distance_mm, pairs=tuple(pairs)),
            named, sigmas_of_chi2(by_own, 3 * len(sets)), why, details,
            law="a separate fibre position for each set",
        )  # fmt: skip


def bending(x: F64, y: F64, where: Geometry) -> F64:
    """Exact phase less the paraxial one, rad, at pixels x, y."""
    return optics.phase(x, y, where) - optics.paraxial_phase(x, y, where)


def _enough(found: FringeEvidence) -> bool:
    return bool(np.count_nonzero(found.good) > 200) and min(found.good.shape) > 8


def _foot(values: F64) -> tuple[float, float]:
    return float(np.clip(values[0], -1e4, 1e4)), float(np.clip(values[1], -1e4, 1e4))


def _geometry(evidence: Evidence, found: FringeEvidence, position: F64) -> Geometry:
    """With the window's middle as the origin, and the measured fringe vector at the map's.

    The position: foot along x and y, and the difference in height if it is not zero (mm).
    """
    pitch, wavelength = evidence.pitch_um * 1e-3, evidence.wavelength_nm * 1e-6
    per_k = wavelength * evidence.distance_mm / (2 * np.pi * pitch)
    paraxial = Geometry(
        wavelength, pitch, float(position[0]), float(position[1]), evidence.distance_mm,
        float(np.hypot(*found.k)) * per_k, 0.0,
    )  # fmt: skip
    # Far from the foot fringes are wider than in the paraxial limit: the phase is as good as
    # linear in the baseline, whatever the foot.
    size = paraxial.baseline_x
    ways = [paraxial, replace(paraxial, baseline_x=0.0, baseline_y=size)]
    y, x = _middle(found)
    gradients = [
        [optics.phase(x + dx, y + dy, g) - optics.phase(x - dx, y - dy, g) for g in ways]
        for dx, dy in ((0.5, 0.0), (0.0, 0.5))
    ]
    baseline = size * np.linalg.solve(np.array(gradients, float), np.array(found.k))
    height = float(position[2]) if len(position) > 2 else 0.0
    return replace(
        paraxial,
        baseline_x=float(baseline[0]),
        baseline_y=float(baseline[1]),
        baseline_z=height,
    )


def _middle(found: FringeEvidence) -> tuple[float, float]:
    """Middle (y, x) of the map, from the window's."""
    ny, nx = found.good.shape
    return (
        found.origin[0] + (ny - found.window[0]) / 2,
        found.origin[1] + (nx - found.window[1]) / 2,
    )


def _bending(evidence: Evidence, found: FringeEvidence, position: F64) -> F64:
    y, x = centred(found.good.shape)
    y0, x0 = _middle(found)
    bent = bending(x + x0, y + y0, _geometry(evidence, found, position))
    return np.asarray(bent - bent[bent.shape[0] // 2, bent.shape[1] // 2])


def _part(evidence: Evidence, found: FringeEvidence, signals: F64, position: F64 | None) -> MapPart:
    """The phase map of a set about fringes that are bent, or straight ones."""
    free = np.concatenate([polynomial(found.good.shape, 1), gauge_terms(found)])
    data = phase_map(found)
    if position is not None:
        data = data - _bending(evidence, found, position)
    return MapPart.of(signals, data, free, found.good)


def _positions(evidence: Evidence, sets: list[FringeEvidence], size: int) -> tuple[F64, MapFit]:
    """Foot (x, y), and with three numbers the height, in mm, by Gauss and Newton.

    The curvature is nearly linear in them.
    """
    position, step = np.zeros(size), np.diag([1.0, 1.0, 0.01][:size])
    for _ in range(_ITERATIONS):
        parts = []
        for f in sets:
            here = _bending(evidence, f, position)
            signals = np.stack([_bending(evidence, f, position + d) - here for d in step])
            signals /= np.diag(step)[:, None, None]
            parts.append(_part(evidence, f, signals, position))
        fit = fit_maps(parts)
        position = np.clip(position + fit.values, -1e4, 1e4)
    return position, fit


def _gain(evidence: Evidence, sets: list[FringeEvidence], positions: list[F64]) -> float:
    """Chi-square that the curvature of these positions takes from straight fringes."""
    gain = 0.0
    for f, position in zip(sets, positions, strict=True):
        bent = _bending(evidence, f, position)[None]
        fit = fit_maps([_part(evidence, f, bent, None)])
        gain += fit.gain if fit.values[0] > 0 else 0.0
    return gain
