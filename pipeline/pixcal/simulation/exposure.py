"""From a bench to samples, with effects between the steps.

States of the frames and maps of the pixels → mean electrons → charge (shot noise, full well) →
signal → ADU → codes. Noise is keyed by frame and place, so a piece of frames and rows does not
depend on how the work is divided. Rows around a piece or preceding frames that an effect needs are
computed again.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TypeVar

import numpy as np

from pixcal.kernels import synthesis
from pixcal.kernels.beams import Beam, Light, LightMaps, with_margin
from pixcal.kernels.normals import Key, pixel_normals
from pixcal.kernels.scene import (
    DetectorMaps,
    FrameStates,
    Rows,
    detector_maps,
    frame_states,
    fringe_light,
)
from pixcal.model.arrays import F32, U16
from pixcal.model.bench import Bench
from pixcal.simulation.forward import ForwardModel
from pixcal.simulation.memory import Carried
from pixcal.simulation.recording import Recording
from pixcal.simulation.shot import Shot

K = TypeVar("K", tuple[int, int], tuple[int, str])


class Camera:
    """A range of rows (first, one after the last) of a bench with its effects.

    Samples do not depend on the range. ``maps``: of the whole window, instead of those of the
    bench.
    """

    def __init__(
        self,
        bench: Bench,
        rows: Rows,
        effects: Sequence[ForwardModel] = (),
        *,
        maps: DetectorMaps | None = None,
        noise: bool = True,
    ) -> None:
        self.bench = bench if noise else replace(bench, shot_noise=False)
        self.noise = noise
        self.effects = sorted((e for e in effects if not e.is_null), key=lambda e: e.sort_key)
        halo = sum(e.halo for e in self.effects)
        self.inside = rows
        self.rows: Rows = (max(0, rows[0] - halo), min(bench.detector.shape[0], rows[1] + halo))
        self.maps = detector_maps(bench.detector, self.rows) if maps is None else maps.on(self.rows)
        for effect in self.effects:
            self.maps = effect.detector(self.maps, bench, self.rows)
        self.carried = {n: Carried(e, n) for n, e in enumerate(self.effects) if e.memory}

    def expose(self, recording: Recording, frames: Iterable[int]) -> Iterator[tuple[int, U16]]:
        """Frames of these numbers as read out: number and samples, ADU (array reused)."""
        chain = _Chain(self, recording)
        for frame in frames:
            yield frame, chain.samples(frame)[self.kept]

    def analogue(self, recording: Recording, frames: Iterable[int]) -> Iterator[F32]:
        """Frames before the converter: float32 (y, x), ADU; a new array for each."""
        chain = _Chain(self, recording)
        for frame in frames:
            yield chain.adu(frame)[self.kept]

    @property
    def kept(self) -> slice:
        """The requested rows among the computed ones."""
        return slice(self.inside[0] - self.rows[0], self.inside[1] - self.rows[0])

    def light(self, recording: Recording) -> LightMaps:
        """Mean and fringe amplitude of a recording on these and surrounding rows, e-."""
        return _Chain(self, recording).light


class _Latest(dict[K, F32]):
    """Arrays of the last few frames, by a key that begins with the frame; drops earliest first."""

    def __init__(self, most: int) -> None:
        super().__init__()
        self._most = most

    def keep(self, key: K, array: F32) -> None:
        """Put an array in."""
        while len(self) >= self._most:
            del self[min(self)]
        self[key] = array


class _Chain:
    """The steps of one recording on the rows of a camera."""

    def __init__(self, camera: Camera, recording: Recording) -> None:
        self.camera, self.recording = camera, recording
        self.effects = camera.effects
        d = camera.bench.detector
        self.dark = camera.maps.dark_rate * np.float32(recording.exptime_s)
        self.well = np.inf if d.full_well_e is None else d.full_well_e
        back = [e.frames_kept for e in self.effects if e.frames_kept]
        # Of a frame and preceding ones, each before and after the effect that uses them.
        self._charges = _Latest[tuple[int, int]](2 * max(back, default=1))
        self._kept_normals = _Latest[tuple[int, str]](sum(back))
        self._margins: dict[int, tuple[LightMaps, F32]] = {}
        self._noise: tuple[int, F32] | None = None
        self._samples = np.empty(self.dark.shape, np.uint16)

    @cached_property
    def _before(self) -> "_Chain | None":
        """The recording before this one."""
        before = self.recording.before
        return None if before is None else _Chain(self.camera, before)

    def of(self, frame: int) -> "tuple[_Chain, int]":
        """The chain of a frame and its number there, including frames of earlier recordings."""
        chain = self
        while frame < 0 and chain._before is not None:
            chain = chain._before
            frame += chain.recording.count
        return chain, frame

    @cached_property
    def states(self) -> FrameStates:
        return states_of(self.recording, self.effects)

    @cached_property
    def light(self) -> LightMaps:
        r, maps, rows = self.recording, self.camera.maps, self.camera.rows
        if r.kind == "fringes":
            light = fringe_light(r.bench, r.number, rows, maps, r.electrons)
        else:
            light = Light((Beam(np.full((1, 1), np.sqrt(r.electrons)), 0.0),))
        for effect in self.effects:
            light = effect.light(light, r, rows, maps)
        collected = light.collected(maps.response)
        for effect in self.effects:
            collected = effect.pixels(collected, r, rows, maps)
        return collected

    def mean(self, frame: int, upto: int) -> F32:
        """Mean electrons after the first ``upto`` effects."""
        mean = self._illuminated(self.light, frame, np.empty_like(self.dark))
        for at, effect in enumerate(self.effects[:upto]):
            mean = effect.photons(mean, Shot(self, frame, at))
        return mean

    def _illuminated(self, light: LightMaps, frame: int, out: F32, reach: int = 0) -> F32:
        """Write mean electrons of a frame with a margin to an array, before effects on photons."""
        states, shape = self.states, self.camera.bench.detector.shape
        columns, lines = states.turns(frame, shape, self.camera.rows, reach)
        synthesis.illuminate(
            light.iota,
            light.alpha_sin,
            light.alpha_cos,
            states.level[frame],
            states.amplitude[frame],
            columns,
            lines,
            out,
        )
        return out

    def beyond(self, frame: int, reach: int) -> F32:
        """Mean charge of a frame around the computed rows; undefined inside them."""
        if reach not in self._margins:
            self._margins[reach] = with_margin(self.light, reach), np.pad(self.dark, reach, "edge")
        light, dark = self._margins[reach]
        wide = self._illuminated(light, frame, np.empty_like(dark), reach)
        return np.asarray(np.minimum(wide + dark, np.float32(self.well)))

    def charge(self, frame: int, upto: int) -> F32:
        """Charge after all effects on light and the first ``upto`` effects on charge."""
        key = (frame, upto)
        if key in self._charges:
            return self._charges[key]
        bench = self.camera.bench
        charge = np.empty_like(self.dark)
        light = self.mean(frame, len(self.effects))
        shot = self._normals(frame)[0]
        synthesis.collect(light, self.dark, shot, bench.shot_noise, self.well, charge)
        for at, effect in enumerate(self.effects[:upto]):
            if at in self.camera.carried:
                charge = self.camera.carried[at].charge(charge, self, frame)
                continue
            if effect.frames_back:
                self._charges.keep((frame, at), charge)
            charge = effect.charge(charge, Shot(self, frame, at))
        self._charges.keep(key, charge)
        return charge

    def normals(self, effect: str, frame: int, *, keep: bool) -> F32:
        """Standard normals of an effect in a frame; cached for effects that reuse them."""
        key = (frame, effect)
        if key in self._kept_normals:
            return self._kept_normals[key]
        drawn: F32 = self._drawn(self.recording.effect_key(effect), frame)[0]
        if keep:
            self._kept_normals.keep(key, drawn)
        return drawn

    def samples(self, frame: int) -> U16:
        """Codes of a frame."""
        d = self.camera.bench.detector
        synthesis.convert(self.adu(frame), d.step_adu, d.lowest_adu, d.top_adu, self._samples)
        return self._samples

    def adu(self, frame: int) -> F32:
        """Samples of a frame before they are rounded, ADU."""
        signal = self.charge(frame, len(self.effects)).copy()
        for at, effect in enumerate(self.effects):
            signal = effect.signal(signal, Shot(self, frame, at))
        adu = np.empty_like(signal)
        read = self._normals(frame)[1]
        maps = self.camera.maps
        synthesis.amplify(signal, maps.bias, read, maps.read_noise, maps.adu_per_e, adu)
        for at, effect in enumerate(self.effects):
            adu = effect.readout(adu, Shot(self, frame, at))
        return adu

    def _normals(self, frame: int) -> F32:
        """Standard normals (2, y, x) of shot and read noise of a frame; made once for both."""
        if not self.camera.noise:
            return np.zeros((2, *self.dark.shape), np.float32)
        if self._noise is None or self._noise[0] != frame:
            self._noise = frame, self._drawn(self.recording.noise_key, frame)
        return self._noise[1]

    def _drawn(self, key: Key, frame: int) -> F32:
        """Two arrays of standard normals (2, y, x) on the computed rows."""
        return pixel_normals(key, frame, self.camera.rows, self.dark.shape[1])


def states_of(recording: Recording, effects: Sequence[ForwardModel]) -> FrameStates:
    """States of the frames of a recording; effects act on those of fringes only."""
    if recording.kind != "fringes":
        still, steady = np.zeros(recording.count), np.ones(recording.count)
        return FrameStates(phi=still, level=steady, amplitude=still, dkx=still, dky=still)
    states = frame_states(recording.bench, recording.number)
    for effect in effects:
        states = effect.states(states, recording)
    return states
