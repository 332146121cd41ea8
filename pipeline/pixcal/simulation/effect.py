"""What an effect of the bench or the detector is: a frozen dataclass of its parameters.

An effect can act on the frames of a simulation, learn its own parameters from an acquisition, say
what it does to the maps of a fit, and, where physics allows, undo that. Its fields are made with
`pixcal.model.config.quantity`: units, ranges, and defaults of the size that the literature gives,
cited in ``sources``.

An effect overrides the steps of the exposure that it acts on; the others leave things as they are.
The order of the steps is that of a camera (`pixcal.simulation.exposure`); within a step, effects
act in the order of `Effect.acts_at` and then of their names.
"""

import dataclasses
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.evidence import Evidence
from pixcal.kernels.scene import DetectorMaps, FrameStates, LightMaps, Rows
from pixcal.model.bench import Bench
from pixcal.model.config import parse, to_plain
from pixcal.model.errors import InputError
from pixcal.simulation.recording import Recording
from pixcal.simulation.shot import Shot

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]


SURE = 3.0
"""Errors that a strength must have to stand beside others of the same effect."""


DOMAINS = ("space", "time", "intensity", "noise")
"""Where an effect may show."""


class Stage(IntEnum):
    """Where in the chain from fibre to file an effect acts; effects are applied in this order."""

    LIGHT = 1
    """Laser, fibres, modulator, glass: before the photon is absorbed."""
    PIXEL = 2
    """Where and how well a pixel responds."""
    CHARGE = 3
    """Collected electrons, shot noise included."""
    SIGNAL = 4
    """Voltages: coupling between pixels, response of the amplifier."""
    READOUT = 5
    """Noise and drift of the electronics."""
    CONVERTER = 6
    """Analogue to digital: the last of all."""


@dataclass(frozen=True)
class FringeMaps:
    """What a fit finds of one fringe set, for effects that are linear in the intensity.

    Attributes
    ----------
    theta : (3, y, x) float64
        (iota, alpha sin psi, alpha cos psi), e-.
    k : (float, float)
        Fringe vector (kx, ky) at the centre, rad/px.
    origin : (int, int)
        First row and column of these maps in the detector's window.
    flat : (y, x) float64, optional
        Relative response as flats show it, which samples were divided by; None without flats. An
        effect that acts on flats as well changes it.
    name : str
        Of the fringe set.
    """

    theta: F64
    k: tuple[float, float]
    origin: tuple[int, int] = (0, 0)
    flat: F64 | None = None
    name: str = ""


@dataclass(frozen=True)
class Estimate:
    """Parameters of an effect, learnt from an acquisition.

    Attributes
    ----------
    effect : Effect
        With the best parameters.
    errors : mapping
        1-sigma errors of the parameters that were fitted, by field name (``couplings[0].share``).
    significance : float
        How far from no effect at all, in standard deviations of chance.
    why : str
        One sentence: which frames and which statistic told.
    details : mapping
        Numbers by which several ways of measuring can be compared.
    together : tuple of mapping
        Steps of several parameters at once, of independent errors of one sigma, where the errors
        hang together; otherwise each parameter has an error of its own.
    law : str
        The best of the mechanism's laws, in words; empty where the effect is its own law.
    by_law : Effect, optional
        The effect as that law has it.
    """

    effect: "Effect"
    errors: Mapping[str, float]
    significance: float
    why: str
    details: Mapping[str, Any] = field(default_factory=dict)
    together: tuple[Mapping[str, float], ...] = ()
    law: str = ""
    by_law: "Effect | None" = None

    @property
    def sure(self) -> "Effect":
        """The effect without strengths and optional parameters that are consistent with zero.

        What is known badly may be tiny in some frames and wild in others.
        """
        nothing = self.effect.scaled(0.0)
        unsure = {n: getattr(nothing, n) for n in self.effect.strengths if not self._is_sure(n)}
        unsure |= {n: 0.0 for n in self.effect.optional_parameters if not self._is_sure(n)}
        pruned = dataclasses.replace(self.effect, **unsure)
        return self.effect if pruned.is_null else pruned

    def scattered(self, effect: "Effect", seed: int) -> "Effect":
        """This effect, as it is or in part, with its parameters moved by their errors.

        What is zero in it stays so; beyond the range of a parameter nothing is moved.
        """
        rng = np.random.default_rng([seed, zlib.crc32(effect.name.encode())])
        plain = to_plain(effect)
        for steps in self.together or [{key: self.errors[key]} for key in sorted(self.errors)]:
            size = rng.standard_normal()
            for key, step in steps.items():
                _move(plain, re.findall(r"[^.\[\]]+", key), step * size)
        try:
            return parse(type(effect), plain, effect.name)
        except InputError:
            return effect

    def _is_sure(self, name: str) -> bool:
        value = getattr(self.effect, name)
        parts = {f"{name}[{n}]": v for n, v in enumerate(value if isinstance(value, tuple) else ())}
        return not all(
            isinstance(part, (int, float)) and abs(part) <= SURE * self.errors.get(key, 0.0)
            for key, part in (parts or {name: value}).items()
        )


@dataclass(frozen=True)
class Effect:
    """Base of all effects; a subclass is a frozen dataclass in a file of its own in ``effects/``.

    Attributes
    ----------
    name : str
        In files and reports.
    title : str
        In a few words, for people.
    acts_at : Stage
    domains : tuple of str
        Where it shows: one or more of `DOMAINS`, the first before all.
    strengths : tuple of str
        Fields that `scaled` multiplies: with all of them zero the effect does nothing.
    optional_parameters : tuple of str
        Fields beside these that may be zero, with the effect still there in its simplest form.
    frames_needed : tuple of str
        Frames that tell on it besides fringes of one set: ``dark``, ``flat``, ``ladder`` (of
        flats), ``baseline`` (a second one along an axis), ``axis`` (another one), ``random``
        (of the phases); if not said, any but the last.
    sources : tuple of str
        Where the default sizes come from.
    quick : bool
        Whether an estimate takes about a second or less of 10⁷ samples, so that it can be made of
        many simulations.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    acts_at: ClassVar[Stage]
    domains: ClassVar[tuple[str, ...]]
    strengths: ClassVar[tuple[str, ...]]
    optional_parameters: ClassVar[tuple[str, ...]] = ()
    frames_needed: ClassVar[tuple[str, ...]] = ("dark", "flat", "ladder", "baseline", "axis")
    sources: ClassVar[tuple[str, ...]]
    quick: ClassVar[bool] = True

    def scaled(self, factor: float) -> Self:
        """The same effect, ``factor`` times as strong."""
        changed = {name: _times(getattr(self, name), factor) for name in self.strengths}
        return dataclasses.replace(self, **changed)

    @property
    def is_null(self) -> bool:
        """Whether it does nothing."""
        return all(_is_zero(getattr(self, name)) for name in self.strengths)

    @property
    def halo(self) -> int:
        """Rows above and below a piece of the window that the piece depends on."""
        return 0

    @property
    def frames_back(self) -> int:
        """Frames before a frame whose charge the frame depends on."""
        return 0

    # What it does to the frames.

    def check(self, bench: Bench) -> None:
        """Raise InputError where a bench and the effect do not go together."""

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """Intensity, amplitude, phase and fringe vector of every frame of a fringe set."""
        return states

    def detector(self, maps: DetectorMaps, bench: Bench, rows: Rows) -> DetectorMaps:
        """The detector's maps on some rows of the window (first, one after the last)."""
        return maps

    def light(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        """Mean and fringe amplitude on some rows (e-); of flats only the mean."""
        return light

    def photons(self, mean: F32, shot: Shot) -> F32:
        """Mean electrons (y, x) of a frame, before shot noise; dark current comes after."""
        return mean

    def charge(self, charge: F32, shot: Shot) -> F32:
        """Collected electrons (y, x), shot noise and full well included.

        What is given is kept for later frames: give back another array, or the same unchanged.
        """
        return charge

    def signal(self, signal: F32, shot: Shot) -> F32:
        """Signal (y, x) at the amplifiers, in electrons."""
        return signal

    def readout(self, adu: F32, shot: Shot) -> F32:
        """Samples (y, x) in ADU, bias and read noise included, before they are rounded."""
        return adu

    # What is learnt of it, and what becomes of the maps.

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Parameters and errors from an acquisition; None where it holds no evidence of it."""
        raise NotImplementedError(f"{cls.__name__} cannot be estimated")

    def replayed(self, evidence: Evidence) -> Self | None:
        """The same effect doing to each frame what it did to these, whatever its law.

        None for effects whose law says all that there is to say of single frames.
        """
        return None

    def predict(self, maps: FringeMaps) -> FringeMaps | None:
        """Maps that a fit finds with the effect on; None where maps alone do not tell."""
        return None

    def undo(self, maps: FringeMaps) -> FringeMaps | None:
        """Maps without the effect, from those with it; None where that is not possible."""
        return None

    def undo_samples(self, charge: F32) -> F32 | None:
        """Frames without the effect, where it is one of samples and not of maps.

        Parameters
        ----------
        charge : (t, y, x) float32
            e-, as collected: dark signal included, not divided by the flat. All finite.
        """
        return None

    def measured_again(self, parts: Sequence[Evidence]) -> Estimate | None:
        """The effect as a correction needs it, from all frames; None if it is as good as it is.

        Parameters
        ----------
        parts : sequence of Evidence
            Of the same pixels, with different frames; calibration frames are in the first.
        """
        return None

    def phase_slopes(self, maps: FringeMaps) -> F64 | None:
        """Change (n, y, x) of the undone phase, rad, by each parameter that has a covariance.

        Parameters
        ----------
        maps : FringeMaps
            After `undo`.
        """
        return None

    @property
    def undo_halo(self) -> int:
        """Pixels around a piece of the window that undoing the effect on it depends on."""
        return 0

    def noise_factor(self, charge: float, read_noise: float, maps: FringeMaps) -> F64:
        """Error (y, x) of a pixel's phase after `undo` over that before.

        Parameters
        ----------
        charge, read_noise : float
            Mean signal and read noise, e-.
        maps : FringeMaps
            That are undone.
        """
        return np.ones(maps.theta.shape[1:])


def _move(plain: Any, path: Sequence[str], step: float) -> None:
    """Add to the number at a path of keys and places, if there is one that is not zero."""
    for key in path[:-1]:
        plain = plain[int(key)] if isinstance(plain, list) else plain.get(key)
        if not plain:
            return
    last: Any = int(path[-1]) if isinstance(plain, list) else path[-1]
    value = plain[last] if isinstance(plain, list) else plain.get(last)
    if isinstance(value, float) and value:
        plain[last] = value + step


def _times(value: Any, factor: float) -> Any:
    return tuple(_times(v, factor) for v in value) if isinstance(value, tuple) else value * factor


def _is_zero(value: Any) -> bool:
    return all(map(_is_zero, value)) if isinstance(value, tuple) else value == 0
