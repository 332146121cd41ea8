"""Offset of the whole frame: it varies from frame to frame, drifts, and settles during warm-up."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from pixcal.estimators.detector.noiseless_charge import noiseless_level
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.light import LIGHT_PARTS, fringe_offset_series, light_of
from pixcal.estimators.frame_series.offset import (
    OffsetSeries,
    dark_offset_series,
    dark_offsets,
    fringe_offsets,
    offset_modes,
    unlit_stacks,
)
from pixcal.estimators.frame_series.profiled import Profiled, best_shape
from pixcal.estimators.frame_series.series import TimedValues
from pixcal.estimators.frame_series.variance_components import (
    MAX_STEPS,
    Components,
    estimate_components,
    joint_log_chance,
    log_chance,
    log_chance_of_any,
    sigmas,
)
from pixcal.kernels.processes import HOUR_S, brownian
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.kernels.synthesis import walk_normals
from pixcal.model.arrays import F32, F64
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, FringeMaps, Stage
from pixcal.simulation.recording import KINDS, Recording
from pixcal.simulation.shot import Shot
from pixcal.simulation.track import Track, at

STEADY = 3.0  # least significance of a ramp over a walk, standard deviations
SETTLINGS = 8  # number of trial time constants, from three frames to the length of the run
# largest error of the mean offset of used fringes, over a sample's read noise
WORTH = 0.3
_KEY, _RUN = 1000, 2000  # first keys of the walks' random numbers; no recording has them


@dataclass(frozen=True)
class BiasDrift(Effect):
    """A bias common to all pixels of a frame, which varies; time starts at the first frame."""

    name = "bias_drift"
    title = "bias that varies from frame to frame"
    acts_at = Stage.READOUT
    order = 3
    domains = ("time", "noise")
    strengths = (
        "jitter_rms",
        "ramp_e_h",
        "walk_e_h",
        "settle_e",
        "run_walk_e_h",
        "run_ramp_e_h",
        "tracks",
    )
    absorbed_because = "the free intensity of each frame absorbs a level common to all pixels"
    frames_needed = ("dark",)
    remedy = "in each frame, subtract the level measured on dark or overscan pixels"
    sources = (
        "Rauscher 2015, PASP 127, 1144: pedestal drift of 4 e- rms at 5 e- of read noise",
        "M. Richmond, WIYN HDI technical note 6 (2014): level of the overscan changes by 5 to 20 "
        "ADU in a night, 7 ADU between darks five hours apart",
        "Nordic Optical Telescope, CCD7 pre-commissioning report: 1 ADU in two hours",
    )

    jitter_rms: float = quantity(2.0, unit="e-", low=0, high=1e5)
    """white noise from frame to frame, rms"""
    ramp_e_h: float = quantity(1.5, unit="e-/h", low=-1e6, high=1e6)
    """linear drift"""
    walk_e_h: float = quantity(1.0, unit="e-/h^0.5", low=0, high=1e6)
    """random walk, rms after an hour"""
    settle_e: float = quantity(5.0, unit="e-", low=-1e5, high=1e5)
    """amplitude of an exponential decay from the first frame on"""
    settle_s: float = quantity(600.0, unit="s", above=0, high=1e7)
    """time constant of the decay"""
    run_walk_e_h: float = quantity(0.0, unit="e-/h^0.5", low=0, high=1e6)
    """random walk that restarts with each fringe set"""
    run_ramp_e_h: float = quantity(0.0, unit="e-/h", low=-1e6, high=1e6)
    """linear drift that restarts with each fringe set"""
    tracks: tuple[Track, ...] = quantity((), unit="e-")
    """measured bias of each frame, by fringe set, or of bias or dark frames"""

    def trend(self, time_s: F64) -> F64:
        """Deterministic offset (t,), e-, at times of an acquisition."""
        fade = np.exp(-time_s / self.settle_s)
        return np.asarray(self.ramp_e_h * time_s / HOUR_S + self.settle_e * fade)

    def offset(self, time_s: float, seed: int, rng: np.random.Generator) -> float:
        """Offset of a frame, e-, from the bench's seed and the frame's random numbers."""
        offset = float(self.trend(np.array(time_s))) + self.jitter_rms * rng.standard_normal()
        if self.walk_e_h:
            normal = walk_normals(seed, self.name, _KEY)
            offset += self.walk_e_h * brownian(time_s, normal) / np.sqrt(HOUR_S)
        return offset

    def readout(self, adu: F32, shot: Shot) -> F32:
        recording, rng = shot.recording, shot.rng(self.name)
        lit, time = recording.kind == "fringes", float(recording.times_s[shot.frame])
        name = recording.set_name if lit else f"{recording.kind} frames"
        if any(track.set == name for track in self.tracks):
            # As measured: of fringes without the jitter, which hides in the light.
            jitter = self.jitter_rms * rng.standard_normal() if lit else 0.0
            offset = float(at(self.tracks, name, time)) + jitter
        else:
            offset = self.offset(shot.time_s, shot.bench.seed, rng)
            offset += self._in_run(recording, time) if lit else 0.0
        return adu + np.float32(offset / shot.bench.detector.gain_e_per_adu)

    def _in_run(self, recording: Recording, time_s: float) -> float:
        """Offset of a fringe frame, e-, that restarts with its run."""

        def normal(level: int, place: int) -> float:
            return float(recording.rng(self.name, _RUN + level, place).standard_normal())

        walk = brownian(time_s, normal) / np.sqrt(HOUR_S) if self.run_walk_e_h else 0.0
        return self.run_ramp_e_h * time_s / HOUR_S + self.run_walk_e_h * walk

    def replayed(self, evidence: Evidence) -> Self | None:
        """As in `Effect.replayed`: slow offsets and jitter of fringes; all offsets of darks."""
        light = light_of(evidence)
        lit, jitter = ([], self.jitter_rms) if light is None else fringe_offset_series(light)
        tracks = [_with_level(Track.of(name, time, e), evidence) for name, time, e in lit]
        tracks += [Track.of(name, time, e) for name, time, e in dark_offset_series(evidence)]
        return replace(self, tracks=tuple(tracks), jitter_rms=jitter) if tracks else None

    def undo(self, maps: FringeMaps) -> FringeMaps | None:
        """As in `Effect.undo`: subtract the mean offset of a replayed run, which is not light."""
        others = [f"{kind} frames" for kind in KINDS]
        tracks = [track for track in self.tracks if track.value and track.set not in others]
        if not any(np.mean(track.value) for track in tracks):
            return None
        level = sum(float(np.mean(track.value)) for track in tracks if track.set == maps.name)
        theta = maps.theta.copy()
        theta[0] -= level / (1.0 if maps.flat is None else maps.flat)
        return replace(maps, theta=theta)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Levels of frames without light against time; in fringe frames, changes of B without A."""
        through, in_runs = cls._through(evidence), cls._in_runs(evidence)
        estimates = [e for e in (through, in_runs) if e is not None]
        return max(estimates, key=lambda e: e.significance, default=None)

    @classmethod
    def _in_runs(cls, evidence: Evidence) -> Estimate | None:
        """A separate walk or ramp in each fringe set, from B and A of its frames."""
        light = light_of(evidence)
        if light is None or _is_light(evidence, fringe_offset_series(light)[0]):
            return None
        at = LIGHT_PARTS.index("offset_walk")
        light = replace(light, dark=())
        modes = light.modes(LIGHT_PARTS)
        there, none = estimate_components(modes), estimate_components(modes, absent=(at - 1, at))
        sloped = estimate_components(light.modes(LIGHT_PARTS, ramp=True))
        chance = joint_log_chance(there, none, there.size[-2:])
        # Variation that both explain is attributed to the walk, which is more general.
        rise = _rise(sloped, there)
        law, ramp, errors = "random walk, rms after an hour", 0.0, {}
        if np.sqrt(2 * rise) > STEADY:
            law, there = "ramp", sloped
            ramp = float(there.beta[0]) * HOUR_S
            slope_error = float(np.sqrt(there.shape_covariance((at,))[0, 0]))
            errors = {"run_ramp_e_h": slope_error * HOUR_S}
        walk, error = there.root(at)
        per_hour = float(np.sqrt(HOUR_S))
        return Estimate(
            cls(0.0, 0.0, 0.0, 0.0, run_walk_e_h=min(walk * per_hour, 1e6), run_ramp_e_h=ramp),
            {"run_walk_e_h": error * per_hour} | errors,
            sigmas(log_chance_of_any([chance, log_chance(rise)])),
            "the mean level changes from frame to frame while the fringe amplitude does not",
            law=f"{law} in each fringe set",
        )

    @classmethod
    def _through(cls, evidence: Evidence) -> Estimate | None:
        """Drift through all frames on a common time axis."""
        # Bias frames separate it from a change of the dark current. Variation in few frames that
        # both a walk and a ramp explain is attributed to the walk, as a ramp would grow without
        # limit.
        every = _all_series(evidence)
        if not every:
            return None
        modes = offset_modes(every, [_ramp(s) for s in every])
        full, none = estimate_components(modes), estimate_components(modes, absent=(0, 1))
        drift = joint_log_chance(full, none, full.size[:2])
        level = estimate_components(offset_modes(every, [_ramp(s)[:, :0] for s in every]))
        # The walk is refitted without the ramp: if it is only a walk, the ramp then adds little.
        steady = float(np.sqrt(2 * _rise(full, level)))
        best, settling = _settling(every, full)
        fit = best.components if best else full
        slope, error = float(fit.beta[0]), float(np.sqrt(fit.shape_covariance((1,))[0, 0]))
        changes = [drift, settling, log_chance((slope / error) ** 2 / 2)]
        if not best and steady < STEADY:
            fit, slope = level, 0.0
        (jitter, of_jitter), (walk, of_walk) = fit.root(0), fit.root(1)
        walk, of_walk = walk * HOUR_S**0.5, of_walk * HOUR_S**0.5
        values = {"jitter_rms": jitter, "ramp_e_h": slope, "walk_e_h": walk, "settle_e": 0.0}
        errors = {"jitter_rms": of_jitter, "ramp_e_h": error, "walk_e_h": of_walk}
        if best:
            settle_error = float(np.sqrt(fit.shape_covariance((1,))[1, 1]))
            values |= {"settle_e": float(fit.beta[1]), "settle_s": best.value}
            errors |= {"settle_e": settle_error, "settle_s": best.error}
        return Estimate(
            cls(**values),
            errors,
            sigmas(log_chance_of_any(changes)),
            "levels of " + ", ".join(dict.fromkeys(s.name for s in every)) + " against time, beyond"
            " the noise of pixels, rows and columns",
        )


def _all_series(evidence: Evidence) -> list[OffsetSeries]:
    stacks = unlit_stacks(evidence, "bias", "dark")
    dark = [dark_offsets(s, evidence.good, evidence.gain, evidence.read_noise) for s in stacks]
    every = [s for s in dark if s is not None]
    for fringes in evidence.fringes.values():
        series = fringe_offsets(fringes, evidence.flat)
        if series is None:
            continue
        if np.sqrt(series.noise[0] / len(series)) < WORTH * evidence.read_noise:
            every.append(series)
    return every


def _ramp(series: OffsetSeries) -> F64:
    return np.asarray(series.time_s[:, None] / HOUR_S)


def _rise(full: Components, less: Components) -> float:
    """Rise in log-likelihood from further known shapes."""
    return max(full.profile - less.profile, 0.0)


def _settling(every: Sequence[OffsetSeries], plain: Components) -> tuple[Profiled | None, float]:
    """Decay from the first frame on if significant; its log probability by chance."""
    step = min(s.step_s for s in every)
    length = max(s.time_s[-1] for s in every) - min(s.time_s[0] for s in every)

    def fit(value: float, start: Components | None, steps: int = MAX_STEPS) -> Components:
        shapes = [np.hstack([_ramp(s), np.exp(-s.time_s / value)[:, None]]) for s in every]
        return estimate_components(offset_modes(every, shapes), start=start, steps=steps)

    trials = np.geomspace(3 * step, max(length, 6 * step), SETTLINGS)
    # Between the trial values the gain rises by far less than twofold.
    best = best_shape(fit, trials, True, plain, least=SIGNIFICANT**2 / 4)
    # Neighbouring time constants are correlated: half their number counts as trials.
    chance = log_chance_of_any([log_chance(_rise(best.components, plain))] * (SETTLINGS // 2))
    return best if sigmas(chance) > SIGNIFICANT else None, chance


def _is_light(evidence: Evidence, offsets: Sequence[TimedValues]) -> bool:
    """Whether offsets inferred from B and A are light: larger in pixels of larger response."""
    # The power and the contrast may change together, as where the laser's mode hops.
    along = square = 0.0
    for name, time, offset in offsets:
        fringes = evidence.fringes[name]
        series = fringe_offsets(fringes, evidence.flat)
        if series is None:
            continue
        inferred = np.interp(fringes.time_s, time, offset)
        inferred -= inferred.mean()
        found = series.values[:, 0] - series.values[:, 0].mean()
        variance = max(float(series.noise[0]), float(np.var(found - inferred)))
        along += float(inferred @ found) / variance
        square += float(inferred @ inferred) / variance
    # The offsets by response over those inferred: 1 for a bias, with an error of square ** -0.5.
    return bool(square - along > SIGNIFICANT * np.sqrt(square))


def _with_level(track: Track, evidence: Evidence) -> Track:
    """The track plus the run's mean offset, if its lack of shot noise is significant."""
    level, error = noiseless_level(evidence, evidence.fringes[track.set])
    if abs(level) < SIGNIFICANT * error:
        return track
    return replace(track, value=tuple(v + level for v in track.value))
