"""Simulate the frames of an acquisition sample by sample, with its bench as fitted.

Light, phases, fringe vectors and offsets are fitted, and calibration maps are measured. Without
effects and noise, the frames equal the model of the fit. Their change by an effect is the
derivative that a score test needs.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.kernels.beams import Light
from pixcal.kernels.crosstalk import filled
from pixcal.kernels.scene import DetectorMaps, FrameStates, Rows
from pixcal.model.acquisition import Detector
from pixcal.model.arrays import F32, F64, Indices
from pixcal.model.bench import (
    SCHEMA,
    Bench,
    ExposureStep,
    SimulatedDetector,
    SimulatedFrames,
    SimulatedOptics,
    SimulatedSet,
)
from pixcal.simulation.exposure import Camera
from pixcal.simulation.forward import ForwardModel, Stage
from pixcal.simulation.recording import Recording

MIN_S = 1e-6  # exposure time and period if unknown
TOP_ADU = 65535.0


@dataclass(frozen=True)
class OfAcquisition(ForwardModel):
    """Light and pixels of an acquisition, in place of those of a bench file."""

    acts_at = Stage.LIGHT
    # It acts before all effects, because it would overwrite their changes.
    order = -1
    domains = ()
    strengths = ()
    sources = ()

    maps: DetectorMaps

    @property
    def is_null(self) -> bool:
        """Never."""
        return False


@dataclass(frozen=True)
class Fitted(OfAcquisition):
    """The light and the pixels of an acquisition, as fitted."""

    name = " fitted"
    title = "as fitted"

    theta: tuple[F64, ...]  # maps of each fringe set, e-, for unit response
    k: tuple[tuple[float, float], ...]  # fringe vector of each, rad/px
    frames: tuple[FrameStates, ...]  # of each set, from the first frame of its recording

    def light(self, light: Light, recording: Recording, rows: Rows, maps: DetectorMaps) -> Light:
        """As in `ForwardModel.light`; changes of offsets change the light."""
        if recording.kind != "fringes":
            return light
        iota, of_sine, of_cosine = self.theta[recording.number]
        kx, ky = self.k[recording.number]
        turn = kx * (maps.delta_x - self.maps.delta_x) + ky * (maps.delta_y - self.maps.delta_y)
        return Light.of_fringes(iota, (of_cosine + 1j * of_sine) * np.exp(1j * turn))

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """As in `ForwardModel.states`."""
        return self.frames[recording.number]


class Replica:
    """Simulation of the frames of evidence."""

    def __init__(self, evidence: Evidence) -> None:
        sets = list(evidence.fringes.values())
        self._fitted = _fitted(evidence, sets)
        self._bench = _bench(evidence, sets)
        starts = _starts(evidence, sets)
        self._recordings: dict[str | int, Recording] = dict(set_recordings(evidence).items())
        self._frames: dict[str | int, Indices] = {s.name: s.frame for s in sets}
        for n, stack in enumerate(evidence.stacks):
            exposure = stack.exptime_s if np.isfinite(stack.exptime_s) else 0.0
            electrons = 0.0
            if stack.kind == "flat":
                good = evidence.good & (evidence.flat > 0)
                light = (stack.adu.mean(axis=0) - evidence.bias) * evidence.gain
                light = (light - evidence.dark_rate * exposure)[good] / evidence.flat[good]
                electrons = float(np.median(light)) if light.size else 0.0
            count, period = int(np.ptp(stack.frame)) + 1, _period(stack.time_s)
            self._recordings[n] = Recording(
                self._bench, stack.kind, n, count, exposure, starts[n], period, electrons
            )
            self._frames[n] = stack.frame - stack.frame[0]

    def simulated_samples(
        self,
        of: str | int,
        models: Sequence[ForwardModel] = (),
        *,
        noise: bool = False,
        seed: int = 0,
        most: int | None = None,
    ) -> F32:
        """Samples (t, y, x) before they are rounded, ADU, of a fringe set (name) or stack (number).

        ``models`` act on them and are refused if incompatible with the bench; ``most``: largest
        number of frames.
        """
        detector = replace(self._bench.detector, seed=seed)
        bench = replace(self._bench, seed=seed, detector=detector)
        for model in models:
            model.check(bench)
        recording, frames = self._recordings[of], self._frames[of][:most].tolist()
        rows = (0, bench.detector.shape[0])
        models = [self._fitted, *models]
        camera = Camera(bench, rows, models, maps=self._fitted.maps, noise=noise)
        out = np.empty((len(frames), *bench.detector.shape), np.float32)
        for n, adu in enumerate(camera.analogue(replace(recording, bench=bench), frames)):
            out[n] = adu
        return out


def set_recordings(evidence: Evidence) -> dict[str, Recording]:
    """The recording of each fringe set, up to its last available frame."""
    sets = list(evidence.fringes.values())
    bench, starts = _bench(evidence, sets), _starts(evidence, sets)
    return {s.name: _of_set(bench, n, s, starts[s.name]) for n, s in enumerate(sets)}


def _fitted(evidence: Evidence, sets: Sequence[FringeEvidence]) -> Fitted:
    flat, shape = evidence.flat, evidence.good.shape
    delta = np.zeros((2, *shape))
    if sets:
        directions = np.stack([np.array(s.k) / np.hypot(*s.k) for s in sets])
        along = np.stack([np.where(np.isfinite(s.delta), s.delta, 0.0) for s in sets])
        delta = np.tensordot(np.linalg.pinv(directions), along, 1)

    response, rate = np.nan_to_num(flat, nan=1.0), np.nan_to_num(evidence.dark_rate)
    each = (*delta, response, np.nan_to_num(evidence.bias), np.maximum(rate, 0))
    dx, dy, relative, bias, dark = (values.astype(np.float32) for values in each)
    maps = DetectorMaps(
        dx,
        dy,
        relative,
        bias,
        dark,
        np.full(shape, evidence.amplifier_noise, np.float32),
        np.full(shape, 1 / evidence.gain, np.float32),
        np.where(evidence.good, 0, 1).astype(np.uint8),
    )
    theta = tuple(filled(np.where(s.good, s.theta, np.nan), s.k) for s in sets)
    return Fitted(maps, theta, tuple(s.k for s in sets), tuple(_states(s) for s in sets))


def _states(fringes: FringeEvidence) -> FrameStates:
    """States of all frames of the recording; arbitrary for frames left out."""

    def every(values: F64, other: float) -> F64:
        states = np.full(fringes.frame[-1] + 1, other)
        states[fringes.frame] = values
        return states

    b, a = fringes.g[:, 0], np.hypot(fringes.g[:, 1], fringes.g[:, 2])
    return FrameStates(
        phi=every(fringes.phi, 0.0),
        level=every(b, float(b.mean())),
        amplitude=every(a, float(a.mean())),
        dkx=every(fringes.dk[:, 0], 0.0),
        dky=every(fringes.dk[:, 1], 0.0),
    )


def _period(time_s: F64) -> float:
    return max(float(np.median(np.diff(time_s))), MIN_S) if len(time_s) > 1 else MIN_S


def _starts(evidence: Evidence, sets: Sequence[FringeEvidence]) -> dict[str | int, float]:
    """Start of each recording after that of the acquisition, s; unknown ones come first."""
    spans: dict[str | int, tuple[float, float]] = {
        n: (s.start_s + float(s.time_s[0]), len(s.adu) * _period(s.time_s))
        for n, s in enumerate(evidence.stacks)
    }
    spans |= {s.name: (s.start_s, float(s.time_s[-1]) + _period(s.time_s)) for s in sets}
    before = sum(span for start, span in spans.values() if not np.isfinite(start))
    starts, clock = {}, 0.0
    for name, (start, span) in spans.items():
        starts[name] = start + before if np.isfinite(start) else clock
        clock += span * (not np.isfinite(start))
    return starts


def _of_set(bench: Bench, number: int, fringes: FringeEvidence, start_s: float) -> Recording:
    exposure = fringes.exptime_s if np.isfinite(fringes.exptime_s) else 0.0
    count, period = int(fringes.frame[-1]) + 1, _period(fringes.time_s)
    return Recording(bench, "fringes", number, count, exposure, start_s, period)


def _bench(evidence: Evidence, sets: Sequence[FringeEvidence]) -> Bench:
    """Bench properties that effects use; `Fitted` replaces the pixels and light."""
    exposures = [s.exptime_s for s in sets if np.isfinite(s.exptime_s)]
    contrast = [np.median(np.hypot(*s.theta[1:])[s.good] / s.theta[0][s.good]) for s in sets]
    return plain_bench(
        evidence,
        sets[0].window if sets else None,
        min(evidence.saturation_adu, TOP_ADU),
        float(np.mean(contrast)) if contrast else 1.0,
        (max([*exposures[:1], MIN_S]), _period(sets[0].time_s) if sets else 0.0),
        [(s.name, s.baseline_mm, len(s.g), 2 * float(np.median(s.theta[0][s.good]))) for s in sets],
    )


def plain_bench(
    evidence: Evidence,
    chip: tuple[int, int] | None,
    saturation_adu: float,
    visibility: float,
    times_s: tuple[float, float],
    sets: Sequence[tuple[str, tuple[float, float], int, float]],
    declared: Detector | None = None,
) -> Bench:
    """Bench properties that effects use, for pixels and light from an acquisition.

    ``chip``: rows and columns of the whole window, if the place of the evidence in it is known.
    ``times_s``: exposure time and period. ``sets``: name, baseline (mm), frames and brightest
    fringe (e-) of each fringe set. The bias is that of the evidence.
    """
    exposure, period = times_s
    detector = SimulatedDetector(
        shape=evidence.good.shape,
        pitch_um=evidence.pitch_um,
        gain_e_per_adu=evidence.gain,
        read_noise_e=evidence.amplifier_noise,
        step_adu=evidence.step_adu,
        name=declared.name if declared else "",
        chip=chip,
        origin_px=evidence.origin if chip else None,
        saturation_adu=saturation_adu,
        lowest_adu=int(evidence.lowest_adu or 0),
        bias_adu=0.0,
        full_well_e=declared.full_well_e if declared else None,
    )
    bias = float(np.clip(np.median(evidence.bias), 0, detector.top_adu - 1))
    return Bench(
        schema=SCHEMA,
        detector=replace(detector, bias_adu=bias),
        optics=SimulatedOptics(
            wavelength_nm=evidence.wavelength_nm,
            distance_mm=evidence.distance_mm,
            beam_radius_mm=1e4,
            visibility=float(np.clip(visibility, 0.01, 1.0)),
        ),
        frames=SimulatedFrames(
            exptime_s=exposure,
            period_s=max(period, exposure),
            flats=(ExposureStep(exposure, 1),),
            flat_rate_e_s=1.0,
            fringes=tuple(
                SimulatedSet(name, baseline, count, float(np.clip(peak, 1.0, 1e7)))
                for name, baseline, count, peak in sets
            ),
        ),
    )
