"""Tones that the electronics pick up while a frame is read; their phase differs in each frame.

The strongest tones are subtracted from the differences of frames, and the rest is searched again
(CLEAN: Högbom 1974, A&AS 15, 417).
"""

from dataclasses import dataclass

import numpy as np
from scipy.fft import rfft2
from scipy.ndimage import maximum_filter
from scipy.optimize import minimize

from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.significance import SIGNIFICANT, sigmas_of_largest
from pixcal.kernels.synthesis import add_waves, turns
from pixcal.model.arrays import C128, F32, F64, I64, Mask
from pixcal.model.bench import SimulatedDetector
from pixcal.model.config import quantity
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_SIDE = 512  # most rows and columns that are searched
_LEAST = 32  # fewest rows and columns
_FRAMES = 8  # most differences of frames that are searched
_WILD = 8.0  # standard deviations above which a sample is not noise
_MOST = 48  # tones
_AT_ONCE, _NEARLY = 8, 0.25  # tones found in one search, and their least power over the strongest
_DISTINCT = 0.7  # least distance of two tones, modes
# Modes (y, x) whose median is the noise about a tone: few of one frequency along rows where this is
# low, as noise is 1/f there.
_AROUND, _AROUND_SLOW = (8, 8), (32, 1)
_SLOW = 8  # modes along rows that are low
# Mains hum hardly changes along a row, and a tone whose period divides that of rows not along a
# column. Noise of rows or columns has a spectrum of its own, with harmonics of steps between
# outputs: a tone exceeds all modes within an octave, except for one other tone.
_FIRST, _STANDS_OUT = 6, 3.0  # least cycles; least power over the next highest
# Fewer cycles along columns are drifts; or, with few along rows, steps between outputs.
_DRIFTS, _STEPS = 4, 24


@dataclass(frozen=True)
class Pickup(Effect):
    """Other signals that reach the amplifier: supplies, clocks, cables."""

    name = "pickup"
    title = "electrical pick-up during readout"
    acts_at = Stage.READOUT
    order = 5
    domains = ("noise",)
    strengths = ("rms",)
    left_because = "noise that is independent in each frame averages out"
    frames_needed = ("dark",)
    remedy = "fix on the bench: find the source among supplies, cables and clocks"
    sources = (
        "assumed; bias frames of the ESIS camera (package msfc-ccd 1.2) have tones of 5.6 e- rms "
        "together, in a read noise of 10 e-",
    )

    rms: tuple[float, ...] = quantity((3.0, 1.0), unit="e-", low=0, high=1e5)
    """of each tone, rms"""
    columns: tuple[float, ...] = quantity((0.297, 0.242), unit="1/px", low=0, high=0.5)
    """its cycles per column"""
    rows: tuple[float, ...] = quantity((0.125, -0.31), unit="1/px", low=-0.5, high=0.5)
    """its cycles per row"""

    def __post_init__(self) -> None:
        if not len(self.rms) == len(self.columns) == len(self.rows):
            raise InputError(
                "rms, columns and rows: of different lengths; give one value of each per tone"
            )

    def read_variance(self, detector: SimulatedDetector) -> float:
        return float(np.square(self.rms).sum())

    def readout(self, adu: F32, shot: Shot) -> F32:
        y, x = np.arange(*shot.rows), np.arange(adu.shape[1])
        phases = shot.rng(self.name).uniform(0, 2 * np.pi, len(self.rms))
        size = np.sqrt(2) * np.array(self.rms) / shot.bench.detector.gain_e_per_adu
        down = y[:, None] * (2 * np.pi * np.array(self.rows)) + phases
        along = np.array(self.columns)[:, None] * (2 * np.pi * x)
        samples = adu.copy()
        add_waves(turns(down) * size.astype(np.float32), turns(along), samples)
        return samples

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """Tones of differences of frames without light, one after another."""
        noise = _noise(evidence)
        if noise is None:
            return None
        frames, good = noise
        rest, tones = frames, np.zeros((0, 2))
        ordinates, sigmas = _search(frames)
        first, significance = ordinates[:1], float(sigmas[0])
        while sigmas[0] > SIGNIFICANT and len(tones) < _MOST:
            before = len(tones)
            for tone in ordinates[sigmas > SIGNIFICANT][: _MOST - before]:
                new = _refined(rest, tone)
                if _apart(new, tones, frames.shape):
                    tones = np.concatenate([tones, new[None]])
            if len(tones) == before:
                break
            rest = (frames - _drawn(_sizes(frames, good, tones), tones, frames.shape)) * good
            ordinates, sigmas = _search(rest)
        tones = tones if len(tones) else first
        size, number = _sizes(frames, good, tones), np.count_nonzero(good)
        white = 2 * float(np.square(_without_lines(rest)).sum()) / len(frames) / number**2
        power = np.maximum((np.abs(size) ** 2).mean(axis=0) / 2 - white, 0.0)
        # Two waves of random phases, whose difference this is, add up by chance.
        variance = (power**2 / 2 + 2 * power * white + white**2) / len(frames)
        order = np.argsort(-power)
        rms, tones, variance = np.sqrt(power[order]), tones[order], variance[order]
        errors = np.sqrt(variance) / np.maximum(2 * rms, variance**0.25)
        total = float(np.sqrt(power.sum()))
        many = "a tone" if len(rms) == 1 else f"{len(rms)} tones, the strongest"
        return Estimate(
            cls(*(tuple(map(float, values)) for values in (rms, tones[:, 1], tones[:, 0]))),
            {f"rms[{n}]": float(e) for n, e in enumerate(errors)},
            significance,
            "tones in the differences of two frames",
            size={
                "value": total,
                "error": float(np.sqrt(variance.sum())) / max(2 * total, float(errors[0])),
                "unit": "e-",
                "of": f"rms in {many} of period {1 / np.hypot(*tones[0]):.3g} px",
            },
        )

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        noise = _noise(evidence)
        return None if noise is None else float(_search(noise[0])[1][0])


def _noise(evidence: Evidence) -> tuple[F32, Mask] | None:
    """Differences of frames (t, y, x) over root two, e-, without what all pixels share."""
    # Zero in bad pixels. None without two frames of a kind whose noise spans a step.
    middle = tuple(slice(max((n - _SIDE) // 2, 0), (n + _SIDE) // 2) for n in evidence.good.shape)
    good = evidence.good[middle]
    if min(good.shape) < _LEAST or not evidence.dithered:
        return None
    some: list[F32] = []
    for stack in evidence.stacks:
        if stack.kind in ("bias", "dark"):
            adu = stack.adu[:, *middle].astype(np.float32)
            count = len(adu) // 2 * 2
            for step in (adu[1:count:2] - adu[:count:2]) * np.float32(evidence.gain / 2**0.5):
                noise = np.where(good, step - step[good].mean(), np.float32(0))
                # Root mean squares, as medians of integers are quantised.
                noise[np.abs(noise) > _WILD * np.sqrt(np.square(noise).mean())] = 0
                if noise.any():
                    some.append(noise)
    return (np.stack(some[:_FRAMES]), good) if some else None


def _without_lines(frames: F32) -> F32:
    """Frames (t, y, x) without what rows and columns share."""
    rest = frames - frames.mean(axis=1, keepdims=True)
    return np.asarray(rest - rest.mean(axis=2, keepdims=True))


def _search(frames: F32) -> tuple[F64, F64]:
    """Strongest modes (n, 2), cycles per row and column, and the significance of each, falling."""
    count, ny, nx = frames.shape
    spectra = rfft2(frames)
    power = spectra.real**2 + spectra.imag**2
    # Rows share noise that would give frames other weights.
    rest = np.square(_without_lines(frames)).sum(axis=(1, 2), keepdims=True)
    power = (power / rest).mean(axis=0, dtype=float)
    # The two halves of the first column are the same.
    down = np.abs(np.fft.fftfreq(ny)) * ny
    slow = np.flatnonzero(down < _DRIFTS)
    half = (ny + 1) // 2
    of_rows = np.pad(_over_next_highest(power[:half, 0]), (0, ny - half))
    of_columns = np.array([_over_next_highest(row) for row in power[slow]])
    # Outputs that share noise have columns of modes with more of it, at all frequencies.
    fast = power[:, _SLOW:]
    fast /= np.maximum(_surroundings(fast, _AROUND), np.median(fast, axis=0))
    power[:, :_SLOW] /= _surroundings(power[:, :_SLOW], _AROUND_SLOW)
    power[down < _STEPS, :_DRIFTS] = 0
    power[slow] = of_columns
    power[:, 0] = of_rows
    if nx % 2 == 0:
        # The two halves of this column are the same.
        power[ny // 2 + 1 :, -1] = 0
    peaks = power == maximum_filter(power, 3, mode=("wrap", "nearest"))
    peaks &= power >= _NEARLY * power.max()
    at = np.argwhere(peaks)
    at = at[np.argsort(-power[*at.T])][:_AT_ONCE]
    # An ordinate over its median has Wilson and Hilferty's distribution (1931).
    ninth = 1 / (9 * count)
    normals = (np.cbrt(power[*at.T]) - 1) * (1 - ninth) / np.sqrt(ninth)
    sigmas = [sigmas_of_largest(float(z), (ny - 1) * (nx // 2)) for z in normals]
    return np.stack([np.fft.fftfreq(ny)[at[:, 0]], at[:, 1] / nx], axis=1), np.array(sigmas)


def _over_next_highest(power: F64) -> F64:
    """Modes (n,) along one axis over the mean of those within an octave; zero for no tone."""
    # The highest modes are differences of even and odd lines.
    ratios, end = np.zeros(len(power)), len(power) - 2
    for k in range(_FIRST, end):
        about = np.concatenate([power[k // 2 : k - 1], power[k + 2 : min(2 * k, end) + 1]])
        # All but one: hum has a harmonic.
        top = int(about.argmax())
        others = np.delete(about, range(max(top - 1, 0), min(top + 2, len(about))))
        if power[k] > _STANDS_OUT * others.max():
            ratios[k] = power[k] / about.mean()
    return ratios


def _surroundings(power: F64, size: tuple[int, int]) -> F64:
    """Median of the modes (y, x) of each block of a size, at every mode."""
    size = min(size[0], power.shape[0]), min(size[1], power.shape[1])
    (ny, nx), (height, width) = (n // m for n, m in zip(power.shape, size, strict=True)), size
    inside = power[: ny * height, : nx * width].reshape(ny, height, nx, width)
    medians = np.median(inside, axis=(1, 3))
    # The last modes belong to the last whole block.
    y = np.minimum(np.arange(power.shape[0]) // height, ny - 1)
    x = np.minimum(np.arange(power.shape[1]) // width, nx - 1)
    return np.asarray(np.maximum(medians, 1e-30)[np.ix_(y, x)])


def _refined(frames: F32, tone: F64) -> F64:
    """Frequencies of the highest power about a mode."""
    _, ny, nx = frames.shape
    bins = np.array([1 / ny, 1 / nx])

    def loss(shift: F64) -> float:
        fy, fx = tone + shift * bins
        along = frames @ _wave(-fx, np.arange(nx)).astype(np.complex64)
        return -float((np.abs(along @ _wave(-fy, np.arange(ny))) ** 2).sum())

    start = np.array([[0.0, 0.0], [0.3, 0.0], [0.0, 0.3]])
    options = {"initial_simplex": start, "xatol": 0.01, "fatol": np.inf, "maxiter": 40}
    shift = minimize(loss, start[0], method="Nelder-Mead", options=options).x
    fy, fx = tone + np.clip(shift, -1, 1) * bins
    # The wave is the same with both frequencies of opposite sign, or whole cycles more.
    fy, fx = (fy, fx) if 0 <= fx <= 0.5 else (-fy, fx % -1 * -1)
    return np.array([(fy + 0.5) % 1 - 0.5, fx])


def _apart(tone: F64, others: F64, shape: tuple[int, ...]) -> bool:
    """Whether a tone is resolved from others and from their mirror images."""
    same = np.concatenate([others, -others, [0, 1] - others])
    away = np.hypot(*((same - tone) * shape[1:]).T)
    return bool((away > _DISTINCT).all())


def _wave(frequency: float | F64, at: I64) -> C128:
    return np.asarray(np.exp(2j * np.pi * frequency * at))


def _sizes(frames: F32, good: Mask, tones: F64) -> C128:
    """Amplitudes (t, n) of tones in each frame, least squares for evenly spread bad pixels."""
    _, ny, nx = frames.shape
    down, along = (_wave(f[:, None], np.arange(n)) for f, n in zip(tones.T, (ny, nx), strict=True))
    products = np.einsum("tyn,ny->nt", frames @ along.conj().T, down.conj())
    share = np.count_nonzero(good) / good.size / 2
    same = share * (down.conj() @ down.T) * (along.conj() @ along.T)
    opposite = share * ((down @ down.T) * (along @ along.T)).conj()
    real = np.block(
        [
            [same.real + opposite.real, opposite.imag - same.imag],
            [same.imag + opposite.imag, same.real - opposite.real],
        ]
    )
    amplitudes = np.linalg.lstsq(real, np.concatenate([products.real, products.imag]))[0]
    return np.asarray((amplitudes[: len(tones)] + 1j * amplitudes[len(tones) :]).T)


def _drawn(size: C128, tones: F64, shape: tuple[int, ...]) -> F32:
    """Frames (t, y, x) of tones of these amplitudes."""
    down, along = (_wave(f[:, None], np.arange(n)) for f, n in zip(tones.T, shape[1:], strict=True))
    return np.asarray(((size[:, None] * down.T) @ along).real, np.float32)
