"""The forward model of an effect: its action on the frames of a simulation.

A frozen dataclass of parameters, made with `pixcal.model.config.quantity`: units, ranges, and
default sizes from the literature, cited in ``sources``. A model overrides the steps of the exposure
on which it acts; by default, a step changes nothing. Steps follow the order in a camera
(`pixcal.simulation.exposure`); within a step, models act in the order of `ForwardModel.sort_key`.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from enum import IntEnum
from typing import Any, ClassVar, Self, TypeVar

import numpy as np

from pixcal.kernels.beams import Light, LightMaps
from pixcal.kernels.scene import DetectorMaps, FrameStates, Rows
from pixcal.model.arrays import F32
from pixcal.model.bench import Bench
from pixcal.simulation.memory import KEPT, Memory
from pixcal.simulation.recording import Recording
from pixcal.simulation.shot import Shot

DOMAINS = ("space", "time", "intensity", "noise")  # where an effect may show
# steps of the exposure: each returns its first argument, changed
STEPS = ("states", "detector", "light", "pixels", "photons", "charge", "signal", "readout")
T = TypeVar("T")


class Stage(IntEnum):
    """Where in the chain from fibre to file an effect acts; effects are applied in this order."""

    LIGHT = 1  # laser, fibres, modulator, glass: before the photon is absorbed
    PIXEL = 2  # where and how well a pixel responds
    CHARGE = 3  # collected electrons, shot noise included
    SIGNAL = 4  # voltages: coupling between pixels, response of the amplifier
    READOUT = 5  # noise and drift of the electronics
    CONVERTER = 6  # analogue to digital: the last step


@dataclass(frozen=True)
class Scalable:
    """A model, or a part of it, with strengths of its own."""

    strengths: ClassVar[tuple[str, ...]]

    def scaled(self, factor: float) -> Self:
        """The same, ``factor`` times as strong."""
        changed = {name: _times(getattr(self, name), factor) for name in self.strengths}
        return replace(self, **changed)


@dataclass(frozen=True)
class ForwardModel(Scalable):
    """Base of all effects; a subclass is a frozen dataclass in a file of its own in ``effects/``.

    Attributes
    ----------
    name : str
        In files and reports.
    title : str
        A few words, for readers.
    acts_at : Stage
    order : int
        Order within a stage: lower ones act first.
    domains : tuple of str
        Where it shows: one or more of `DOMAINS`, the main one first.
    strengths : tuple of str
        Fields that `scaled` multiplies: if all are zero, the effect has no action.
    optional_parameters : tuple of str
        Other fields that may be zero, which leaves the effect in its simplest form.
    frames_needed : tuple of str
        Frames that show it besides fringes of one set: ``dark``, ``flat``, ``ladder`` (flats at
        several exposure times), ``baseline`` (a second one along an axis), ``axis`` (another
        one), ``random`` (phases); by default, any but the last.
    sources : tuple of str
        Where the default sizes come from.
    quick : bool
        Whether `Effect.detect` takes at most about a second for 10⁷ samples, so that it can be
        used on many simulations.
    """

    name: ClassVar[str]
    title: ClassVar[str]
    acts_at: ClassVar[Stage]
    order: ClassVar[int] = 100
    domains: ClassVar[tuple[str, ...]]
    optional_parameters: ClassVar[tuple[str, ...]] = ()
    frames_needed: ClassVar[tuple[str, ...]] = ("dark", "flat", "ladder", "baseline", "axis")
    sources: ClassVar[tuple[str, ...]]
    quick: ClassVar[bool] = True

    @property
    def sort_key(self) -> tuple[int, int, str]:
        """Sort key of the order of action; ties are sorted by name."""
        return self.acts_at, self.order, self.name

    @property
    def is_null(self) -> bool:
        """Whether it has no action."""
        null = self.scaled(0.0)
        return all(getattr(self, name) == getattr(null, name) for name in self.strengths)

    @property
    def halo(self) -> int:
        """Rows above and below a piece of the window on which the piece depends."""
        return 0

    @property
    def frames_back(self) -> int:
        """Number of preceding frames on whose charge a frame depends."""
        return 0 if self.memory is None else self.memory.frames

    @property
    def frames_kept(self) -> int:
        """Number of frames whose charge or state a simulation keeps for it."""
        if self.memory is not None:
            return KEPT
        return 1 + self.frames_back if self.frames_back else 0

    @property
    def memory(self) -> Memory | None:
        """How a frame depends on the ones before it, if `carry` tells; None: it does not."""
        return None

    # Its action on the frames.

    def check(self, bench: Bench) -> None:
        """Raise InputError if a bench and the effect are incompatible."""

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """Intensity, amplitude, phase and fringe vector of every frame of a fringe set."""
        return states

    def detector(self, maps: DetectorMaps, bench: Bench, rows: Rows) -> DetectorMaps:
        """The detector's maps on a range of rows (first, one after the last)."""
        return maps

    def light(self, light: Light, recording: Recording, rows: Rows, maps: DetectorMaps) -> Light:
        """Beams and other light of a recording on a range of rows, before the pixels."""
        return light

    def pixels(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        """Light that pixels collect on a range of rows: mean and fringe amplitude, e-."""
        return light

    def photons(self, mean: F32, shot: Shot) -> F32:
        """Mean electrons (y, x) of a frame, before shot noise; dark current comes after."""
        return mean

    def charge(self, charge: F32, shot: Shot) -> F32:
        """Collected electrons (y, x), shot noise and full well included.

        The argument is kept for later frames: return another array, or the same unchanged.
        """
        return charge

    def carry(self, charge: F32, state: F32 | None, shot: Shot) -> tuple[F32, F32]:
        """As `charge`, for effects with a `memory`: also the state left to the next frame.

        ``state``: what the frame before left; None if nothing is known before it.
        """
        raise NotImplementedError

    def signal(self, signal: F32, shot: Shot) -> F32:
        """Signal (y, x) at the amplifiers, in electrons."""
        return signal

    def readout(self, adu: F32, shot: Shot) -> F32:
        """Samples (y, x) in ADU, bias and read noise included, before they are rounded."""
        return adu


def _times(value: Any, factor: float) -> Any:
    """A number, an object with ``scaled``, or each part of a tuple, times a factor."""
    if isinstance(value, tuple):
        return tuple(_times(part, factor) for part in value)
    return value.scaled(factor) if hasattr(value, "scaled") else factor * value


# Numbers of a model, by key


def numbers(value: Any, key: str = "") -> dict[str, float]:
    """All real numbers of a model, including those in its tuples and their parts."""
    if isinstance(value, float):
        return {key: value}
    parts: list[tuple[str, Any]] = []
    if isinstance(value, tuple):
        parts = [(f"{key}[{n}]", part) for n, part in enumerate(value)]
    elif is_dataclass(value):
        joint = f"{key}." if key else ""
        parts = [(joint + f.name, getattr(value, f.name)) for f in fields(value)]
    return {own: number for at, part in parts for own, number in numbers(part, at).items()}


def field_of(key: str) -> str:
    """Field of the model that a number is in."""
    return re.split(r"\W", key)[0]


def set_of(model: Any, key: str) -> str:
    """Name of the fringe set to which a number applies; empty if to all sets."""
    for name, place in re.findall(r"([a-z]\w*)|\[(\d+)\]", key):
        model = getattr(model, name) if name else model[int(place)]
        if of := getattr(model, "set", ""):
            return str(of)
    return ""


def with_numbers(model: T, values: Mapping[str, float]) -> T:
    """The model with other numbers, limited to their ranges."""
    changed: T = _changed(model, "", values, {})
    return changed


def _changed(value: Any, key: str, values: Mapping[str, float], limits: Mapping[str, Any]) -> Any:
    if isinstance(value, float):
        return within(values[key], limits) if key in values else value
    if isinstance(value, tuple):
        parts = enumerate(value)
        return tuple(_changed(part, f"{key}[{n}]", values, limits) for n, part in parts)
    if is_dataclass(value) and not isinstance(value, type):
        joint = f"{key}." if key else ""
        own = [f for f in fields(value) if any(k.startswith(joint + f.name) for k in values)]
        return replace(
            value,
            **{
                f.name: _changed(getattr(value, f.name), joint + f.name, values, f.metadata)
                for f in own
            },
        )
    return value


def within(value: float, limits: Mapping[str, Any]) -> float:
    """A number limited to the range of its field."""
    low, high, above = (limits.get(name) for name in ("low", "high", "above"))
    if above is not None:
        value = max(value, float(np.nextafter(above, np.inf)))
    return float(np.clip(value, -np.inf if low is None else low, np.inf if high is None else high))
