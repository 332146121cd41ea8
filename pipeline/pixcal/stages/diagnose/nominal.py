"""The nominal bench of an acquisition: the paper's simple simulation, with what was measured in it.

Straight fringes with one fringe vector a set, constant intensity and visibility, a linear detector
whose pixels and frames know nothing of each other, shot and read noise; bias, dark current, flat
and offsets as measured. Offsets keep everything that true ones can have; fringes, rows or columns
that repeat, and bending are taken out of them, for no foundry makes these: they are what a
simulation must bring about by some effect.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from pixcal.estimators.corrected import corrected_offsets, phase_change, straight_modes
from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.structure import Offsets, smooth_surface, true_offsets
from pixcal.estimators.wander import Wander, wander_of
from pixcal.kernels.crosstalk import filled
from pixcal.kernels.processes import ramp_step
from pixcal.kernels.scene import DetectorMaps, FrameStates, LightMaps, Rows
from pixcal.model.acquisition import Acquisition
from pixcal.model.bench import (
    SCHEMA,
    Bench,
    Rung,
    SimulatedDetector,
    SimulatedFrames,
    SimulatedOptics,
    SimulatedSet,
)
from pixcal.model.errors import InputError
from pixcal.simulation.effect import Effect, FringeMaps, Stage
from pixcal.simulation.exposure import Camera
from pixcal.simulation.recording import Recording
from pixcal.stages import reduce
from pixcal.stages.diagnose.parts import Half, Raw, Table, groups, select

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

HOT = 40.0
"""Robust standard deviations of the dark current beyond which a pixel is hot."""
HOT_REACH = 2
"""Pixels around a hot one that may have got some of its charge: at most a share of `SHARED`."""
SHARED = 0.1


@dataclass(frozen=True)
class SetTruth:
    """One fringe set of the nominal bench.

    Attributes
    ----------
    light : (y, x) float32
        Mean, for unit response, e-.
    contrast : float
        Fringe amplitude over the mean.
    psi : (y, x) float64
        Phase of the pixels if they had no offsets, rad.
    k : (float, float)
        Fringe vector, rad/px.
    step : float
        Of a ramp of the phase, rad; zero: random phases.
    wander : Wander
        What a ramp's phases are besides.
    """

    light: F32
    contrast: float
    psi: F64
    k: tuple[float, float]
    step: float
    wander: Wander

    def phase(self, delta_x: F32, delta_y: F32) -> F64:
        """Phase (y, x) of the pixels at their offsets (px), rad."""
        return np.asarray(self.psi + self.k[0] * delta_x + self.k[1] * delta_y)


@dataclass(frozen=True)
class Measured(Effect):
    """What was measured on a bench, in place of what a bench file describes."""

    name = " measured"
    title = "as measured"
    stage = Stage.LIGHT
    domains = ()
    strengths = ()
    sources = ()

    maps: DetectorMaps
    sets: tuple[SetTruth, ...]

    @property
    def is_null(self) -> bool:
        """Never."""
        return False

    def detector(self, maps: DetectorMaps, bench: Bench, rows: Rows) -> DetectorMaps:
        """As in `Effect.detector`."""
        m, own = self.maps, slice(*rows)
        return DetectorMaps(
            m.delta_x[own], m.delta_y[own], m.response[own], m.bias[own], m.dark_rate[own],
            m.mask[own],
        )  # fmt: skip

    def light(
        self, light: LightMaps, recording: Recording, rows: Rows, maps: DetectorMaps
    ) -> LightMaps:
        """As in `Effect.light`."""
        if recording.kind != "fringes":
            return light
        own, cut = self.sets[recording.number], slice(*rows)
        psi = own.phase(self.maps.delta_x, self.maps.delta_y)[cut]
        iota = maps.response * own.light[cut]
        alpha = np.float32(own.contrast) * iota
        return LightMaps(
            iota,
            (alpha * np.sin(psi)).astype(np.float32),
            (alpha * np.cos(psi)).astype(np.float32),
        )

    def states(self, states: FrameStates, recording: Recording) -> FrameStates:
        """As in `Effect.states`."""
        own, count = self.sets[recording.number], recording.count
        if own.step:
            command = own.step * np.arange(count, dtype=np.float64)
            phi = command + own.wander.drawn(command, recording.rng(self.name))
        else:
            phi = 2 * np.pi * recording.rng(self.name).random(count)
        still = np.zeros(count)
        return FrameStates(phi, np.ones(count), np.ones(count), still, still)


@dataclass(frozen=True)
class FittedSet:
    """What was fitted of a fringe set.

    Attributes
    ----------
    theta : (3, y, x) float64
        NaN in bad pixels.
    delta, sigma : (y, x) float64
        Offset and its error, px; NaN in bad pixels.
    k : (float, float)
        rad/px.
    origin : (int, int)
    flat : (y, x) float64, optional
    """

    theta: F64
    delta: F64
    sigma: F64
    k: tuple[float, float]
    origin: tuple[int, int]
    flat: F64 | None = None

    def without(self, effects: Sequence[Effect]) -> "FittedSet":
        """The same with effects undone that act on maps: offsets as fitted with them known."""
        maps = before = FringeMaps(filled(self.theta, self.k), self.k, self.origin, self.flat)
        for effect in sorted(effects, key=lambda e: (e.stage, e.name), reverse=True):
            maps = effect.undo(maps) or maps
        if maps is before:
            return replace(self, flat=None)
        size = float(np.hypot(*self.k))
        delta = corrected_offsets(
            self.delta,
            self.sigma,
            phase_change(before.theta, maps.theta),
            straight_modes(before.theta, self.k),
            size,
        )
        return replace(self, delta=delta, flat=maps.flat)

    @cached_property
    def offsets(self) -> Offsets:
        """Offsets that can be true."""
        return true_offsets(self.delta, self.sigma, np.arctan2(*filled(self.theta, self.k)[1:]))


@dataclass(frozen=True)
class NominalBench:
    """An acquisition's nominal bench, ready to take the same frames again.

    Attributes
    ----------
    acquisition : Acquisition
    tables : mapping
        Of all frames, as in ``frames.json``.
    reduction : reduce.Config
    dtypes : mapping
        Of the samples of each array.
    bench : Bench
        Geometry and what effects ask for.
    measured : Measured
        Without offsets.
    fits : tuple of FittedSet
        What was fitted of each fringe set.
    recordings : tuple of Recording
        In the order of their arrays; one for each exposure time of calibration frames.
    places : tuple of (str, int array)
        Array of each recording and the numbers of its frames there.
    """

    acquisition: Acquisition
    tables: Mapping[str, Table]
    reduction: reduce.Config
    dtypes: Mapping[str, np.dtype[Any]]
    bench: Bench
    measured: Measured
    fits: tuple[FittedSet, ...]
    recordings: tuple[Recording, ...]
    places: tuple[tuple[str, NDArray[np.intp]], ...]

    def simulate(
        self, half: Half, effects: Sequence[Effect], seed: int, *, fitted: bool = True
    ) -> Raw:
        """Frames of a half of the acquisition, from this bench with some effects.

        Parameters
        ----------
        half : Half
        effects : sequence of Effect
        seed : int
            Of everything random; the same seed gives the same noise with other effects.
        fitted : bool
            The measured maps have the effects in them, which are undone before they act anew.

        Raises
        ------
        InputError
            If an effect and the bench do not go together.
        """
        detector = replace(self.bench.detector, seed=seed)
        bench = replace(self.bench, seed=seed, detector=detector)
        for effect in effects:
            effect.check(bench)
        camera = Camera(
            bench,
            (0, bench.detector.shape[0]),
            [self._drawn(effects if fitted else (), seed), *effects],
        )
        arrays = {
            name: np.empty((len(frames), *bench.detector.shape), self.dtypes[name])
            for name, frames in half.frames.items()
        }
        for recording, (name, numbers) in zip(self.recordings, self.places, strict=True):
            wanted = np.flatnonzero(np.isin(numbers, half.frames[name]))
            own = replace(recording, bench=bench)
            for first, after in _runs(wanted):
                for frame, samples in camera.expose(own, range(first, after)):
                    at = int(np.searchsorted(half.frames[name], numbers[frame]))
                    arrays[name][at] = samples
        return Raw(self.acquisition, arrays, select(self.tables, half), self.reduction)

    def _drawn(self, effects: Sequence[Effect], seed: int) -> Measured:
        """As measured, with offsets that can be true where the effects are what they are."""
        if not self.fits:
            return self.measured
        fits = [fit.without(effects) for fit in self.fits]
        directions = np.stack([np.array(fit.k) / np.hypot(*fit.k) for fit in fits])
        # Sets along one axis see the same offsets.
        along = [
            fit.offsets.drawn(np.random.default_rng([seed, int(abs(dy) > abs(dx))]))
            for fit, (dx, dy) in zip(fits, directions, strict=True)
        ]
        delta = np.tensordot(np.linalg.pinv(directions), np.stack(along), 1).astype(np.float32)
        maps = replace(self.measured.maps, delta_x=delta[0], delta_y=delta[1])
        if fits[0].flat is not None:
            maps = replace(maps, response=np.maximum(fits[0].flat, 0).astype(np.float32))
        return replace(self.measured, maps=maps)


def _runs(numbers: NDArray[np.intp]) -> list[tuple[int, int]]:
    """Ranges (first, one after the last) of numbers that follow one another."""
    if not len(numbers):
        return []
    cuts = np.flatnonzero(np.diff(numbers) > 1) + 1
    return [(int(run[0]), int(run[-1]) + 1) for run in np.split(numbers, cuts)]


def nominal_bench(
    acquisition: Acquisition,
    tables: Mapping[str, Table],
    evidence: Sequence[Evidence],
    halves: Sequence[Half],
    reduction: reduce.Config,
    dtypes: Mapping[str, np.dtype[Any]],
) -> NominalBench:
    """The nominal bench that was measured by several parts of an acquisition.

    Parameters
    ----------
    acquisition : Acquisition
    tables : mapping
        Of all frames.
    evidence : sequence of Evidence
        Of the same pixels, e.g. two halves of the frames.
    halves : sequence of Half
        The frames of each.
    reduction : reduce.Config
    dtypes : mapping
        Of the samples of each array.

    Raises
    ------
    InputError
        If the light goes beyond what a converter of 16 bits can give.
    """
    one = evidence[0]
    good = np.all([e.good for e in evidence], axis=0)
    names = list(one.fringes)
    with_flats = "flat" in tables
    flat = _mean([e.flat for e in evidence]) if with_flats else _response_of_fringes(evidence)
    sets = tuple(
        _set_truth(
            [e.fringes[name] for e in evidence],
            [half.frames[f"fringes/{name}"] for half in halves],
            len(tables[f"fringes/{name}"]["time_s"]),
        )
        for name in names
    )
    known = flat.astype(float) if with_flats else None
    fits = tuple(_fitted([e.fringes[name] for e in evidence], one.origin, known) for name in names)
    maps = DetectorMaps(
        delta_x=np.zeros(good.shape, np.float32),
        delta_y=np.zeros(good.shape, np.float32),
        response=flat,
        bias=_mean([e.bias for e in evidence]),
        dark_rate=np.maximum(_mean([_uncoupled(e.dark_rate) for e in evidence]), 0),
        mask=np.where(good, 0, 1).astype(np.uint8),
    )
    bench = _bench(acquisition, tables, one, sets, _top(acquisition, one, sets, dtypes))
    recordings, places = _recordings(bench, acquisition, tables, one)
    return NominalBench(
        acquisition,
        tables,
        reduction,
        dtypes,
        bench,
        Measured(maps, sets),
        fits,
        tuple(recordings),
        tuple(places),
    )


def _mean(maps: Sequence[F64]) -> F32:
    values = np.nan_to_num(np.mean(maps, axis=0), nan=1.0, posinf=1.0, neginf=1.0)
    return np.asarray(values, np.float32)


def _response_of_fringes(evidence: Sequence[Evidence]) -> F32:
    """Response as the light of the fringes shows it, where there are no flats.

    Its scatter is lessened by what is noise, for the simulation adds its own.
    """
    parts = []
    for one in evidence:
        for found in one.fringes.values():
            light = np.where(found.good, found.theta[0], np.nan)
            parts.append(light / smooth_surface(light, found.good))
    if len(parts) < 2:
        return np.ones(evidence[0].good.shape, np.float32)
    mean, seen = np.mean(parts, axis=0) - 1, float(np.nanvar(np.mean(parts, axis=0)))
    noise = float(np.nanmean(np.var(parts, axis=0, ddof=1))) / len(parts)
    true = np.sqrt(max(seen - noise, 0.0) / seen) if seen > 0 else 0.0
    return np.asarray(1 + true * np.nan_to_num(mean), np.float32)


def _fitted(
    found: Sequence[FringeEvidence], origin: tuple[int, int], flat: F64 | None
) -> FittedSet:
    one = found[0]
    good = np.all([f.good for f in found], axis=0)
    k = float(np.hypot(*one.k))
    # The scan starts anywhere: turn the others to the first before the mean is taken.
    phasors = [f.theta[2] + 1j * f.theta[1] for f in found]
    turned = [z * np.exp(-1j * np.angle(np.vdot(phasors[0][good], z[good]))) for z in phasors]
    z = np.mean(turned, axis=0)
    theta = np.stack([np.mean([f.theta[0] for f in found], axis=0), z.imag, z.real])
    delta = np.mean([f.delta for f in found], axis=0)
    sigma = np.sqrt(np.sum([f.sigma**2 for f in found], axis=0)) / len(found) / k
    bad = ~good
    return FittedSet(
        np.where(bad, np.nan, theta),
        np.where(bad, np.nan, delta),
        np.where(bad, np.nan, sigma),
        one.k,
        origin,
        flat,
    )


def _uncoupled(dark: F64) -> F64:
    """Dark current without what hot pixels may have given to their neighbours."""
    rest = dark - np.median(dark)
    spread = 1.4826 * float(np.median(np.abs(rest)))
    brightest = maximum_filter(rest, size=2 * HOT_REACH + 1, mode="nearest")
    beside = (brightest > HOT * spread) & (rest < SHARED * brightest)
    return np.where(beside, np.median(dark), dark)


def _set_truth(
    found: Sequence[FringeEvidence], frames: Sequence[NDArray[np.intp]], count: int
) -> SetTruth:
    """Straight, steady fringes with the offsets that can be true ones."""
    one = found[0]
    good = np.all([f.good for f in found], axis=0)
    iota = np.mean([f.theta[0] * np.mean(f.g[:, 0]) for f in found], axis=0)
    surface = smooth_surface(np.where(good, iota, np.nan), good)
    contrast = [
        np.nanmedian(np.where(good, np.hypot(*f.theta[1:]) / f.theta[0], np.nan))
        * np.median(np.hypot(f.g[:, 1], f.g[:, 2]) / f.g[:, 0])
        for f in found
    ]
    ny, nx = good.shape
    y, x = np.arange(ny)[:, None] - (ny - 1) / 2, np.arange(nx)[None, :] - (nx - 1) / 2
    plane = one.k[0] * x + one.k[1] * y
    phasor = np.where(good, (one.theta[2] + 1j * one.theta[1]) * np.exp(-1j * plane), 0)
    psi = plane + np.angle(phasor.sum())
    return SetTruth(
        light=np.maximum(surface, 0).astype(np.float32),
        contrast=float(np.mean(contrast)),
        psi=psi,
        k=one.k,
        step=ramp_step(one.phi),
        wander=wander_of(found, frames, count, ramp_step(one.phi)),
    )


def _recordings(
    bench: Bench, acquisition: Acquisition, tables: Mapping[str, Table], evidence: Evidence
) -> tuple[list[Recording], list[tuple[str, NDArray[np.intp]]]]:
    """Recordings, and where their frames are."""
    start = _start(tables)
    listed = {f"fringes/{s.name}": n for n, s in enumerate(acquisition.frames.fringes)}
    recordings, places = [], []
    for name, table in tables.items():
        exposures = np.array([np.nan if t is None else t for t in table["exptime_s"]], float)
        times = np.array(table["time_s"], float)
        kind = name.split("/")[0]
        own = [np.arange(len(times))] if name in listed else groups(exposures)
        for n, numbers in enumerate(own):
            exposure = float(exposures[numbers[0]])
            exposure = 0.0 if np.isnan(exposure) else exposure
            period = float(np.median(np.diff(times[numbers]))) if len(numbers) > 1 else exposure
            electrons = _level(evidence, exposure) if kind == "flat" else 1.0
            recordings.append(
                Recording(
                    bench, kind, listed.get(name, n), name, name, len(numbers), exposure,
                    start[name] + float(times[numbers[0]]), period, electrons,
                )
            )  # fmt: skip
            places.append((name, numbers))
    return recordings, places


def _start(tables: Mapping[str, Table]) -> dict[str, float]:
    """Time of each array's first frame after the first of all, s; in order where unknown."""
    stamps = {name: np.array(table["mjd"], float) for name, table in tables.items()}
    if all(np.isfinite(s).all() for s in stamps.values()):
        first = min(float(s.min()) for s in stamps.values())
        return {name: float(s[0] - first) * 86400 for name, s in stamps.items()}
    found, clock = {}, 0.0
    for name, table in tables.items():
        found[name] = clock
        clock += float(np.ptp(np.array(table["time_s"], float)))
    return found


def _level(evidence: Evidence, exposure: float) -> float:
    """Electrons of the flats of an exposure time, for unit response, without dark current."""
    for stack in evidence.of_kind("flat"):
        known = np.isfinite(stack.exptime_s)
        if (not known and exposure == 0) or (known and np.isclose(stack.exptime_s, exposure)):
            good = evidence.good & (evidence.flat > 0)
            light = (stack.adu.mean(axis=0) - evidence.bias)[good] * evidence.gain
            light = light - evidence.dark_rate[good] * exposure
            return float(np.median(light / evidence.flat[good]))
    return 1.0


def _top(
    acquisition: Acquisition,
    evidence: Evidence,
    sets: Sequence[SetTruth],
    dtypes: Mapping[str, np.dtype[Any]],
) -> float:
    """Highest sample, ADU."""
    ends = [np.iinfo(dtype).max for dtype in dtypes.values() if dtype.kind in "iu"]
    top = float(min([65535, *ends]))
    for truth in sets:
        peak = float(np.median(truth.light)) * (1 + truth.contrast) / evidence.gain
        if peak + float(np.median(evidence.bias)) > 65535:
            raise InputError(
                f"fringes reach {peak:.0f} ADU above the bias: samples above 65535 ADU cannot be "
                "simulated; diagnose frames of a converter of 16 bits"
            )
    return min(top, acquisition.detector.saturation_adu or top)


def _bench(
    acquisition: Acquisition,
    tables: Mapping[str, Table],
    evidence: Evidence,
    sets: Sequence[SetTruth],
    top: float,
) -> Bench:
    """What effects ask a bench for; its own pixels and light are replaced by `Measured`."""
    d, o, shape = acquisition.detector, acquisition.optics, evidence.good.shape
    window = next((f.window for f in evidence.fringes.values()), shape)
    listed = [f"fringes/{s.name}" for s in acquisition.frames.fringes]
    table = tables[listed[0]] if listed else next(iter(tables.values()))
    times = np.array(table["time_s"], float)
    exposure = max(float(table["exptime_s"][0] or 0.0), 1e-6)
    period = float(np.median(np.diff(times))) if len(times) > 1 else exposure
    contrast = [s.contrast for s in sets]
    return Bench(
        schema=SCHEMA,
        detector=SimulatedDetector(
            shape=(shape[0], shape[1]),
            pitch_um=d.pitch_um,
            gain_e_per_adu=evidence.gain,
            read_noise_e=evidence.read_noise,
            name=d.name,
            chip=(window[0], window[1]),
            origin_px=evidence.origin,
            saturation_adu=top,
            full_well_e=d.full_well_e,
            bias_adu=float(np.clip(np.median(evidence.bias), 0, top - 1)),
        ),
        optics=SimulatedOptics(
            wavelength_nm=o.wavelength_nm,
            distance_mm=o.distance_mm,
            beam_radius_mm=1e4,
            visibility=float(np.clip(np.mean(contrast), 0.01, 1.0)) if contrast else 1.0,
            fringes="straight",
        ),
        frames=SimulatedFrames(
            exptime_s=exposure,
            period_s=max(period, exposure),
            flats=(Rung(exposure, 1),),
            flat_rate_e_s=1.0,
            fringes=tuple(
                SimulatedSet(
                    name=s.name,
                    baseline_mm=s.baseline_mm,
                    count=len(tables[f"fringes/{s.name}"]["time_s"]),
                    peak_e=float(np.clip(np.max(truth.light) * (1 + truth.contrast), 1.0, 1e7)),
                )
                for s, truth in zip(acquisition.frames.fringes, sets, strict=True)
            ),
        ),
    )
