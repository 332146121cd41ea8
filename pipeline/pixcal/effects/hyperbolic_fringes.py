"""Fringes that are hyperbolas, not the straight lines of the paraxial limit."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.map_fit import (
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
from pixcal.model.bench import Bench
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording

F64 = NDArray[np.float64]

_TURNS = 4


@dataclass(frozen=True)
class HyperbolicFringes(Effect):
    """Exact phase of two fibre tips less its paraxial limit, added to the straight fringes.

    To leading order the bending is ``-K·q q² / (2 D²)``, q from the foot of the fibres' centre:
    in proportion to the fringe vector, so in pixels it does not depend on the baseline, and sets
    of other interfringe do not tell it from true offsets. Its shape does: two numbers rule the
    curvature of all sets.

    The maps of a fit do not say where on the chip they lie, so `predict` cannot tell;
    `straightened` undoes it where the geometry is given, and ``fit --model hyperbolic`` fits it.
    """

    name = "hyperbolic_fringes"
    title = "hyperbolic fringes"
    stage = Stage.LIGHT
    domains = ("space",)
    strengths = ("share",)
    told_by = ("axis",)
    sources = (
        "Rousset et al., section 5.2 and figures 5, 14 and 15: fibres at 40 cm, (18 mm, 18 mm) "
        "from the middle of the window (design/paper.txt)",
        "Born & Wolf, Principles of Optics, section 7.3: fringes of two point sources",
    )

    foot_mm: tuple[float, float] = quantity(
        (18.0, 18.0),
        unit="mm",
        low=-1e4,
        high=1e4,
        doc="foot of the fibres' centre from the chip's",
    )
    distance_mm: float | None = quantity(
        None, unit="mm", above=0, high=1e7, doc="fibres to detector; default: that of the bench"
    )
    share: float = quantity(1.0, low=-100, high=100, doc="of the bending: 1 exact, 0 straight")

    def check(self, bench: Bench) -> None:
        """As in `Effect.check`."""
        if bench.optics.fringes != "straight" and not self.is_null:
            raise InputError(
                "effects.hyperbolic_fringes: the bench's fringes are exact already; set "
                "optics.fringes to straight"
            )

    def light(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        """As in `Effect.light`."""
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
        centre = bench.detector.chip_centre_px
        distance = self.distance_mm or own.distance
        wider = distance / own.distance
        return replace(
            own,
            centre_x=centre[0] * pitch + self.foot_mm[0],
            centre_y=centre[1] * pitch + self.foot_mm[1],
            distance=distance,
            baseline_x=own.baseline_x * wider,
            baseline_y=own.baseline_y * wider,
        )

    def straightened(self, theta: F64, where: Geometry) -> F64:
        """Maps (3, y, x) of a fit without the bending, from pixel (0, 0) of the geometry."""
        y, x = np.mgrid[: theta.shape[1], : theta.shape[2]].astype(float)
        z = (theta[2] + 1j * theta[1]) * np.exp(-1j * self.share * bending(x, y, where))
        return np.stack([theta[0], z.imag, z.real])

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Foot of the fibres from the curvature of the phase maps, the distance being the nominal.

        Free beside it are the plane and the fringe modes that the fit leaves open. A curvature that
        two numbers do not explain in all sets widens the errors. The share, and the distance, would
        need the third order, which a small window does not show; the foot is counted from the
        middle of the window that was read.
        """
        sets = [f for f in evidence.fringes.values() if _enough(f)]
        if not sets:
            return None
        foot, fit = _foot(evidence, sets)
        bent = [_bending(evidence, f, foot)[None] for f in sets]
        share = fit_maps([_part(evidence, f, b, None) for f, b in zip(sets, bent, strict=True)])
        scale = max(1.0, _unexplained(evidence, sets, foot))
        errors = np.sqrt(np.diag(fit.covariance) * scale)
        details: dict[str, object] = {
            "unexplained_chi2_per_term": scale,
            "share_at_foot": float(share.values[0]),
        }
        for f in sets:
            own, own_fit = _foot(evidence, [f])
            details[f"foot_of_{f.name}_mm"] = [float(v) for v in own]
            details[f"foot_of_{f.name}_errors_mm"] = np.sqrt(np.diag(own_fit.covariance)).tolist()
        x, y = (float(np.clip(v, -1e4, 1e4)) for v in foot)
        return Estimate(
            cls((x, y), evidence.distance_mm),
            {"foot_mm[0]": float(errors[0]), "foot_mm[1]": float(errors[1])},
            # The foot has taken the share to one, if anything is bent this way at all.
            sigmas_of_chi2(share.gain / scale, 2) if share.values[0] > 0 else 0.0,
            "curvature of the phase maps, of the shape that two fibres make",
            details,
        )


def bending(x: F64, y: F64, where: Geometry) -> F64:
    """Exact phase less the paraxial one, rad, at pixels x, y."""
    return optics.phase(x, y, where) - optics.paraxial_phase(x, y, where)


def _enough(found: FringeEvidence) -> bool:
    return bool(np.count_nonzero(found.good) > 200) and min(found.good.shape) > 8


def _geometry(evidence: Evidence, found: FringeEvidence, foot: F64) -> Geometry:
    """With the window's middle as the origin, and the measured fringe vector at the map's."""
    pitch, wavelength = evidence.pitch_um * 1e-3, evidence.wavelength_nm * 1e-6
    per_k = wavelength * evidence.distance_mm / (2 * np.pi * pitch)
    paraxial = Geometry(
        wavelength, pitch, float(foot[0]), float(foot[1]), evidence.distance_mm,
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
    return replace(paraxial, baseline_x=float(baseline[0]), baseline_y=float(baseline[1]))


def _middle(found: FringeEvidence) -> tuple[float, float]:
    """Middle (y, x) of the map, from the window's."""
    ny, nx = found.good.shape
    return (
        found.origin[0] + (ny - found.window[0]) / 2,
        found.origin[1] + (nx - found.window[1]) / 2,
    )


def _bending(evidence: Evidence, found: FringeEvidence, foot: F64) -> F64:
    y, x = centred(found.good.shape)
    y0, x0 = _middle(found)
    return bending(x + x0, y + y0, _geometry(evidence, found, foot))


def _part(evidence: Evidence, found: FringeEvidence, signals: F64, foot: F64 | None) -> MapPart:
    """The phase map of a set about fringes bent by a foot, or straight ones."""
    free = np.concatenate([polynomial(found.good.shape, 1), gauge_terms(found)])
    data = phase_map(found)
    if foot is not None:
        data = data - _bending(evidence, found, foot)
    return MapPart.of(signals, data, free, found.good)


def _foot(evidence: Evidence, sets: list[FringeEvidence]) -> tuple[F64, MapFit]:
    """Foot (x, y) in mm, by Gauss and Newton: the bending is nearly linear in it."""
    foot, step = np.zeros(2), np.eye(2)
    for _ in range(_TURNS):
        parts = []
        for f in sets:
            here = _bending(evidence, f, foot)
            signals = np.stack([_bending(evidence, f, foot + d) - here for d in step])
            parts.append(_part(evidence, f, signals, foot))
        fit = fit_maps(parts)
        foot = np.clip(foot + fit.values, -1e4, 1e4)
    return foot, fit


def _unexplained(evidence: Evidence, sets: list[FringeEvidence], foot: F64) -> float:
    """Chi-square a term of the curvature (second order) that the foot leaves."""
    total, terms = 0.0, -2
    for f in sets:
        signals = polynomial(f.good.shape, 2)[3:]
        total += fit_maps([_part(evidence, f, signals, foot)]).gain
        terms += len(signals)
    return total / terms
