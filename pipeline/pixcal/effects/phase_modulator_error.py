"""A phase modulator that does not go where it is told: bunched phases, uneven steps."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import jv

from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.variance_components import (
    Modes,
    cosine_modes,
    estimate_components,
    log_chance,
    sigmas,
    walk_power,
)
from pixcal.kernels.processes import ramp_step
from pixcal.kernels.scene import FrameStates
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.recording import Recording

F64 = NDArray[np.float64]
C128 = NDArray[np.complex128]

FEWEST = 24
MOST = 0.9
"""Of first + 2 second: at 1 the phase would stand still somewhere in the turn."""


@dataclass(frozen=True)
class PhaseModulatorError(Effect):
    """The phase of a frame as the modulator makes it: phi + first sin phi + second sin 2 phi.

    phi is the phase that was asked for. The error is periodic: a modulator is driven over one turn
    and flies back. A span that misses a turn by the share e makes first = 2 e, second = e. Every
    frame has a free phase, so nothing moves in the maps; but phases that bunch tell less of the
    pixels' phase than even ones. The cure is to command ``commanded`` instead.
    """

    name = "phase_modulator_error"
    title = "phase modulator off its command, periodically"
    stage = Stage.LIGHT
    domains = ("time",)
    strengths = ("first_rad", "second_rad")
    told_by = ("ramp",)
    sources = (
        "Cheng & Wyant 1985, Appl. Opt. 24, 3049: nonlinearity of a calibrated piezo below 1 %",
        "Ai & Wyant 1987, Appl. Opt. 26, 1112: quadratic nonlinearity of piezos in phase-shifting "
        "interferometry, the span of a turn missed by some percent",
    )

    first_rad: float = quantity(
        0.04, unit="rad", low=0, high=MOST, doc="amplitude of the error with one period a turn"
    )
    second_rad: float = quantity(
        0.02, unit="rad", low=0, high=MOST / 2, doc="amplitude with two periods a turn"
    )

    def __post_init__(self) -> None:
        if self.first_rad + 2 * self.second_rad > MOST:
            raise InputError(
                f"first_rad: {self.first_rad:g} and twice second_rad ({self.second_rad:g}) make "
                f"more than {MOST:g}: the phase would hardly move in places; lower one of them"
            )

    def actual(self, phase: F64) -> F64:
        """Phase that comes of a commanded one, rad."""
        error = self.first_rad * np.sin(phase) + self.second_rad * np.sin(2 * phase)
        return np.asarray(phase + error)

    def commanded(self, phase: F64) -> F64:
        """Command that a phase comes of, rad; the inverse of `actual`."""
        command = np.array(phase, float)
        for _ in range(60):
            error = self.actual(command) - phase
            slope = 1 + self.first_rad * np.cos(command) + 2 * self.second_rad * np.cos(2 * command)
            command -= np.clip(error / slope, -0.5, 0.5)
        return command

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """As in `Effect.states`."""
        return replace(states, phi=self.actual(states.phi))

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """From ramps, what recurs with every turn; else how unevenly random phases lie.

        A ramp tells hundreds of times better. The gauge of the maps shifts the phases of the frames
        in the same way: its error is in the result.
        """
        sets = {name: f for name, f in evidence.fringes.items() if len(_phase(f)) >= FEWEST}
        ramps = [
            _of_ramp(_phase(f), _gauge_error(f)) for f in sets.values() if ramp_step(_phase(f))
        ]
        random = [_of_random(_phase(f)) for f in sets.values() if not ramp_step(_phase(f))]
        found = ramps or random
        if not found:
            return None
        square = np.mean([np.abs(h.size) ** 2 - 2 * h.error**2 for h in found], axis=0)
        error = np.sqrt(1 / np.sum([1 / h.error**2 for h in found], axis=0))
        first, second = np.sqrt(np.maximum(square, 0.0))
        shrink = min(1.0, MOST / max(first + 2 * second, 1e-9))
        growth = sum(float((np.abs(h.size) ** 2 / h.error**2).sum()) / 2 for h in found)
        return Estimate(
            cls(float(first * shrink), float(second * shrink)),
            {"first_rad": float(error[0]), "second_rad": float(error[1])},
            sigmas(log_chance(growth, 2 * len(found))),
            "what the phases of a ramp do once and twice in every turn"
            if ramps
            else "how unevenly the phases of the frames lie on a turn, once and twice around it",
            {"ramps": len(ramps), "random": len(random)},
        )


@dataclass(frozen=True)
class Harmonics:
    """Periodic error of one set.

    Attributes
    ----------
    size : (2,) complex128
        Amplitude and orientation with one and with two periods a turn, rad.
    error : (2,) float64
        1-sigma, of real and imaginary part.
    """

    size: C128
    error: F64


def _phase(found: FringeEvidence) -> F64:
    """Phases of the frames that tell any."""
    seen = np.isfinite(found.free).all(axis=1) & (found.free_covariance[:, 1, 1] > 0)
    return np.asarray(np.arctan2(found.free[seen, 2], found.free[seen, 1]))


def _gauge_error(found: FringeEvidence) -> F64:
    """Error of the maps' gauge, rad, once and twice a fringe.

    It takes the offsets, and the light, to hold no fringes. What they hold beside the frequencies
    of the fringes says how far that is so at them.
    """
    k, iota = np.array(found.k), found.theta[0]
    good = found.good & np.isfinite(found.delta) & (iota > 0)
    if not good.any():
        return np.zeros(2)
    contrast = float(np.median(np.hypot(found.theta[1], found.theta[2])[good] / iota[good]))
    phase = np.hypot(*k) * found.delta
    light = _beside(iota / np.median(iota[good]), good, k) / contrast
    return np.array([np.hypot(_beside(phase, good, k), light), _beside(phase, good, 2 * k)])


def _beside(values: F64, good: NDArray[np.bool_], k: F64) -> float:
    """Rms of the fringes of a map, cosine or sine, at frequencies next to one."""
    y, x = np.nonzero(good)
    rest = values[good] - values[good].mean()
    cycles = 2 * np.pi / np.array(good.shape[::-1])
    power = [
        np.abs(np.exp(-1j * ((k[0] + i * cycles[0]) * x + (k[1] + j * cycles[1]) * y)) @ rest) ** 2
        for i in range(-2, 3)
        for j in range(-2, 3)
        if (i, j) != (0, 0)
    ]
    return float(np.sqrt(2 * np.mean(power)) / len(rest))


def _of_ramp(phase: F64, gauge: F64) -> Harmonics:
    """Beside an even ramp, and a phase that walks as that of two fibres does."""
    n = len(phase)
    step = ramp_step(phase)
    for _ in range(3):
        command = step * np.arange(n)
        rest = np.unwrap(np.angle(np.exp(1j * (phase - command))))
        turns = (np.cos(command), np.sin(command), np.cos(2 * command), np.sin(2 * command))
        shapes = np.stack([*turns, np.ones(n), np.arange(n)], axis=1)
        step += float(np.linalg.lstsq(shapes, rest, rcond=1e-9)[0][-1])
    known = cosine_modes(np.delete(shapes, 4, axis=1))
    parts = np.stack([np.ones(n - 1), walk_power(n)])[..., None, None]
    scale = max(float(np.diff(rest).var()) / 2, 1e-20)
    found = estimate_components(
        Modes(
            values=cosine_modes(rest)[:, None],
            known=known[:, None, :],
            parts=parts,
            start=np.array([scale, 0.0]),
            least=np.array([1e-3 * scale, 0.0]),
        )
    )
    cos, sin = found.beta[[0, 2]], found.beta[[1, 3]]
    variance = np.diag(found.beta_covariance)
    error = np.sqrt((variance[[0, 2]] + variance[[1, 3]]) / 2 + gauge**2)
    return Harmonics(sin + 1j * cos, error)


def _of_random(phase: F64) -> Harmonics:
    """From the mean phasors of phases that lay evenly before.

    An error of one period moves the mean of exp(i phi) by its Bessel function J1, about half of it,
    and that of exp(2 i phi) by J2; one of two periods moves the latter by itself.
    """
    n = len(phase)
    one, two = (np.exp(1j * order * phase).mean() for order in (1, 2))
    first = 2 * abs(one) + abs(one) ** 3
    two -= jv(2, 2 * first) * (one / max(abs(one), 1e-12)) ** 2
    size = np.array([first * one / max(abs(one), 1e-12), two])
    return Harmonics(size, np.array([2.0, 1.0]) / np.sqrt(2 * n))
