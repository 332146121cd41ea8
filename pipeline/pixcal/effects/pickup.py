"""Tones that the electronics pick up while a frame is read, of another phase in each frame.

The differences of two frames hold no fixed pattern. Their strongest tones are found in the mean
periodogram, taken off, and the rest searched again (CLEAN: Högbom 1974, A&AS 15, 417).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.fft import rfft2
from scipy.ndimage import maximum_filter
from scipy.optimize import minimize

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_largest
from pixcal.kernels.synthesis import add_waves, turns
from pixcal.model.arrays import C128, F32, F64, I64, Mask
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_SIDE = 512  # most rows and columns that are searched
_FRAMES = 8  # most differences of frames that are searched
_WILD = 8.0  # standard deviations above which a sample is no noise
_MOST = 48  # tones
_AT_ONCE, _NEARLY = 8, 0.25  # tones found in one search, and their least power over the strongest
_STRONG = 5.0  # power over that of white noise from which a frequency is refined


@dataclass(frozen=True)
class Pickup(Effect):
    """Other signals that reach the amplifier: supplies, clocks, cables.

    A signal of one frequency makes a wave along the order in which pixels are read: a tone along
    rows and columns. It does not keep step with the frames, so its phase differs in each and no
    bias map holds it. A signal of some bandwidth is several tones.
    """

    name = "pickup"
    title = "electrical pick-up while a frame is read"
    acts_at = Stage.READOUT
    order = 5
    domains = ("noise",)
    strengths = ("rms",)
    left_because = "noise that is independent in each frame averages out"
    frames_needed = ("dark",)
    remedy = "fix on the bench: find the source among supplies, cables and clocks"
    sources = (
        "bias frames of the ESIS camera (package msfc-ccd 1.1): tones of 3 to 4 e- rms in a read "
        "noise of 10 e-",
    )

    rms: tuple[float, ...] = quantity(
        (3.0, 1.0), unit="e-", low=0, high=1e5, doc="of each tone, rms"
    )
    columns: tuple[float, ...] = quantity(
        (0.297, 0.242), unit="1/px", low=0, high=0.5, doc="its cycles per column"
    )
    rows: tuple[float, ...] = quantity(
        (0.125, -0.31), unit="1/px", low=-0.5, high=0.5, doc="its cycles per row"
    )

    def __post_init__(self) -> None:
        if not len(self.rms) == len(self.columns) == len(self.rows):
            raise InputError("rms, columns and rows: give as many numbers of each, one for a tone")

    @property
    def read_variance(self) -> float:
        return float(np.square(self.rms).sum())

    def readout(self, adu: F32, shot: Shot) -> F32:
        y, x = np.arange(*shot.rows), np.arange(adu.shape[1])
        phases = shot.rng(self.name).uniform(0, 2 * np.pi, len(self.rms))
        size = np.sqrt(2) * np.array(self.rms) / shot.bench.detector.gain_e_per_adu
        down = y[:, None] * (2 * np.pi * np.array(self.rows)) + phases
        along = np.array(self.columns)[:, None] * (2 * np.pi * x)
        found = adu.copy()
        add_waves(turns(down) * size.astype(np.float32), turns(along), found)
        return found

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Tones of the frames without light, one after another; of the residuals without any."""
        noise = _noise(evidence)
        if noise is None:
            return None
        frames, good = noise
        significance, tones, rest = 0.0, np.zeros((0, 2)), frames
        while len(tones) < _MOST:
            found = _search(rest, good)
            if not len(tones):
                significance, first = found.sigmas, found.tones[:1]
            if found.sigmas < SIGNIFICANT:
                break
            tones = np.concatenate([tones, found.tones])[:_MOST]
            rest = frames - _drawn(_sizes(frames, good, tones), tones, frames.shape)
            rest *= good
        tones = tones if len(tones) else first
        size = _sizes(frames, good, tones)
        number = np.count_nonzero(good)
        white = float(np.square(rest).sum()) / len(frames) / number
        power = np.maximum((np.abs(size) ** 2).mean(axis=0) / 2 - 2 * white / number, 0.0)
        # Two waves of random phases add up by chance.
        error = np.sqrt((power**2 / 2 + (2 * white / number) ** 2) / len(frames))
        order = np.argsort(-power)
        rms, tones, error = np.sqrt(power[order]), tones[order], error[order]
        errors = error / (2 * np.maximum(rms, np.sqrt(error) / 2))
        total = float(np.sqrt(power.sum()))
        return Estimate(
            cls(*(tuple(map(float, values)) for values in (rms, tones[:, 1], tones[:, 0]))),
            {f"rms[{n}]": float(e) for n, e in enumerate(errors)},
            significance,
            "tones in differences of frames"
            + ("" if _dark(evidence) else ", beside fringes and light"),
            size={
                "value": total,
                "error": float(np.sqrt((error**2).sum())) / (2 * max(total, 1e-9)),
                "unit": "e-",
                "of": f"rms in {len(rms)} tones, the strongest of {1 / np.hypot(*tones[0]):.3g} px",
            },
        )

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        noise = _noise(evidence)
        return None if noise is None else _search(*noise, refine=False).sigmas


class _Found(NamedTuple):
    tones: F64  # (n, 2) cycles per row and per column, the strongest first
    sigmas: float  # significance of the strongest


def _wave(frequency: float | F64, at: I64) -> C128:
    return np.asarray(np.exp(2j * np.pi * frequency * at))


def _dark(evidence: Evidence) -> bool:
    return any(s.kind in ("bias", "dark") and len(s.adu) > 1 for s in evidence.stacks)


def _noise(evidence: Evidence) -> tuple[F32, Mask] | None:
    """Differences of frames (t, y, x), of the noise of one frame (e-), zero in bad pixels."""
    middle = tuple(slice(max((n - _SIDE) // 2, 0), (n + _SIDE) // 2) for n in evidence.good.shape)
    good = evidence.good[middle]
    some: list[F32] = []
    for stack in evidence.stacks:
        if stack.kind in ("bias", "dark") and evidence.dithered:
            adu = stack.adu[:, *middle].astype(np.float32)
            count = len(adu) // 2 * 2
            some += list((adu[1:count:2] - adu[:count:2]) * np.float32(evidence.gain / 2**0.5))
    if not some:
        some = [
            change[middle]
            for found in evidence.fringes.values()
            for change in found.residual[:_FRAMES]
        ]
    if not some or not good.any():
        return None
    frames = np.stack(some[:_FRAMES])
    frames -= np.nanmean(frames[:, good], axis=1)[:, None, None]
    limit = _WILD * np.sqrt(np.nanmean(frames[:, good] ** 2))
    return np.where(good & (np.abs(frames) < limit), frames, np.float32(0)), good


def _search(frames: F32, good: Mask, *, refine: bool = True) -> _Found:
    """Strongest tones of the mean periodogram, beside rows and columns."""
    count, ny, nx = frames.shape
    spectra = rfft2(frames)
    power = (spectra.real**2 + spectra.imag**2).mean(axis=0, dtype=float)
    power /= max(float(np.square(frames).sum()) / count, 1e-30)
    # Noise of whole rows or columns has its own effects.
    power[0] = power[:, 0] = 0
    peaks = power == maximum_filter(power, 3, mode=("wrap", "nearest"))
    peaks &= power > _NEARLY * power.max()
    at = np.argwhere(peaks)
    at = at[np.argsort(-power[*at.T])][:_AT_ONCE]
    strongest = float(power[*at[0]])
    # An ordinate has Wilson and Hilferty's distribution (1931), of two degrees per frame.
    ninth = 1 / (9 * count)
    own = (np.cbrt(strongest) - (1 - ninth)) / np.sqrt(ninth)
    sigmas = sigmas_of_largest(float(own), (ny - 1) * (nx // 2))
    tones = np.stack([np.fft.fftfreq(ny)[at[:, 0]], at[:, 1] / nx], axis=1)
    if refine:
        for n in np.flatnonzero(power[*at.T] > _STRONG):
            tones[n] = _refined(frames, tones[n])
    return _Found(tones, sigmas)


def _refined(frames: F32, tone: F64) -> F64:
    """Frequency of the highest power about a tone."""
    _, ny, nx = frames.shape
    bins = np.array([1 / ny, 1 / nx])

    def loss(shift: F64) -> float:
        fy, fx = tone + shift * bins
        along = frames @ _wave(-fx, np.arange(nx)).astype(np.complex64)
        return -float((np.abs(along @ _wave(-fy, np.arange(ny))) ** 2).sum())

    start = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3]])
    options = {"initial_simplex": start, "xatol": 0.01, "fatol": 1e-4, "maxiter": 40}
    shift = minimize(loss, start[0], method="Nelder-Mead", options=options).x
    return np.asarray(tone + np.clip(shift, -1, 1) * bins)


def _sizes(frames: F32, good: Mask, tones: F64) -> C128:
    """Amplitudes (t, n) of tones in each frame, by least squares."""
    _, ny, nx = frames.shape
    down, along = (_wave(f[:, None], np.arange(n)) for f, n in zip(tones.T, (ny, nx), strict=True))
    products = np.einsum("tyn,ny->tn", frames @ along.conj().T, down.conj())
    overlap = (down.conj() @ down.T) * (along.conj() @ along.T)
    overlap *= np.count_nonzero(good) / good.size
    return np.asarray(2 * np.linalg.lstsq(overlap, products.T)[0].T)


def _drawn(size: C128, tones: F64, shape: tuple[int, ...]) -> F32:
    """Frames (t, y, x) of tones of these amplitudes."""
    down, along = (_wave(f[:, None], np.arange(n)) for f, n in zip(tones.T, shape[1:], strict=True))
    return np.asarray(((size[:, None] * down.T) @ along).real, np.float32)
