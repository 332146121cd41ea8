"""Evidence from a part of an acquisition about its effects: samples, maps, frames."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, wraps
from typing import Any, Concatenate, ParamSpec, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.diagnosis.free_frames import NO_SAMPLE, FreeFrames, free_frames
from pixcal.estimators.fringe_fit.fringes import FrameParameters, grid
from pixcal.estimators.fringe_fit.tile_fit import Coding
from pixcal.model.arrays import F32, F64, Indices, Mask

T = TypeVar("T")
P = ParamSpec("P")

SATURATED = 1e-3  # share of saturated samples above which flats are unusable for levels and noise
DITHER = 0.38  # noise over a code from which means of rounded samples are right to 2 % of a code


@dataclass(frozen=True)
class FringeEvidence:
    """One fringe set on a part of the window, and its fit."""

    name: str
    baseline_mm: tuple[float, float]  # nominal
    k: tuple[float, float]  # fringe vector (kx, ky) at the window's centre, rad/px
    origin: tuple[int, int]  # row and column of the part's first pixel in the window
    window: tuple[int, int]  # rows and columns of the whole window
    frame: Indices  # (t,) number of each frame in the set, ascending; frames may be missing
    time_s: F64  # (t,) time of each frame after the first of the set, s
    exptime_s: float  # nan when unknown
    # (t, y, x) reduced samples (less bias and dark, divided by the flat); NaN without weight
    electrons: F32
    adu: NDArray[np.generic]  # (t, y, x) the same samples as the camera wrote them
    g: F64  # (t, 3) (B, A cos phi, A sin phi) at the middle of the part
    dk: F64  # (t, 2) change of the fringe vector (x, y), rad/px; zeros when the fit held it
    # (t, 5) (B, A cos phi, A sin phi, dkx, dky) of each frame independently, from this part's
    # pixels, with the fringe vector free even if the fit held it
    free: F64
    free_covariance: F64  # (t, 5, 5) of ``free``, from the noise of the samples
    theta: F64  # (3, y, x) (iota, alpha sin psi, alpha cos psi), e-
    sigma: F64  # (y, x) 1-sigma error of the phase psi by noise, rad
    delta: F64  # (y, x) offset along the fringe axis, px, modes removed; NaN where masked
    good: Mask  # (y, x)
    # read_variance, shot_factor: (y, x) variance of a sample: ``shot_factor * model +
    # read_variance`` (e-²)
    read_variance: F64
    shot_factor: F64
    # time of the set's frame 0 after the first frame of the acquisition; nan when unknown
    start_s: float = np.nan

    @cached_property
    def model(self) -> F32:
        """Fitted model (t, y, x), e-; the change of the fringe vector to first order."""
        frames, maps = self.g, self.theta
        if np.any(self.dk):
            y, x = grid((self.good.shape[0], self.good.shape[1]))
            _, c, s = self.g.T
            kx, ky = self.dk.T
            _, of_sine, of_cosine = self.theta
            frames = np.column_stack([self.g, kx * c, ky * c, kx * s, ky * s])
            turned = [x * of_cosine, y * of_cosine, -x * of_sine, -y * of_sine]
            maps = np.concatenate([self.theta, turned])
        flat = maps.reshape(len(maps), -1).astype(np.float32)
        return np.asarray((frames.astype(np.float32) @ flat).reshape(-1, *self.good.shape))

    @cached_property
    def residual(self) -> F32:
        """Samples less the model (t, y, x), e-; NaN without weight."""
        return np.asarray(self.electrons - self.model)

    @cached_property
    def variance(self) -> F32:
        """Variance (t, y, x) that the noise model predicts, e-²."""
        variance = np.maximum(self.model, np.float32(0))
        variance *= self.shot_factor.astype(np.float32)
        variance += self.read_variance.astype(np.float32)
        return np.asarray(variance)

    @property
    def phi(self) -> F64:
        """Phase of each frame, rad."""
        return np.arctan2(self.g[:, 2], self.g[:, 1])

    @cached_property
    def halves(self) -> tuple[FreeFrames, FreeFrames]:
        """``free`` and ``free_covariance`` of each half of the pixels, as in `free_frames`.

        Stored when the `Evidence` is built; recomputed for a subset of its frames or pixels.
        """
        codes = np.where(np.isnan(self.electrons), np.float32(NO_SAMPLE), self.electrons)
        return self.free_of(codes)[1:]

    def free_of(self, samples: F32) -> tuple[FreeFrames, FreeFrames, FreeFrames]:
        """`free_frames` of samples (t, y, x), e-, `NO_SAMPLE` without weight."""
        pixels = self.theta, self.read_variance, self.shot_factor, self.good
        ny, nx = self.good.shape
        start = FrameParameters(self.g, self.dk, ((ny - 1) / 2, (nx - 1) / 2))
        return free_frames(samples, Coding(1.0, 0.0, NO_SAMPLE), start, *pixels)


SOON_S = 600.0  # time after light within which traps may still release charge

Level = tuple[float, int]


@dataclass(frozen=True)
class Stack:
    """Calibration frames of one kind and exposure time, as the camera wrote them."""

    kind: str  # ``bias``, ``dark`` or ``flat``
    exptime_s: float  # nan when unknown
    frame: Indices  # (t,) number of each frame among those of its kind, ascending
    time_s: F64  # (t,) time of each frame, from the first of its kind
    adu: F32  # (t, y, x)
    # time of the first of its kind after the first frame of the acquisition; nan when unknown
    start_s: float = np.nan
    step: int = 0  # of the lamp, among flats of one exposure time; 0 is the dimmest
    last: int = -1  # number of the last frame of its series, if not among these

    @property
    def level(self) -> Level:
        """Exposure time (s, negative when unknown) and step of the lamp."""
        return (float(np.nan_to_num(self.exptime_s, nan=-1.0)), self.step)

    @property
    def key(self) -> tuple[str, float, int]:
        """Kind and level, which identify a stack of an acquisition."""
        return self.kind, *self.level


def soon_after(light: F64, stack: Stack) -> bool:
    """Whether a series begins so soon after one of the lit frames, s, that traps may release."""
    since = stack.start_s + stack.time_s[0] - light
    return bool(((since > 0) & (since < SOON_S)).any())


@dataclass(frozen=True)
class Evidence:
    """A part of the window of an acquisition that was reduced and fitted."""

    fringes: Mapping[str, FringeEvidence]  # fringe sets by name
    stacks: tuple[Stack, ...]  # bias, darks and flats
    gain: float  # e-/ADU
    read_noise: float  # of a sample, with the rounding of the converter; e- rms
    amplifier_noise: float  # the same before rounding
    bias: F64  # bias, dark_rate, flat: (y, x) calibration maps: ADU, e-/s, relative
    dark_rate: F64
    flat: F64
    good: Mask  # (y, x) pixels without flags
    saturation_adu: float  # declared, or the end of the samples' type
    pitch_um: float  # pitch_um, wavelength_nm, distance_mm: nominal bench
    wavelength_nm: float
    distance_mm: float
    notes: tuple[str, ...] = field(default=())
    origin: tuple[int, int] = (0, 0)  # row and column of the part's first pixel in the window
    # gain from photon transfer (e-/ADU), its error, and the reduced chi-square; nan without any
    photon_transfer: tuple[float, float, float] = (np.nan, np.nan, np.nan)
    # lags (rows, columns) whose covariance that gain includes
    neighbours: tuple[tuple[int, int], ...] = ()
    subtracted_dark: float = 0.0  # dark signal that the camera subtracts, e-/s
    lowest_adu: float | None = None  # code at which noise is cut off; None without a cut-off
    # whether the gain of `photon_transfer` leaves out noise without light, which is not that of
    # flats
    without_dark: bool = False
    # F² that the gain allows for: above 1 where electrons are multiplied before the output
    excess_noise_factor: float = 1.0
    read_noise_error: float = np.nan  # of ``read_noise``, e- rms; nan when unknown
    step_adu: int = 1  # all calibration samples are multiples of it
    # flats that saturate in the data with which a simulation is compared; None for the data
    full: frozenset[Level] | None = None
    _found: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def once(self, name: str, *given: Any, make: Callable[[], T]) -> T:
        """Result that depends on this evidence and hashable arguments, made at first use."""
        if (name, *given) not in self._found:
            self._found[name, *given] = make()
        return cast(T, self._found[name, *given])

    def level(self, fringes: FringeEvidence, signal: F32) -> F32:
        """Electrons in the pixels for a signal (t, y, x) of a set: with flat and dark again."""
        seconds = fringes.exptime_s if np.isfinite(fringes.exptime_s) else 0.0
        dark = self.dark_charge_rate * seconds
        return signal * self.flat.astype(np.float32) + dark.astype(np.float32)

    @property
    def dark_charge_rate(self) -> F64:
        """Dark signal (y, x) that has shot noise, e-/s, never negative."""
        return np.maximum(self.dark_rate + self.subtracted_dark, 0)

    def dark_noise(self, stack: Stack) -> tuple[F32, F32]:
        """Unlit frames (t, y, x), less medians of pixels and frames; sigma; e-, NaN if flagged."""
        rest = (stack.adu - np.median(stack.adu, axis=0)) * self.gain
        rest = np.where(self.good, rest, np.nan)
        rest -= np.nanmedian(rest, axis=(1, 2), keepdims=True) if self.good.any() else 0
        seconds = np.nan_to_num(stack.exptime_s)
        sigma = np.sqrt(self.read_noise**2 + self.dark_charge_rate * seconds)
        every = np.broadcast_to(sigma.astype(np.float32), rest.shape)
        return rest.astype(np.float32), every

    @property
    def dithered(self) -> bool:
        """Whether the read noise spans enough of a code for unbiased means of dark samples."""
        return self.amplifier_noise > DITHER * self.gain * self.step_adu

    @property
    def has_level(self) -> bool:
        """Whether the level without light is known, so that noise can be compared with light."""
        # A camera that clips its noise at zero may have a bias of zero everywhere.
        return bool(self.bias.any()) or any(stack.kind != "flat" for stack in self.stacks)

    @cached_property
    def ladder(self) -> tuple[Stack, ...]:
        """Flats by exposure time, without partly saturated ones."""
        full = self.saturated if self.full is None else self.full
        return tuple(s for s in self.of_kind("flat") if s.level not in full)

    @cached_property
    def saturated(self) -> frozenset[Level]:
        """Flats with too many saturated samples in good pixels to be used."""
        limit = self.saturation_adu
        return frozenset(
            s.level
            for s in self.of_kind("flat")
            if (s.adu[:, self.good] >= limit).mean() >= SATURATED
        )

    def without_frames(self) -> "Evidence":
        """The maps alone: fringe sets without samples, and no calibration frames."""
        fringes = {
            name: replace(f, electrons=f.electrons[:0], adu=f.adu[:0])
            for name, f in self.fringes.items()
        }
        return replace(self, fringes=fringes, stacks=())

    def soon_after_light(self, stack: Stack) -> bool:
        """Whether a series begins so soon after light that traps may still release charge."""
        flats = [s.start_s + s.time_s for s in self.of_kind("flat")]
        lit = np.concatenate([*flats, *(f.start_s + f.time_s for f in self.fringes.values()), []])
        return soon_after(lit, stack)

    def of_kind(self, kind: str) -> tuple[Stack, ...]:
        """Stacks of a kind, by exposure time."""
        return tuple(
            sorted((s for s in self.stacks if s.kind == kind), key=lambda s: (s.exptime_s, s.step))
        )


def cached_on_evidence(
    make: Callable[Concatenate[Evidence, P], T],
) -> Callable[Concatenate[Evidence, P], T]:
    """Decorate a function of `Evidence` whose results are to be kept in it (`Evidence.once`).

    Further arguments: hashable ones, stacks of the evidence, and arrays.
    """
    name = f"{make.__module__}.{make.__qualname__}"

    def key(given: Any) -> Any:
        if isinstance(given, np.ndarray):
            return given.shape, given.tobytes()
        return given.key if isinstance(given, Stack) else given

    @wraps(make)
    def kept(evidence: Evidence, /, *given: P.args, **named: P.kwargs) -> T:
        keys = map(key, (*given, *named.items()))
        return evidence.once(name, *keys, make=lambda: make(evidence, *given, **named))

    return kept
