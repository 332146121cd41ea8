"""Properties of the nominal bench from flats: the light of their lamp, and the gain.

Lamps are never quite steady, and are not part of the detector. The gain is that of the flats and
the declared one together.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pixcal.estimators.detector.flat_ladder import flicker, ladder, rise_of, straight_line
from pixcal.estimators.detector.straightness import LAMP
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.kernels.gain_fit import LADDER
from pixcal.kernels.photon_transfer import LAGS, pair_statistics
from pixcal.kernels.scene import DetectorMaps
from pixcal.model.arrays import F32, F64
from pixcal.model.bench import Bench, SimulatedDetector
from pixcal.simulation.effect import Effect, Stage
from pixcal.simulation.exposure import Camera
from pixcal.simulation.forward import ForwardModel
from pixcal.simulation.recording import Recording
from pixcal.stages.diagnose.fitted_set import levels_before

SERIES = 8  # least frames of a series to use the measured light of each; otherwise it is drawn

_FLICKER, _RISE = 103, 104  # keys of random numbers
DECLARED_ERROR = 0.01  # least relative error of a declared gain
# Flats are simulated with and without effects, from the same random numbers, `FRAMES` at a time,
# until the relative change of their noise has this error or all flats are used.
FRAMES = 8
CHANGE_ERROR = 0.003
# least ratio of shot to read variance in a flat that shows how effects change the shot noise: with
# the same random numbers the read noise cancels, and nonlinearity is small at low levels
LIT = 0.5
# steps whose effects change the noise of flats differently from a gain
OF_NOISE = (Stage.CHARGE, Stage.SIGNAL, Stage.CONVERTER)


@dataclass(frozen=True)
class FlatLight:
    """Light of the flats."""

    # flicker, wander: relative rms from frame to frame, and of levels about a straight line in
    # exposure time
    flicker: float = 0.0
    wander: float = 0.0
    # relative rise of the light from frame to frame of each level, and its error
    rise: tuple[float, float] = (0.0, 0.0)
    # whether all levels are of one lamp; otherwise the measured levels are used
    one_lamp: bool = False
    off: frozenset[float] = frozenset()  # exposure times (s) of levels from another lamp
    freedom: float = math.inf  # degrees of freedom of ``flicker``
    # by the number of a recording, the light (t,) of each frame over the mean; NaN for frames that
    # are drawn: the first, which may lack charge left behind, and those not analysed
    frames: Mapping[int, F64] = field(default_factory=dict)
    # for the same recordings, the light of the first frame that the next ones let expect, and its
    # scatter over the flicker
    firsts: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, evidence: Sequence[Evidence], light: Mapping[int, F64]) -> "FlatLight":
        """From parts of the frames; ``light`` of frames (t,) by recording, NaN if not measured."""
        ladders = [ladder(one) for one in evidence]
        frames, firsts = {}, {}
        for number, values in light.items():
            if np.isfinite(values).sum() >= SERIES:
                frames[number] = values / np.nanmean(values)
                frames[number][0] = np.nan
                firsts[number] = _first(frames[number])
        flickers, freedoms = zip(*map(flicker, evidence), strict=True)
        return cls(
            float(np.mean(flickers)),
            float(np.mean([LAMP if one is None else one.wander for one in ladders])),
            # From all frames of a level: a part may have only two.
            rise_of(list(light.values())),
            all(one is not None for one in ladders),
            frozenset(float(t) for one in ladders if one is not None for t in one.off),
            min(freedoms),
            frames,
            firsts,
        )

    def factor(self, recording: Recording, frame: int) -> float:
        """Light of a frame over that of its recording."""
        level = 1.0
        if self.one_lamp and recording.exptime_s not in self.off:
            level += self.wander * float(recording.rng("lamp").standard_normal())
        known = self.frames.get(recording.number)
        if known is not None and np.isfinite(known[frame]):
            return level * float(known[frame])
        flicker = self._flicker(recording.bench.seed)
        if frame == 0 and recording.number in self.firsts:
            expected, scatter = self.firsts[recording.number]
            drawn = float(recording.rng("lamp", frame).standard_normal())
            return level * (expected + scatter * flicker * drawn)
        flicker *= float(recording.rng("lamp", frame).standard_normal())
        rise = self._rise(recording.bench.seed) * (frame - (recording.count - 1) / 2)
        return level * (1 + flicker + rise)

    def _rise(self, seed: int) -> float:
        """Rise of the light in a simulation, drawn within its error."""
        rise, error = self.rise
        return float(rise + error * np.random.default_rng([seed, _RISE]).standard_normal())

    def _flicker(self, seed: int) -> float:
        """Flicker in a simulation, drawn within its error."""
        if math.isinf(self.freedom):
            return self.flicker
        square = np.random.default_rng([seed, _FLICKER]).chisquare(self.freedom) / self.freedom
        return self.flicker / math.sqrt(square)

    def levels(
        self, recordings: Sequence[Recording], effects: Sequence[Effect], d: SimulatedDetector
    ) -> dict[int, float]:
        """Electrons of each flat, by number, before effects; linear in time if of one lamp."""
        flats = [r for r in recordings if r.kind == "flat" and r.electrons > 0]
        if not flats:
            return {}
        times = np.array([r.exptime_s for r in flats])
        levels = levels_before(np.array([r.electrons for r in flats]), effects)
        if self.one_lamp:
            below = levels < (d.top_adu - d.bias_adu) * d.gain_e_per_adu
            steady = np.isin(times, list(self.off), invert=True)
            below = below & steady if (below & steady).any() else steady
            levels = np.where(steady, straight_line(times[below], levels[below], times), levels)
        return {r.number: float(level) for r, level in zip(flats, levels, strict=True)}


def _first(light: F64) -> tuple[float, float]:
    """Light of frame 0 from a parabola through the next frames (t,), and its relative scatter."""
    time = np.flatnonzero(np.isfinite(light))[: SERIES - 1]
    design = np.vander(time, 3, increasing=True).astype(float)
    value = float(np.linalg.lstsq(design, light[time])[0][0])
    return value, float(np.sqrt(1 + np.linalg.inv(design.T @ design)[0, 0]))


@dataclass(frozen=True)
class MeasuredGain:
    """Gain of the amplifiers over the gain used to count electrons."""

    amplifiers: F64  # (y, x) of each pixel's amplifier over the detector's mean
    # gain by photon transfer, and its 1-sigma error, of each part of the flats
    transfer: tuple[tuple[float, float], ...] = ()
    # lags (rows, columns) whose covariances the photon transfer includes
    neighbours: tuple[tuple[int, int], ...] = ()

    def drawn(self, rng: np.random.Generator, change: float = 1.0) -> F32:
        """Gain (y, x) over the used gain, drawn within its error; ``change``: of flat variance."""
        measured = np.array([value * change for value, _ in self.transfer])
        errors = np.array([error for _, error in self.transfer])
        # The error of the declared gain is at least its difference from the flats.
        apart = abs(np.average(measured, weights=errors**-2.0) - 1) if self.transfer else 0.0
        values = np.array([1.0, *measured])
        weights = np.array([max(DECLARED_ERROR, apart), *errors]) ** -2.0
        common = np.average(values, weights=weights) + weights.sum() ** -0.5 * rng.standard_normal()
        return np.asarray(max(common, 0.1) * self.amplifiers, np.float32)


def photon_transfer_change(
    bench: Bench,
    measured: ForwardModel,
    effects: Sequence[Effect],
    recordings: Sequence[Recording],
    neighbours: Sequence[tuple[int, int]] = (),
    maps: DetectorMaps | None = None,
) -> float:
    """Factor by which effects change variance over mean of flats, lags included; 1 without any."""
    # The photon-transfer gain is off by the inverse; a simulation with the effects must not apply
    # it twice.
    flats = [r for r in recordings if r.kind == "flat" and r.electrons > 0 and r.count > 1]
    detector = bench.detector
    room = (detector.top_adu - detector.bias_adu) * detector.gain_e_per_adu
    flats = [r for r in flats if r.electrons < 0.8 * room]
    if not flats or not any(e.acts_at in OF_NOISE and not e.is_gain for e in effects):
        return 1.0
    if len(flats) < LADDER:
        flat = max(flats, key=lambda r: r.electrons)
    else:
        # Of several levels, use the dimmest with enough light: the gain is that at level zero.
        lit = [r for r in flats if r.electrons > LIT * detector.read_noise_e**2] or flats
        flat = min(lit, key=lambda r: r.electrons)
    flat = replace(flat, bench=bench)
    dark = [replace(r, bench=bench) for r in recordings if r.kind == "bias" and r.count > 1][:1]
    # In the middle: more pixels than a pair needs for this error would only take time.
    ny, nx = detector.shape
    count = min(math.ceil(2 / CHANGE_ERROR**2 / nx), ny)
    rows = (ny - count) // 2, (ny - count) // 2 + count
    cameras = [
        Camera(bench, rows, acting, maps=maps) for acting in ([measured], [measured, *effects])
    ]
    offsets = []
    for camera in cameras:
        some = [_pairs(camera, r, range(min(FRAMES, r.count)), 0.0, neighbours) for r in dark]
        offsets.append(some[0].mean(axis=1) if some else np.zeros(2))
    by_camera: list[list[F64]] = [[], []]
    for first in range(0, flat.count - 1, FRAMES):
        frames = range(first, min(first + FRAMES, flat.count))
        for camera, (offset, noise), ratios in zip(cameras, offsets, by_camera, strict=True):
            means, variances = _pairs(camera, flat, frames, offset, neighbours)
            ratios.append((variances - noise) / means)
        before, after = (np.concatenate(ratios) for ratios in by_camera)
        if min(before.mean(), after.mean()) <= 0:
            return 1.0
        error = (after - before).std(ddof=1) / np.sqrt(len(before)) if len(before) > 1 else 0.0
        if error < CHANGE_ERROR * before.mean():
            break
    return float(np.clip(after.mean() / before.mean(), 0.1, 10))


def _pairs(
    camera: Camera,
    recording: Recording,
    frames: range,
    offset: float,
    neighbours: Sequence[tuple[int, int]],
) -> F64:
    """Mean above an offset and variance (2, pair), ADU, of pairs of frames, as in `reduce`."""
    samples = np.stack([s.astype(np.float32) for _, s in camera.expose(recording, frames)])
    samples[:, camera.maps.mask[camera.kept] != 0] = np.nan
    detector = recording.bench.detector
    gain, lags = detector.gain_e_per_adu, [tuple(lag) for lag in LAGS.tolist()]
    shared = [3 + lags.index(lag) for lag in neighbours]
    pairs = []
    for n in range(0, len(samples) - 1, 2):
        pair = samples[n : n + 2]
        levels = np.nanmean(pair, axis=(1, 2), keepdims=True)
        level = float(levels.mean()) - offset
        blocks = pair_statistics(
            *(pair - levels + np.float32(level)),
            gain=gain,
            read_noise=detector.read_noise_e / gain,
            quantum=1.0,
        )
        dof, noise = blocks[:, 0], blocks[:, 2] + 2 * blocks[:, shared].sum(axis=1)
        pairs.append((level, dof @ noise / max(dof.sum(), 1.0)))
    return np.array(pairs).T
