"""Frames of a bench made outside pixcal's own simulation, with effects of GalSim.

Nothing here is shared with `pixcal.simulation`, nor with `pixcal.kernels`, but the description of
the bench: a mistake that simulation and diagnosis had in common would show.

Sources: GalSim (Rowe et al. 2015, Astronomy and Computing 10, 121) and its detector effects;
`galsim.cdmodel` is the model of moving boundaries of Antilogus et al. 2014 as of Gruen et al. 2015
(JINST 10, C05032).
"""

import importlib
import importlib.util
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.model.bench import Bench
from pixcal.model.errors import InputError
from pixcal.simulation.recording import Recording

F64 = NDArray[np.float64]

FOREIGN = {
    "ipc": "Image.applyIPC",
    "nonlinearity": "Image.applyNonlinearity",
    "lag": "Image.applyPersistence",
    "brighter_fatter": "cdmodel.PowerLawCD",
    "quantisation": "Image.quantize",
}
"""Effects that GalSim has, and by what."""

_SHOT, _READ, _PHASES, _PIXELS = range(4)
LATER = 0.3
"""Share of what is left of a frame that comes out only with the frame after the next."""


def galsim_is_there() -> bool:
    """Whether GalSim is installed."""
    return importlib.util.find_spec("galsim") is not None


def _galsim() -> Any:
    try:
        return importlib.import_module("galsim")
    except ImportError as error:
        raise InputError(
            "part 5 of the examination needs GalSim; install it with 'pip install galsim'"
        ) from error


@dataclass(frozen=True)
class Pixels:
    """The detector, (y, x): offsets (px), response, bias (ADU), dark current (e-/s)."""

    delta_x: F64
    delta_y: F64
    response: F64
    bias: F64
    dark: F64


def pixels_of(bench: Bench) -> Pixels:
    """The detector, from its seed."""
    d = bench.detector
    rng = np.random.default_rng([d.seed, _PIXELS])
    hot = rng.random(d.shape) < d.hot_fraction
    return Pixels(
        delta_x=rng.normal(0, d.delta_rms_px, d.shape),
        delta_y=rng.normal(0, d.delta_rms_px, d.shape),
        response=rng.normal(1, d.prnu_rms, d.shape),
        bias=d.bias_adu
        + rng.normal(0, d.bias_pixel_rms_adu, d.shape)
        + rng.normal(0, d.bias_column_rms_adu, d.shape[1]),
        dark=np.where(hot, d.hot_rate_e_s * rng.uniform(0.5, 1.5, d.shape), d.dark_e_s),
    )


@dataclass(frozen=True)
class Elsewhere:
    """An effect of GalSim, as strong as the library's own of this name; nothing without a name.

    Attributes
    ----------
    effect : str
    strength : float
        In the unit of `pixcal.stages.blind.strengths.WAYS`.
    """

    effect: str = ""
    strength: float = 0.0

    def camera(self, bench: Bench, rows: tuple[int, int], _effects: object) -> "OtherCamera":
        """Some rows of a bench."""
        return OtherCamera(self, bench, rows)


@dataclass
class OtherCamera:
    """Frames of some rows; every frame is made as a whole, from random numbers of its own."""

    foreign: Elsewhere
    bench: Bench
    rows: tuple[int, int]
    _kept: dict[tuple[str, int], F64] = field(default_factory=dict)

    @cached_property
    def pixels(self) -> Pixels:
        """The whole detector."""
        return pixels_of(self.bench)

    def expose(
        self, recording: Recording, frames: range
    ) -> Iterator[tuple[int, NDArray[np.uint16]]]:
        """Numbers of the frames and their samples (y, x), ADU."""
        for frame in frames:
            yield frame, self._samples(recording, frame)[slice(*self.rows)]

    def _rng(self, recording: Recording, frame: int, what: int) -> np.random.Generator:
        name = zlib.crc32(recording.stem.encode())
        return np.random.default_rng([self.bench.seed, name, frame, what])

    def _light(self, r: Recording, frame: int) -> F64:
        """Mean electrons of a frame, of light alone."""
        d, o = self.bench.detector, self.bench.optics
        if r.kind == "flat":
            return self.pixels.response * (self.bench.frames.flat_rate_e_s or 0.0) * r.exptime_s
        if r.kind != "fringes":
            return np.zeros(d.shape)
        scan = self.bench.frames.fringes[r.number]
        ny, nx = d.shape
        x = np.arange(nx) - (nx - 1) / 2 + self.pixels.delta_x
        y = np.arange(ny)[:, None] - (ny - 1) / 2 + self.pixels.delta_y
        turn = 2 * np.pi * d.pitch_um * 1e-3 / (o.wavelength_nm * 1e-6 * o.distance_mm)
        phase = turn * (scan.baseline_mm[0] * x + scan.baseline_mm[1] * y) + self._phase(r, frame)
        radius = o.beam_radius_mm / (d.pitch_um * 1e-3)
        envelope = np.exp(-2 * (x**2 + y**2) / radius**2)
        mean = scan.peak_e / (1 + o.visibility)
        light: F64 = self.pixels.response * mean * envelope * (1 + o.visibility * np.cos(phase))
        return light

    def _phase(self, r: Recording, frame: int) -> float:
        scan = self.bench.frames.fringes[r.number]
        if scan.phase_law == "ramp":
            return scan.phase_step_rad * frame
        return float(self._rng(r, frame, _PHASES).uniform(0, 2 * np.pi))

    def _charge(self, r: Recording, frame: int) -> F64:
        """Collected electrons, pixels whose boundaries move included."""
        key = (r.stem, frame)
        if key not in self._kept:
            mean = self._light(r, frame) + self.pixels.dark * r.exptime_s
            charge = self._rng(r, frame, _SHOT).poisson(np.maximum(mean, 0)).astype(float)
            if self.foreign.effect == "brighter_fatter":
                charge = _deflected(charge, self.foreign.strength)
            full = self.bench.detector.full_well_e or np.inf
            while len(self._kept) > 3:
                self._kept.pop(next(iter(self._kept)))
            self._kept[key] = np.minimum(charge, full)
        return self._kept[key]

    def _samples(self, r: Recording, frame: int) -> NDArray[np.uint16]:
        d, s = self.bench.detector, self.foreign.strength
        signal = self._charge(r, frame)
        if self.foreign.effect == "lag":
            before = [self._charge(r, n) for n in (frame - 1, frame - 2) if n >= 0]
            signal = _persistent(signal * (1 - s), before, s)
        elif self.foreign.effect == "nonlinearity":
            signal = _bent(signal, s)
        elif self.foreign.effect == "ipc":
            signal = _coupled(signal, s)
        noise = self._rng(r, frame, _READ).normal(0, d.read_noise_e, d.shape)
        adu = self.pixels.bias + (signal + noise) / d.gain_e_per_adu
        step = 1 + s if self.foreign.effect == "quantisation" else 1.0
        codes = _rounded(adu, step) if self.foreign.effect else np.rint(adu)
        return np.clip(np.rint(codes), 0, d.top_adu).astype(np.uint16)


def _image(values: F64) -> Any:
    return _galsim().ImageD(np.ascontiguousarray(values))


def _deflected(charge: F64, shift: float) -> F64:
    """Boundaries that move by ``shift`` px an electron next to them, and less further away."""
    model = _galsim().cdmodel.PowerLawCD(
        2, shift, shift, shift / 8, shift / 8, shift / 8, shift / 8, 2.5
    )
    return np.array(model.applyForward(_image(charge)).array)


def _persistent(signal: F64, before: list[F64], share: float) -> F64:
    """Electrons that earlier frames, the last one first, left behind."""
    image = _image(signal)
    parts = [share * (1 - LATER), share * LATER][: len(before)]
    if before:
        image.applyPersistence([_image(b) for b in before], parts)
    return np.array(image.array)


def _bent(signal: F64, quadratic: float, level: float = 50_000.0) -> F64:
    """Response that falls short of a straight line by ``quadratic`` at ``level``."""
    image = _image(signal)
    image.applyNonlinearity(lambda x, beta: x - beta * x * x, quadratic / level)
    return np.array(image.array)


def _coupled(signal: F64, share: float) -> F64:
    """A share to the pixels above and below, half as much to the left and right."""
    kernel = np.array([[0, share, 0], [share / 2, 1 - 3 * share, share / 2], [0, share, 0]])
    image = _image(signal)
    image.applyIPC(_image(kernel), edge_treatment="extend")
    return np.array(image.array)


def _rounded(adu: F64, step: float) -> F64:
    """To multiples of a step."""
    image = _image(adu / step)
    image.quantize()
    return np.array(image.array) * step
