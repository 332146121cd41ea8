"""Maps of light, visibility and phase of each fringe set, to which effects are fitted."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence, cached_on_evidence
from pixcal.estimators.fringe_fit.combine import SAME_AXIS
from pixcal.estimators.maps.map_fit import gauge_terms, phase_map
from pixcal.estimators.maps.structure import stitched_fields, without_outliers
from pixcal.estimators.maps.two_beams import contrast_surface
from pixcal.kernels.beams import Light
from pixcal.kernels.crosstalk import filled
from pixcal.kernels.scene import DetectorMaps
from pixcal.model.arrays import C128, F64, Indices, Mask
from pixcal.simulation.forward import ForwardModel
from pixcal.simulation.recording import Recording
from pixcal.simulation.replica import set_recordings

MIN_PIXELS, MIN_SIDE = 200, 9  # of the good pixels of a set
CLIP = 8.0  # clip of differences of neighbouring pixels, over their median
KINDS = ("the mean light", "the visibility", "the phase")
PHASE = KINDS.index("the phase")


@dataclass(frozen=True)
class FringeSetLight:
    """One fringe set: its maps, and the light that a model may change."""

    recording: Recording
    rows: tuple[int, int]
    first: int  # column
    good: Mask
    # (3, y, x) of `KINDS`: logarithms, and rad; the light is without the noise it has in common
    # with the visibility
    data: F64 = field(repr=False)
    shared: float  # share of the visibility that is subtracted from the light
    gauge: F64 = field(repr=False)  # (4, y, x) fringe modes that are degenerate in the fit
    light: Light = field(repr=False)  # of all columns up to the part's last
    maps: DetectorMaps = field(repr=False)
    stitched: Indices | None = field(default=None, repr=False)  # (y, x) fields of offsets

    @property
    def name(self) -> str:
        """Name of the set."""
        return self.recording.set_name

    @classmethod
    def of(cls, fringes: FringeEvidence, recording: Recording) -> "FringeSetLight":
        """A set, placed in its whole window."""
        (y0, x0), (ny, nx) = fringes.origin, fringes.good.shape
        alpha = np.hypot(fringes.theta[1], fringes.theta[2])
        good = fringes.good & (alpha > 0) & (fringes.theta[0] > 0)
        iota = np.where(good, fringes.theta[0], 1.0)
        visibility = np.where(good, alpha, 1.0) / iota
        data = np.stack([np.log(iota), np.log(visibility), np.nan_to_num(phase_map(fringes))])
        # What two Gaussian beams leave over of both is quadratic: see `two_beams`.
        beams = np.log(contrast_surface(fringes.theta, fringes.good))
        data[0] += beams
        data[1] -= beams
        shared = _shared(data[0], data[1], good)
        data[0] -= shared * data[1]
        plain = filled(np.where(good, fringes.theta, np.nan), fringes.k)
        iota_all, sine, cosine = (np.pad(m, ((0, 0), (x0, 0)), "edge") for m in plain)
        nothing = np.zeros((ny, x0 + nx), np.float32)
        one = np.ones_like(nothing)
        bench, window = recording.bench, (fringes.window[0], x0 + nx)
        detector = replace(bench.detector, shape=window, chip=fringes.window, origin_px=(0, 0))
        return cls(
            replace(recording, bench=replace(bench, detector=detector)),
            (y0, y0 + ny),
            x0,
            good,
            data,
            shared,
            gauge_terms(fringes),
            Light.of_fringes(iota_all, cosine + 1j * sine),
            DetectorMaps(
                nothing, nothing, one, nothing, nothing, nothing, one, nothing.astype(np.uint8)
            ),
        )

    def change(self, model: ForwardModel) -> F64:
        """Change of the maps (3, y, x) by a model."""
        changed, light = model.light(self.light, self.recording, self.rows, self.maps), self.light
        change = np.zeros((3, *light.mean.shape))
        lit = np.where(light.mean > 0, light.mean, np.inf)
        same = changed.beams is light.beams
        mean = light.mean + (changed.incoherent - light.incoherent) if same else changed.mean
        change[0] = np.log(np.maximum(mean / lit, 1e-9))
        change[1] = -change[0]
        if not same:
            ratio = changed.phasor / np.where(light.phasor == 0, 1e-9, light.phasor)
            change[1] += np.log(np.maximum(np.abs(ratio), 1e-9))
            change[2] = _bent(ratio)
        change[0] -= self.shared * change[1]
        return change[:, :, self.first :]


def _shared(light: F64, visibility: F64, good: Mask) -> float:
    """Slope of the noise of light against that of visibility, from neighbouring pixels."""
    used = good[:, 1:] & good[:, :-1]
    steps = [np.diff(own, axis=1)[used] for own in (light, visibility)]
    kept = np.all([abs(own) < CLIP * np.median(abs(own)) for own in steps], axis=0)
    of_light, other = (own[kept] for own in steps)
    return float(of_light @ other) / max(float(other @ other), 1e-300)


def _bent(turn: C128) -> F64:
    """Phase (y, x) less its mean and slopes, rad: free in a fit, and possibly large."""
    for axis in (0, 1):
        one, other = turn.swapaxes(0, axis)[:-1], turn.swapaxes(0, axis)[1:]
        step = np.angle(np.vdot(one, other))
        place = np.expand_dims(np.arange(turn.shape[axis]), 1 - axis)
        turn = turn * np.exp(-1j * step * place)
    return np.asarray(np.angle(turn * np.exp(-1j * np.angle(turn.mean()))))


@cached_on_evidence
def light_maps(evidence: Evidence) -> list[FringeSetLight]:
    """Maps of the fringe sets that are large enough, with their stitched fields."""
    recordings = set_recordings(evidence)
    large = {
        name: fringes
        for name, fringes in evidence.fringes.items()
        if np.count_nonzero(fringes.good) > MIN_PIXELS and min(fringes.good.shape) >= MIN_SIDE
    }
    lit = [FringeSetLight.of(fringes, recordings[name]) for name, fringes in large.items()]
    stitched = _stitched(lit, [fringes.k for fringes in large.values()]) if lit else None
    return [replace(one, stitched=stitched) for one in lit]


def _stitched(
    lit: Sequence[FringeSetLight], vectors: Sequence[tuple[float, float]]
) -> Indices | None:
    """Stitching fields (y, x) of the foundry in the phases of all sets; None without any."""
    # Average sets along one axis: they measure the same offsets, which dominate the noise.
    axes: dict[tuple[float, ...], list[tuple[float, FringeSetLight]]] = {}
    for one, vector in zip(lit, np.array(vectors), strict=True):
        unit = vector / np.linalg.norm(vector)
        axis = next((a for a in axes if abs(float(unit @ a)) > SAME_AXIS), tuple(unit))
        axes.setdefault(axis, []).append((float(vector @ axis), one))
    maps, gauges = [], []
    for sets in axes.values():
        offsets = [np.where(one.good, one.data[PHASE], np.nan) / k for k, one in sets]
        maps.append(without_outliers(np.mean(offsets, axis=0)))
        gauges.append(np.concatenate([one.gauge for _, one in sets]))
    field = stitched_fields(maps, gauges)
    return field if field.any() else None
