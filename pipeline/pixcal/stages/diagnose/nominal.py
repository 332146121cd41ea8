"""The nominal bench of an acquisition: an ordinary bench with properties measured on its frames.

It has straight fringes with one fringe vector per set, two beams, constant intensity and
visibility, the measured phases, and a linear detector without coupling. All else is as measured
(docs/explanation/diagnosis.md). Each simulation draws uncertain quantities within their errors.
Fringes, repeating rows or columns, and curvature are removed from the offsets, because no foundry
makes them: only an effect may produce them in a simulation.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.detector.pixel_read_noise import PixelNoise
from pixcal.estimators.fringe_fit.fringes import grid
from pixcal.kernels.beams import Light
from pixcal.kernels.scene import DetectorMaps, FrameStates, Rows
from pixcal.model.arrays import F32, Indices
from pixcal.model.bench import Bench
from pixcal.simulation.effect import Effect
from pixcal.simulation.exposure import Camera
from pixcal.simulation.recording import SEEDS_APART, Recording
from pixcal.simulation.replica import TOP_ADU, OfAcquisition
from pixcal.simulation.shot import Shot
from pixcal.stages.diagnose.description import SetTruth
from pixcal.stages.diagnose.fitted_set import FittedSet
from pixcal.stages.diagnose.flats import FlatLight, MeasuredGain, photon_transfer_change
from pixcal.stages.diagnose.hot_pixels import uncoupled
from pixcal.stages.diagnose.parts import FrameSubset, RawFrames, RunFrames

_GAIN, _NOISE, _DARK = 101, 102, 103  # keys of random numbers
_WHITE = 1e-3  # least share of the variance of the read noise that effects leave
_ROWS = 8  # in the middle, on which the mean charge left by earlier frames is computed


@dataclass(frozen=True)
class Measured(OfAcquisition):
    """Light and pixels of an acquisition, as measured."""

    name = " measured"
    title = "as measured"

    sets: tuple[SetTruth, ...]
    lamp: FlatLight = FlatLight()

    def light(self, light: Light, recording: Recording, rows: Rows, maps: DetectorMaps) -> Light:
        """As in `Effect.light`."""
        if recording.kind != "fringes":
            return light
        truth, cut = self.sets[recording.number], slice(*rows)
        psi = truth.phase(self.maps.delta_x, self.maps.delta_y)[cut]
        iota = truth.light[cut].astype(float)
        return Light.of_fringes(iota, truth.contrast[cut] * iota * np.exp(1j * psi))

    def photons(self, mean: F32, shot: Shot) -> F32:
        """As in `Effect.photons`."""
        if shot.recording.kind != "flat":
            return mean
        return mean * np.float32(self.lamp.factor(shot.recording, shot.frame))

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """As in `Effect.states`."""
        truth, count = self.sets[recording.number], recording.count
        drawn = 2 * np.pi * recording.rng(self.name).random(count)
        phi = np.where(np.isnan(truth.phi), drawn, truth.phi)
        still = np.zeros(count)
        return FrameStates(phi, np.ones(count), np.ones(count), still, still)


@dataclass(frozen=True)
class NominalBench:
    """An acquisition's nominal bench, to simulate the same frames."""

    frames: RunFrames
    bench: Bench  # geometry and other properties that effects use
    measured: Measured  # without offsets
    noise: PixelNoise | None  # read noise of the pixels
    gain: MeasuredGain
    fits: tuple[FittedSet, ...]  # fitted quantities of each fringe set
    # pedestal (ADU) of the samples in the simulated converter, which has no negative codes
    pedestal: int
    # in the order of the arrays; one for each exposure time of calibration frames
    recordings: tuple[Recording, ...]
    # array of each recording and the numbers of its frames there
    places: tuple[tuple[str, Indices], ...]

    def simulate(
        self, half: FrameSubset, effects: Sequence[Effect], seed: int, *, window: int = 0
    ) -> RawFrames:
        """Simulate a half of the acquisition's frames with this bench and given effects.

        Effects are undone on the measured maps, which contain them, before they act. ``seed``: of
        everything random. ``window``: number of the window, for independent pixel noise.
        """
        measured, bench, taken = self._prepared(effects, seed, window)
        camera = Camera(bench, self._rows, [measured, *effects], maps=measured.maps)
        arrays = {
            name: np.empty((len(frames), *bench.detector.shape), self.frames.dtypes[name])
            for name, frames in half.items()
        }
        for recording, name, wanted, at in self._of_half(half, taken):
            for (_, samples), place in zip(camera.expose(recording, wanted), at, strict=True):
                arrays[name][place] = self._as_recorded(
                    samples, recording.exptime_s, bench.detector.top_adu, name
                )
        return self.frames.raw(arrays, half)

    def without(self, raw: RawFrames, half: FrameSubset, effects: Sequence[Effect]) -> RawFrames:
        """A half of the frames, less what effects change in them without noise."""
        measured, bench, taken = self._prepared(effects, 0, 0)
        with_effects, free = (
            Camera(bench, self._rows, [measured, *acting], maps=measured.maps, noise=False)
            for acting in (effects, ())
        )
        arrays = {name: samples.copy() for name, samples in raw.arrays.items()}
        top, step = self.bench.detector.top_adu, self.bench.detector.step_adu
        for recording, name, wanted, at in self._of_half(half, taken):
            kind = arrays[name].dtype
            each = with_effects.analogue(recording, wanted), free.analogue(recording, wanted), at
            for one, other, place in zip(*each, strict=True):
                before = arrays[name][place]
                clean = before - (one - other)
                if kind.kind != "f":
                    clean = np.clip(step * np.rint(clean / step), np.iinfo(kind).min, top)
                arrays[name][place] = np.where(before < top, clean, before)
        return replace(raw, arrays=arrays)

    @property
    def _rows(self) -> Rows:
        return 0, self.bench.detector.shape[0]

    def _of_half(
        self, half: FrameSubset, taken: dict[tuple[int, int], Recording]
    ) -> Iterator[tuple[Recording, str, list[int], list[int]]]:
        """Recordings, their arrays, and their frames of a half: in the recording, in the array."""
        for recording, (name, numbers) in zip(self.recordings, self.places, strict=True):
            wanted = np.flatnonzero(np.isin(numbers, half[name]))
            at = np.searchsorted(half[name], numbers[wanted])
            yield taken[recording.key], name, wanted.tolist(), at.tolist()

    def _prepared(
        self, effects: Sequence[Effect], seed: int, window: int
    ) -> tuple[Measured, Bench, dict[tuple[int, int], Recording]]:
        """Light and pixels before the effects, the bench, and its recordings, by their keys."""
        own_seed = seed + SEEDS_APART * window
        detector = replace(
            self.bench.detector,
            seed=own_seed,
            saturation_adu=min(self.bench.detector.top_adu + self.pedestal, TOP_ADU),
        )
        bench = replace(self.bench, seed=seed, detector=detector)
        for effect in effects:
            effect.check(bench)
        measured = self._drawn(effects, own_seed)
        if effects:
            measured = self._of_measured_k(measured, bench, effects)
        change = photon_transfer_change(
            bench, measured, effects, self.recordings, self.gain.neighbours, measured.maps
        )
        measured = self._electronics(measured, (seed, own_seed), change, effects)
        levels = measured.lamp.levels(self.recordings, effects, self.bench.detector)
        own_key = {r.key: r for r in self.recordings}

        def with_earlier(r: Recording) -> Recording:
            before = None if r.before is None else with_earlier(own_key[r.before.key])
            lit = levels.get(r.number, r.electrons) if r.kind == "flat" else r.electrons
            return replace(r, bench=bench, window=window, before=before, electrons=lit)

        taken = {r.key: with_earlier(r) for r in self.recordings}
        measured = _without_late_charge(measured, effects, bench, list(taken.values()))
        return measured, bench, taken

    def _as_recorded(
        self, samples: NDArray[np.uint16], exptime_s: float, top_adu: float, name: str
    ) -> F32:
        """Samples without the pedestal, and without dark signal that the camera subtracts."""
        recorded = samples - np.float32(self.pedestal)
        black = self.frames.black
        if black is None or not black.subtracted:
            return recorded
        # In whole steps of the converter; saturated samples stay so.
        step = self.bench.detector.step_adu
        lost = step * round(black.subtracted * exptime_s / step)
        full = samples >= top_adu
        dtype = self.frames.dtypes[name]
        lowest = -np.inf if dtype.kind == "f" else float(np.iinfo(dtype).min)
        return np.where(full, recorded, np.maximum(recorded - lost, np.float32(lowest)))

    def _of_measured_k(
        self, measured: Measured, bench: Bench, effects: Sequence[Effect]
    ) -> Measured:
        """The bench whose fringe vectors equal the measured ones after effects have acted."""
        # The phase common to all pixels is kept too: with shifted fringes, the same seed would give
        # different noise.
        rows = (0, bench.detector.shape[0])
        before, after = (
            Camera(bench, rows, acting, maps=measured.maps)
            for acting in ([measured], [measured, *effects])
        )
        sets = list(measured.sets)
        for recording in self.recordings:
            if recording.kind == "fringes":
                scan = replace(recording, bench=bench)
                turn = after.light(scan).phasor * before.light(scan).phasor.conj()
                y, x = grid(turn.shape)
                dky = np.angle(np.sum(turn[1:] * turn[:-1].conj()))
                dkx = np.angle(np.sum(turn[:, 1:] * turn[:, :-1].conj()))
                n = recording.number
                truth, (kx, ky) = sets[n], sets[n].k
                tilt = dkx * x + dky * y
                tilt = tilt + np.angle(np.sum(turn * np.exp(-1j * tilt)))
                # Offsets are included, because effects use them as positions.
                sets[n] = replace(truth, psi=truth.psi - tilt, k=(kx - dkx, ky - dky))
        return replace(measured, sets=tuple(sets))

    def _electronics(
        self, measured: Measured, seeds: tuple[int, int], change: float, effects: Sequence[Effect]
    ) -> Measured:
        """With gain and read noise drawn within their errors; samples keep their level."""
        seed, own_seed = seeds
        gain = self.gain.drawn(np.random.default_rng([seed, _GAIN]), change)
        m = measured.maps
        m = replace(m, bias=m.bias + np.float32(self.pedestal))
        noise = m.read_noise
        if self.noise is not None:
            factor = self.noise.drawn(np.random.default_rng([own_seed, _NOISE]))
            for effect in effects:
                factor[effect.noisy_pixels(self.bench.detector)] = 1
            noise = noise * factor
        square = noise**2
        # Part of the measured variance that effects add.
        added = sum(effect.read_variance(self.bench.detector) for effect in effects)
        noise = np.sqrt(np.maximum(square - np.float32(added), _WHITE * square)) * gain
        maps = replace(
            m,
            response=m.response * gain,
            dark_rate=uncoupled(m.dark_rate, np.random.default_rng([own_seed, _DARK])) * gain,
            read_noise=noise,
            adu_per_e=m.adu_per_e / gain,
        )
        return replace(measured, maps=maps)

    def _drawn(self, effects: Sequence[Effect], seed: int) -> Measured:
        """As measured, with offsets drawn from those possible given the effects."""
        if not self.fits:
            return self.measured
        fits = [fit.without(effects) for fit in self.fits]
        directions = np.stack([np.array(fit.k) / np.hypot(*fit.k) for fit in fits])
        # Sets along one axis measure the same offsets.
        along = [
            fit.offsets.drawn(np.random.default_rng([seed, int(abs(dy) > abs(dx))]))
            for fit, (dx, dy) in zip(fits, directions, strict=True)
        ]
        delta = np.tensordot(np.linalg.pinv(directions), np.stack(along), 1).astype(np.float32)
        maps = replace(self.measured.maps, delta_x=delta[0], delta_y=delta[1])
        if fits[0].flat is not None:
            maps = replace(maps, response=np.maximum(fits[0].flat, 0).astype(np.float32))
        # Light and contrast before the effects, which reduce them again in the simulation.
        sets = tuple(
            replace(
                truth,
                light=truth.light * fit.light,
                contrast=np.minimum(truth.contrast * fit.contrast, np.float32(1)),
            )
            for truth, fit in zip(self.measured.sets, fits, strict=True)
        )
        return replace(self.measured, maps=maps, sets=sets)


def _without_late_charge(
    measured: Measured, effects: Sequence[Effect], bench: Bench, recordings: Sequence[Recording]
) -> Measured:
    """As measured, without the mean dark signal that effects add from frames before the darks."""
    dark = [r for r in recordings if r.kind == "dark" and r.before is not None and r.exptime_s > 0]
    if not dark or not any(effect.frames_back for effect in effects):
        return measured
    middle, total, seconds = bench.detector.shape[0] // 2, 0.0, 0.0
    rows = max(middle - _ROWS // 2, 0), min(middle + _ROWS // 2, bench.detector.shape[0])
    with_effects, without = (
        Camera(bench, rows, [measured, *acting], maps=measured.maps, noise=False)
        for acting in (effects, [e for e in effects if not e.frames_back])
    )
    for recording in dark:
        frames = list(range(recording.count))
        late, plain = (camera.analogue(recording, frames) for camera in (with_effects, without))
        total += sum(float((a - b).mean()) for a, b in zip(late, plain, strict=True))
        seconds += recording.count * recording.exptime_s
    electrons = total / float(measured.maps.adu_per_e.mean())
    rate = measured.maps.dark_rate - np.float32(electrons / seconds)
    return replace(measured, maps=replace(measured.maps, dark_rate=np.maximum(rate, 0)))
