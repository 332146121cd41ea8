"""Random telegraph noise: pixels whose level jumps between two values."""

from dataclasses import dataclass, replace
from functools import lru_cache, partial

import numpy as np

from pixcal.estimators.detector.telegraph.find import Telegraph, find_telegraph, significance
from pixcal.estimators.detector.telegraph.population import Stays
from pixcal.estimators.detector.telegraph.series import lit_series, pixel_series_of
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.scene import TILE, chip_map
from pixcal.kernels.synthesis import BLOCK_ROWS
from pixcal.model.arrays import F32, F64, U8, Indices, Mask
from pixcal.model.bench import SimulatedDetector
from pixcal.model.config import quantity
from pixcal.simulation.effect import Effect, Estimate, Stage
from pixcal.simulation.shot import Shot

_FRAMES_AT_ONCE = 256
_LAW = "amplitudes of a gamma distribution, all pixels equally often in the upper level"


@dataclass(frozen=True)
class MeasuredPixels:
    """Pixels of a part of the window whose levels were measured one by one."""

    rows: tuple[int, int] = quantity(doc="first row of the part, and the one after the last")
    columns: tuple[int, int] = quantity(doc="first column, and the one after the last")
    faintest: float = quantity(
        low=0, doc="smallest amplitude measured one by one, relative to the mean amplitude"
    )
    row: tuple[int, ...] = quantity(doc="row of each pixel")
    column: tuple[int, ...] = quantity(doc="column of each pixel")
    amplitude: tuple[float, ...] = quantity(
        doc="difference of its two levels, relative to the mean amplitude"
    )
    upper: tuple[float, ...] = quantity(doc="share of the time in its upper level")

    def within(
        self, origin: tuple[int, int], shape: tuple[int, ...]
    ) -> tuple[Indices, Indices, Indices]:
        """Which of the pixels are in a part of the chip, and their rows and columns there."""
        y, x = np.array(self.row, int) - origin[0], np.array(self.column, int) - origin[1]
        here = np.flatnonzero((y >= 0) & (y < shape[0]) & (x >= 0) & (x < shape[1]))
        return here, y[here], x[here]

    def __hash__(self) -> int:
        """Fast hash without the pixels' values, as it is needed in each frame."""
        return hash((self.rows, self.columns, self.faintest, len(self.row)))


@dataclass(frozen=True)
class TelegraphNoise(Effect):
    """Some pixels jump between two levels, as a trap fills and empties."""

    name = "telegraph_noise"
    title = "pixels that jump between two levels"
    acts_at = Stage.READOUT
    order = 1
    domains = ("noise",)
    strengths = ("amplitude_e",)
    left_because = "such pixels have larger errors, which SIGMA includes"
    frames_needed = ("dark",)
    remedy = "exclude the pixels flagged noisy, and take medians over frames"
    quick = False
    sources = (
        "Ozdogru et al. 2025, Proc. SPIE 13527, 135270V (arXiv:2505.24540): telegraph noise in 1 "
        "to 5 % of the pixels of two scientific CMOS cameras",
        "Janesick, Andrews and Elliott 2006, Proc. SPIE 6276: it limits the noise of CMOS arrays, "
        "and differs widely from pixel to pixel",
        "Chao et al. 2017, Sensors 17(12), 2704: amplitudes and time constants of 8.3 million "
        "pixels; the distribution of amplitudes has an exponential tail",
    )

    share: float = quantity(0.02, low=0, high=1)
    """share of the pixels with telegraph noise"""
    amplitude_e: float = quantity(30.0, unit="e-", low=0, high=1e6)
    """mean difference of the two levels"""
    switching_s: float = quantity(0.5, unit="s", low=0, high=1e6)
    """mean time in a level; 0: independent in each frame"""
    amplitude_shape: float = quantity(1.0, low=0.01, high=100)
    """shape of the gamma distribution of amplitudes; 1: exponential, large: equal amplitudes"""
    switching_decades: float = quantity(0.0, low=0, high=6)
    """range of the mean times over pixels, uniform in the logarithm; switching_s is the geometric
    mean"""
    upper: float = quantity(0.5, above=0, below=1)
    """share of the time in the upper level"""
    measured: tuple[MeasuredPixels, ...] = quantity(())
    """pixels with levels of their own"""

    def noisy_pixels(self, detector: SimulatedDetector) -> Mask:
        noisy = np.zeros(detector.shape, bool)
        for some in self.measured:
            noisy[some.within(detector.origin, detector.shape)[1:]] = True
        return noisy

    def readout(self, adu: F32, shot: Shot) -> F32:
        samples = adu.copy()
        detector, recording = shot.bench.detector, shot.recording
        stays = Stays(self.switching_s, self.switching_decades)
        first, last = shot.rows
        for block in range(first // BLOCK_ROWS, -(-last // BLOCK_ROWS)):
            rows, columns, amplitudes, places, upper = _pixels(
                detector, block, self.share, self.amplitude_shape, self.upper, self.measured
            )
            if not len(rows):
                continue
            seed = int(recording.pixel_rng(self.name, block).integers(1 << 62))
            keep = np.broadcast_to(stays.kept(recording.period_s, places), len(rows))
            states = _states(seed, recording.count, keep.tobytes(), upper.tobytes())
            up = np.unpackbits(states[shot.frame], count=len(rows))
            step = (up - upper) * amplitudes * np.float32(self.amplitude_e)
            inside = (rows >= first) & (rows < last)
            at = rows[inside] - first, columns[inside]
            samples[at] += step[inside] / np.float32(detector.gain_e_per_adu)
        return samples

    @classmethod
    def estimate(cls, evidence: Evidence) -> Estimate | None:
        """From pixels noisier than the rest, if the shape of their noise is telegraph noise."""
        series = pixel_series_of(evidence)
        if not series:
            return None
        # Pixels that the fit excluded for their noise.
        noisy = np.zeros(evidence.good.shape, bool)
        for fringes in evidence.fringes.values():
            noisy |= evidence.good & np.isfinite(fringes.theta).all(axis=0) & ~fringes.good
        telegraph = find_telegraph(series, partial(lit_series, evidence), np.flatnonzero(noisy))
        if telegraph is None:
            return None
        return _estimate(cls, telegraph, evidence)

    @classmethod
    def detect(cls, evidence: Evidence) -> float | None:
        return significance(pixel_series_of(evidence))


def _estimate(cls: type[TelegraphNoise], telegraph: Telegraph, evidence: Evidence) -> Estimate:
    by_law = cls(
        telegraph.share,
        telegraph.amplitude,
        telegraph.stays.mean_s,
        telegraph.shape,
        telegraph.stays.decades,
        telegraph.stays.upper,
    )
    effect, pixels = by_law, telegraph.own
    if pixels is not None and len(pixels.pixel):
        (y, x), (ny, nx) = evidence.origin, evidence.good.shape
        rows, columns = np.divmod(pixels.pixel, nx)
        measured = MeasuredPixels(
            (y, y + ny),
            (x, x + nx),
            telegraph.smallest_jump / telegraph.amplitude,
            tuple((y + rows).tolist()),
            tuple((x + columns).tolist()),
            tuple((pixels.amplitude / telegraph.amplitude).tolist()),
            tuple(pixels.upper.tolist()),
        )
        effect = replace(by_law, measured=(measured,))
    return Estimate(
        effect,
        {
            "share": telegraph.share_error,
            "amplitude_e": telegraph.amplitude_error,
            "switching_s": telegraph.switching_error,
        }
        | ({"amplitude_shape": telegraph.shape_error} if telegraph.shape_error else {}),
        telegraph.signs.significance,
        "noisy pixels have two levels or stay in one from frame to frame",
        law="" if effect == by_law else _LAW,
        by_law=None if effect == by_law else by_law,
    )


@lru_cache(maxsize=4)
def _pixels(
    detector: SimulatedDetector,
    block: int,
    share: float,
    shape: float,
    upper: float,
    measured: tuple[MeasuredPixels, ...],
) -> tuple[Indices, Indices, F32, F32, F32]:
    """Telegraph pixels of a block: rows, columns, amplitudes, dwell times, shares of time above."""
    rows = block * BLOCK_ROWS, min((block + 1) * BLOCK_ROWS, detector.shape[0])

    def draw(rng: np.random.Generator) -> F64:
        chance = rng.random(TILE)
        alike = rng.standard_gamma(shape, TILE) / shape if shape != 1 else None
        amplitude = rng.standard_exponential(TILE) if alike is None else alike
        return np.where(chance < share, amplitude, 0)

    amplitudes = chip_map(detector, rows, TelegraphNoise.name, draw)
    places = chip_map(detector, rows, f"{TelegraphNoise.name} stays", lambda rng: rng.random(TILE))
    uppers = np.full_like(amplitudes, upper)
    top, left = rows[0] + detector.origin[0], detector.origin[1]
    for some in measured:
        (y0, y1), (x0, x1) = some.rows, some.columns
        y0, y1, x0, x1 = np.maximum([y0 - top, y1 - top, x0 - left, x1 - left], 0)
        part = amplitudes[y0:y1, x0:x1]
        part[part >= some.faintest] = 0
        here, *at = some.within((top, left), amplitudes.shape)
        amplitudes[*at], uppers[*at] = np.array([some.amplitude, some.upper])[:, here]
    y, x = np.nonzero(amplitudes)
    return y + rows[0], x, amplitudes[y, x], places[y, x], uppers[y, x]


@lru_cache(maxsize=4)
def _states(seed: int, frames: int, kept: bytes, upper: bytes) -> U8:
    """Bits that are set for pixels in the upper level: (frame, pixel / 8)."""
    rng, keep, share = np.random.default_rng(seed), np.frombuffer(kept), np.frombuffer(upper, "f4")
    pixels = len(keep)
    up = np.zeros(pixels, bool)
    packed = []
    for first in range(0, frames, _FRAMES_AT_ONCE):
        count = min(_FRAMES_AT_ONCE, frames - first)
        drawn = rng.random((count, 2, pixels), np.float32)
        states = np.empty((count, pixels), bool)
        for n, (anew, coin) in enumerate(drawn):
            draw = anew >= keep if first + n else np.ones(pixels, bool)
            up = np.where(draw, coin < share, up)
            states[n] = up
        packed.append(np.packbits(states, axis=1))
    return np.concatenate(packed)
