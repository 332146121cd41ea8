"""A bench that warms and creeps: a fringe vector that changes in the course of a run."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.frame_series.fringe_motion import (
    Motion,
    motion_of,
    ramps,
    ramps_and_colour,
    slow_vectors,
)
from pixcal.estimators.frame_series.series import FrameSeries
from pixcal.estimators.frame_series.variance_components import (
    MAX_STEPS,
    Components,
    joint_log_chance,
    log_chance,
    log_chance_of_any,
    sigmas,
)
from pixcal.kernels.scene import FrameStates
from pixcal.kernels.significance import SIGNIFICANT
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording
from pixcal.simulation.track import Track, at

F64 = NDArray[np.float64]

HOUR_S = 3600.0
SETTLINGS = 10
"""Time constants tried at first, from `QUICKEST` frames to the length of the run."""
QUICKEST = 3.0
PARTS = ("jitter_x", "jitter_y", "walk_x", "walk_y")


TRACKS = ("along_x", "along_y")


@dataclass(frozen=True)
class FringeDrift(Effect):
    """Slow change of the fringe vector: a ramp, a settling, a random walk.

    The time of each fringe set runs from its first frame: fibres are moved between sets, and the
    mean vector of a set is fitted anyway. A slow change of the phase has no parameter: every frame
    has a free phase, which takes it up. Nothing here is constant in time, so maps alone do not
    tell of it; the fit leaves the vector free in each frame where it moves, and `vector_change`
    gives it where a fit holds it.
    """

    name = "fringe_drift"
    title = "fringe vector changing slowly"
    acts_at = Stage.LIGHT
    domains = ("time", "space")
    strengths = ("ramp", "settle", "walk", *TRACKS)
    absorbed_because = "the fit has a free fringe vector in each frame where it moves"
    frames_needed = ()
    sources = (
        "Rousset et al., sections 4.2, 4.3 and 5.2: thermal deformations move Kx, Ky; one of two "
        "data sets drifts after 30 minutes",
        "thermal expansion of aluminium 23e-6/K (CRC Handbook of Chemistry and Physics): two posts "
        "of 100 mm that differ by 0.1 K move the fibres against each other by 0.23 um, 2.5e-5 "
        "rad/px",
    )

    ramp: tuple[float, float] = quantity(
        (2.5e-5, 2.5e-5), unit="rad/px/h", low=-10, high=10, doc="of the vector along x and y"
    )
    settle: tuple[float, float] = quantity(
        (2.5e-5, 2.5e-5), unit="rad/px", low=-1, high=1, doc="what decays from the first frame on"
    )
    settle_s: float = quantity(600.0, unit="s", above=0, high=1e6, doc="time constant of the decay")
    walk: tuple[float, float] = quantity(
        (1e-5, 1e-5), unit="rad/px/h^0.5", low=0, high=10, doc="random walk along x and y"
    )
    along_x: tuple[Track, ...] = quantity((), unit="rad/px", doc="slow change of kx as measured")
    along_y: tuple[Track, ...] = quantity((), unit="rad/px", doc="slow change of ky as measured")

    def scaled(self, factor: float) -> Self:
        """As in `Effect.scaled`."""
        tracks = {
            name: tuple(track.scaled(factor) for track in getattr(self, name)) for name in TRACKS
        }
        plain = {
            name: tuple(factor * v for v in getattr(self, name))
            for name in self.strengths
            if name not in TRACKS
        }
        return replace(self, **cast("Any", plain | tracks))

    @property
    def is_null(self) -> bool:
        """As in `Effect.is_null`."""
        plain = any(any(getattr(self, n)) for n in self.strengths if n not in TRACKS)
        return not plain and not any(v for n in TRACKS for t in getattr(self, n) for v in t.value)

    def vector_change(self, time_s: F64) -> F64:
        """Change of the fringe vector (t, 2), rad/px, that is not random; from its first frame.

        Parameters
        ----------
        time_s : (t,) float64
            From the first frame of the set.
        """
        fade = np.exp(-time_s / self.settle_s) - 1
        return np.asarray(np.outer(time_s / HOUR_S, self.ramp) + np.outer(fade, self.settle))

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """As in `Effect.states`."""
        time = np.arange(recording.count, dtype=float) * recording.period_s
        steps = recording.rng(self.name).standard_normal((recording.count, 2))
        walk = np.cumsum(steps, axis=0) * np.sqrt(recording.period_s / HOUR_S)
        change = self.vector_change(time) + walk * self.walk
        name = recording.bench.frames.fringes[recording.number].name
        change += np.stack([at(self.along_x, name, time), at(self.along_y, name, time)], axis=1)
        return replace(states, dkx=states.dkx + change[:, 0], dky=states.dky + change[:, 1])

    def replayed(self, evidence: Evidence) -> Self | None:
        """As in `Effect.replayed`: the slow part of each frame's own fringe vector."""
        courses = slow_vectors(evidence)
        x, y = (
            tuple(Track.of(name, time, vector[:, axis]) for name, time, vector in courses)
            for axis in (0, 1)
        )
        return replace(self.scaled(0.0), along_x=x, along_y=y)

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Ramp, settling and walk of the frames' own vectors.

        Where sets have fringes of different directions, a change of wavelength is told apart and
        does not count here; with one direction it cannot be.
        """
        motion = motion_of(evidence)
        if motion is None:
            return None
        parts = [*PARTS, "walk_k"] if motion.crossed else list(PARTS)
        slow = motion.components(parts)
        steady = motion.components(parts, absent=PARTS[2:])
        walks = joint_log_chance(slow, steady, slow.size[2:4])
        values, errors, ramped = _slow_parameters(motion, parts)
        return Estimate(
            replace(cls().scaled(0.0), **values),
            errors,
            sigmas(log_chance_of_any([walks, ramped])),
            "slow change of the fringe vector beyond its white noise"
            + (
                "" if motion.crossed else "; along the fringe axis, wavelength drift looks the same"
            ),
            {
                "walk_sigmas": sigmas(walks),
                "ramp_sigmas": sigmas(ramped),
            },
        )


def _slow_parameters(
    motion: Motion, parts: Sequence[str]
) -> tuple[dict[str, Any], dict[str, float], float]:
    """Ramp, walk and, where it is sure, settling: values and errors by field.

    And the logarithm of the chance of such a ramp where there is none.
    """
    plain = motion.components(parts, partial(_shapes, motion.crossed, None))
    ramp = plain.beta[:2]
    ramped = log_chance(float(ramp @ np.linalg.pinv(plain.beta_covariance[:2, :2]) @ ramp) / 2)
    tau, found = _settling(motion, parts, plain)
    error = np.sqrt(np.diag(found.shape_covariance(range(2, len(parts)))))
    walk, walk_error = np.array([found.root(2), found.root(3)]).T
    values: dict[str, Any] = {
        "ramp": _pair(found.beta[:2] * HOUR_S),
        "walk": _pair(walk * np.sqrt(HOUR_S)),
    }
    spread = {"ramp": error[:2] * HOUR_S, "walk": walk_error * np.sqrt(HOUR_S)}
    errors: dict[str, float] = {}
    if tau is not None:
        at = 3 if motion.crossed else 2
        values |= {"settle": _pair(found.beta[at : at + 2]), "settle_s": tau}
        spread |= {"settle": error[at : at + 2]}
        errors["settle_s"] = float(error[at + 2])
    for name, pair in spread.items():
        errors |= {f"{name}[{i}]": float(pair[i]) for i in range(2)}
    return values, errors, ramped


def _settling(
    motion: Motion, parts: Sequence[str], plain: Components
) -> tuple[float | None, Components]:
    """Time constant of a settling and the fit with it; without one, None and the plain fit."""
    length = max(float(np.ptp(s.time_s)) for s in motion.series)
    step = min(s.step_s for s in motion.series)

    def fitted(tau: float, steps: int) -> Components:
        known = partial(_shapes, motion.crossed, (tau, None))
        return motion.components(parts, known, start=plain, steps=steps)

    trials = np.geomspace(QUICKEST * step, length, SETTLINGS)
    tau = float(max(trials, key=lambda t: fitted(t, 0).profile))
    if sigmas(log_chance(fitted(tau, MAX_STEPS).profile - plain.profile, 2)) < SIGNIFICANT - 1:
        return None, plain
    reach = trials[1] / trials[0]
    found = minimize_scalar(
        lambda t: -fitted(np.exp(t), MAX_STEPS).profile,
        bounds=(np.log(tau / reach), np.log(tau * reach)),
        method="bounded",
        options={"xatol": 0.01},
    )
    tau = float(np.exp(found.x))
    best = fitted(tau, MAX_STEPS)
    if sigmas(log_chance(best.profile - plain.profile, 2)) < SIGNIFICANT:
        return None, plain
    at = 3 if motion.crossed else 2
    size = (float(best.beta[at]), float(best.beta[at + 1]))
    # Once more with the slope along the time constant: its error, and its share in the others'.
    known = partial(_shapes, motion.crossed, (tau, size))
    return tau, motion.components(parts, known, start=best)


def _shapes(
    crossed: bool, settling: tuple[float, tuple[float, float] | None] | None, series: FrameSeries
) -> F64:
    """Known shapes of a series: ramps, change of colour, decay along x and y, its slope in tau."""
    shapes = [ramps_and_colour(series) if crossed else ramps(series)]
    if settling is not None:
        tau, size = settling
        fade = np.exp(-series.time_s / tau)
        shapes.append(fade[:, None, None] * np.eye(2))
        if size is not None:
            slope = fade * series.time_s / tau**2
            shapes.append(slope[:, None, None] * np.array(size)[:, None])
    return np.concatenate(shapes, axis=2)


def _pair(values: F64) -> tuple[float, float]:
    return float(values[0]), float(values[1])
