"""Laser wavelength that drifts or hops between modes."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.fringe_motion import Hop, Motion, colour_of, motion_of
from pixcal.estimators.frame_series.hopping import Hopping, find_hopping, scatter_of
from pixcal.kernels import optics
from pixcal.kernels.processes import HOUR_S
from pixcal.kernels.scene import FrameStates, geometry
from pixcal.kernels.significance import SIGNIFICANT, root_with_error
from pixcal.model.arrays import F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.frame_fit import fit_frames
from pixcal.simulation.recording import Recording

SETS_DIFFER = "fringe sets disagree: a wavelength changes all fringe vectors by the same share"
# largest scatter about two levels, over that from frame to frame, for which two levels suffice
LEVEL = 1.5
CALM = 2.0  # significance of a walk up to which the levels are constant


@dataclass(frozen=True)
class WavelengthDrift(Effect):
    """The wavelength changes by a ramp, a random walk, or hops to another laser mode and back."""

    name = "wavelength_drift"
    title = "wavelength that drifts or hops between laser modes"
    acts_at = Stage.LIGHT
    order = 1
    domains = ("time",)
    strengths = ("ramp", "walk", "hop")
    absorbed_because = "the fit has a free phase and fringe vector in each frame"
    frames_needed = ("baseline", "axis")
    sources = (
        "CIPM 2007, Recommendation 2, and Stone et al. 2009, Metrologia 46, 11: an unstabilised "
        "He-Ne laser at 633 nm keeps its wavelength to 1.5e-6",
        "neighbouring modes of a 30 cm tube are c / (2 x 0.3 m) = 500 MHz apart, 1.1e-6",
        "Wieman & Hollberg 1991, Rev. Sci. Instrum. 62, 1: free diode lasers follow temperature by "
        "some 0.25 nm/K, in hops: 1e-4 and more",
        "air that is 1 K warmer has an index lower by 1e-6 (Edlen's equation)",
    )

    ramp: float = quantity(1e-6, unit="1/h", low=-1, high=1)
    """relative change per hour"""
    walk: float = quantity(5e-7, unit="h^-0.5", low=0, high=1)
    """relative random walk, rms after an hour"""
    hop: float = quantity(1.1e-6, low=-0.1, high=0.1)
    """relative difference between the two modes"""
    hops_per_h: float = quantity(12.0, unit="1/h", low=0, high=1e6)
    """rate of mode hops in either direction, at random times"""

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        bench, count = recording.bench, recording.count
        hours = recording.period_s / HOUR_S
        steps = recording.rng(self.name).standard_normal(count)
        hops = recording.rng(self.name, 1).poisson(self.hops_per_h * hours, count)
        change = (
            self.ramp * recording.times_s / HOUR_S + self.walk * np.sqrt(hours) * steps.cumsum()
        )
        change = change + self.hop * (np.cumsum(hops) % 2)
        # Relative change of the inverse wavelength.
        shrunk = -change / (1 + change)
        ny, nx = bench.detector.shape
        where, place = geometry(bench, recording.number), ((nx - 1) / 2, (ny - 1) / 2)
        kx, ky = optics.paraxial_vector(where)
        phase = optics.paraxial_phase(*place, where)
        return replace(
            states,
            phi=states.phi + shrunk * phase,
            dkx=states.dkx + shrunk * kx,
            dky=states.dky + shrunk * ky,
        )

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Ramp and walk as by `Effect`, and the significant mode hops."""
        motion, slow = motion_of(evidence), fit_frames(cls, evidence, leave=("hop",))
        if motion is None or slow is None:
            return None
        jumps = [hop for hops in motion.hops.values() for hop in hops]
        effect, errors = slow.model, dict(slow.errors)
        if jumps:
            walks = effect.walk > CALM * errors.get("walk", np.inf)
            values, hop_errors = _hops(motion, jumps, walks=walks)
            effect, errors = replace(effect, **values), errors | hop_errors
        significance = max(slow.significance, _sharpest(motion))
        refused = SETS_DIFFER if slow.sets_differ > SIGNIFICANT else ""
        size = {} if jumps else _size([colour_of(s) for s in motion.raw])
        return Estimate(effect, errors, significance, slow.why, refused=refused, size=size)


def _size(changes: Sequence[F64]) -> dict[str, Any]:
    """Rms of the slow changes within sets, whatever their law."""
    count = np.array([len(c) for c in changes])
    # From frame to frame there is only noise; less its variance, that of white noise is zero.
    noise = np.array([np.mean(np.diff(c) ** 2) / 2 for c in changes])
    slow = np.array([c.var(ddof=1) for c in changes]) - noise
    errors = count * noise * (noise + 4 * np.maximum(slow, 0.0))
    error = float(np.sqrt(errors.sum())) / count.sum()
    rms, rms_error = map(float, root_with_error(count @ slow / count.sum(), error))
    of = "rms change of the wavelength during a set"
    return {"value": rms, "error": rms_error, "unit": "", "of": of}


def _sharpest(motion: Motion) -> float:
    """Significance (standard deviations) of the clearest hop."""
    return float(max((h.sigmas for hops in motion.hops.values() for h in hops), default=-np.inf))


def _hops(
    motion: Motion, jumps: Sequence[Hop], *, walks: bool
) -> tuple[dict[str, float], dict[str, float]]:
    """Size and rate of the hops, both upwards and downwards."""
    # Significant hops are the start; the likelihood accounts for short dwell times (with a walk, it
    # fits the rate only), unless the wavelength does more than hop between two levels.
    size, error = np.array([abs(h.size) for h in jumps]), np.array([h.error for h in jumps])
    weight = 1 / error**2
    seconds = sum(len(s) * s.step_s for s in motion.raw)
    hop, rate = float(size @ weight / weight.sum()), len(jumps) / seconds
    # Hops may scatter by more than the noise.
    excess = float(weight @ (size - hop) ** 2) / max(len(jumps) - 1, 1)
    own_error = float(np.sqrt(max(excess, 1.0) / weight.sum()))
    # The posterior of a rate, without prior: few jumps constrain it poorly.
    hopping = Hopping(hop, own_error, rate, float(np.sqrt(len(jumps) + 1)) / seconds)
    colours, bases = [colour_of(s) for s in motion.raw], [colour_of(s) for s in motion.series]
    times = [s.time_s for s in motion.raw]
    slopes = [float(np.polyfit(t - t[0], b, 1)[0]) for t, b in zip(times, bases, strict=True)]
    levels = find_hopping(colours, times, slopes, hop, rate)
    alike = 0.5 < levels.size / hop < 2
    if alike and all(n < LEVEL * scatter_of(c) for n, c in zip(levels.noise, colours, strict=True)):
        hopping = levels
    if walks:
        hopping = replace(hopping, size=hop, error=own_error, ramp_error=np.inf)
    values = {"hop": hopping.size, "hops_per_h": hopping.rate * HOUR_S}
    errors = {"hop": hopping.error, "hops_per_h": hopping.rate_error * HOUR_S}
    if np.isfinite(hopping.ramp_error):
        values["ramp"], errors["ramp"] = hopping.ramp * HOUR_S, float(hopping.ramp_error * HOUR_S)
    return values, errors
