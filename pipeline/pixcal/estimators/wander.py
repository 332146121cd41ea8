"""Phases that leave a ramp: in fibres they wander, and by chance a little as modulators err."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import FringeEvidence

F64 = NDArray[np.float64]

HARMONICS = (1, 2)
"""Of the ramp that an error of the modulator has,"""
BESIDE = (-6, -5, -4, -3, -2, 2, 3, 4, 5, 6)
"""and frequencies beside them that tell what chance gives, in turns of a part of the frames."""


@dataclass(frozen=True)
class Wander:
    """How the phases of a ramp wander, as they do in fibres.

    Attributes
    ----------
    rest : (t,) float64
        As measured (rad), but for the harmonics of the ramp, which a modulator's error has too.
        Each part of the frames has a zero of its own; in frames of no part it is zero.
    power : tuple of float
        Mean squares (rad²) of the amplitudes that chance gives these harmonics: those beside them.
    """

    rest: F64
    power: tuple[float, ...]

    def drawn(self, command: F64, rng: np.random.Generator) -> F64:
        """Phases (t,) besides the ramp, rad, with harmonics drawn by chance."""
        phase = self.rest.copy()
        for order, power in zip(HARMONICS, self.power, strict=False):
            one, other = np.sqrt(power / 2) * rng.standard_normal(2)
            phase += 2 * (one * np.cos(order * command) - other * np.sin(order * command))
        return phase


def wander_of(
    found: Sequence[FringeEvidence], frames: Sequence[NDArray[np.intp]], count: int, step: float
) -> Wander:
    """How the phases leave a ramp.

    Parameters
    ----------
    found : sequence of FringeEvidence
        Parts of the frames.
    frames : sequence of (t,) int array
        Numbers of the frames of each part.
    count : int
        Frames of the whole set.
    step : float
        Of the ramp, rad; zero: there is none, and nothing leaves it.
    """
    rest, power = np.zeros(count), []
    if not step:
        return Wander(rest, ())
    for one, numbers in zip(found, frames, strict=True):
        command = step * numbers
        own = np.unwrap(np.angle(np.exp(1j * (one.phi - command))))
        waves = [f(n * command) for n in HARMONICS for f in (np.cos, np.sin)]
        terms = np.stack([np.ones(len(command)), *waves], axis=1)
        own = own - terms @ np.linalg.lstsq(terms, own, rcond=1e-9)[0]
        cosine, sine = one.free[:, 1], one.free[:, 2]
        along = np.stack([-sine, cosine], axis=1) / np.hypot(sine, cosine)[:, None] ** 2
        noise = np.einsum("ti,tij,tj->t", along, one.free_covariance[:, 1:3, 1:3], along).mean()
        seen = float(own.var())
        rest[numbers] = own * np.sqrt(max(1 - noise / seen, 0.0)) if seen > 0 else 0.0
        turns = 2 * np.pi * np.array(BESIDE) / len(numbers)
        power.append(
            [
                np.mean(
                    np.abs(np.exp(-1j * np.outer(n * step + turns, numbers)) @ rest[numbers]) ** 2
                )
                / len(numbers) ** 2
                for n in HARMONICS
            ]
        )
    return Wander(rest, tuple(float(p) for p in np.mean(power, axis=0)))
