"""Measure the nominal bench on one or more parts of an acquisition, of the same pixels."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from pixcal.estimators.detector.amplifiers import relative_gain
from pixcal.estimators.detector.pixel_read_noise import PixelNoise
from pixcal.estimators.diagnosis.evidence import Evidence, FringeEvidence
from pixcal.estimators.maps.structure import flattened
from pixcal.estimators.maps.two_beams import contrast_surface, light_surface
from pixcal.estimators.test_statistics.fringe_set_data import FringeSetData
from pixcal.estimators.test_statistics.noise import jumping
from pixcal.kernels.medians import median_and_sigma, robust_sigma
from pixcal.kernels.processes import ramp_step
from pixcal.kernels.rounding import level_before_rounding
from pixcal.kernels.scene import DetectorMaps
from pixcal.model.arrays import F32, F64, Indices, Mask
from pixcal.simulation.fringe_maps import FittedFrames
from pixcal.stages.diagnose.description import SetTruth, bench_of, pedestal_of, recordings_of
from pixcal.stages.diagnose.fitted_set import FittedSet
from pixcal.stages.diagnose.flats import FlatLight, MeasuredGain
from pixcal.stages.diagnose.hot_pixels import uncoupled
from pixcal.stages.diagnose.nominal import Measured, NominalBench
from pixcal.stages.diagnose.parts import FrameSubset, RunFrames
from pixcal.stages.reduce.calibration import FLAT_FLOOR

MAX_GAIN_CHI2 = 10.0  # reduced chi-square of the photon transfer above which its gain is not used
CORE = 5.0  # robust standard deviations within which the scatter of the dark signal may be noise
_MOST_UNLIT = 0.5  # largest share of unlit pixels for which the lit ones set the light of flats


def nominal_bench(
    frames: RunFrames,
    evidence: Sequence[Evidence],
    halves: Sequence[FrameSubset],
    whole: tuple[int, int],
) -> NominalBench:
    """The nominal bench, from ``evidence`` of the same pixels of a ``whole`` window (y, x)."""
    one, tables, dtypes = evidence[0], frames.tables, frames.dtypes
    good = np.all([e.good for e in evidence], axis=0)
    names = list(one.fringes)
    with_flats = "flat" in tables
    flat = _mean([e.flat for e in evidence]) if with_flats else _response_of_fringes(evidence)
    sets = tuple(
        _set_truth(
            [e.fringes[name] for e in evidence],
            [half[f"fringes/{name}"] for half in halves],
            len(tables[f"fringes/{name}"]["time_s"]),
        )
        for name in names
    )
    known = flat.astype(float) if with_flats else None
    fits = tuple(_fitted(evidence, name, known) for name in names)
    maps = DetectorMaps(
        delta_x=np.zeros(good.shape, np.float32),
        delta_y=np.zeros(good.shape, np.float32),
        response=_unlit_stay_so(flat, good),
        bias=_bias_before_rounding(evidence, dtypes),
        dark_rate=_dark_rate(evidence, halves),
        read_noise=np.full(good.shape, one.amplifier_noise, np.float32),
        adu_per_e=np.full(good.shape, 1 / one.gain, np.float32),
        mask=np.where(good, 0, 1).astype(np.uint8),
    )
    bench = bench_of(frames.acquisition, tables, one, whole, sets, dtypes)
    recordings, places, light = recordings_of(bench, frames.acquisition, tables, evidence, halves)
    return NominalBench(
        frames,
        bench,
        Measured(maps, sets, FlatLight.of(evidence, light)),
        _pixel_noise(evidence, halves, good),
        _gain(evidence, flat.astype(float), good, with_flats),
        fits,
        pedestal_of(evidence, dtypes, bench.detector.step_adu),
        tuple(recordings),
        tuple(places),
    )


def _pixel_noise(
    evidence: Sequence[Evidence], halves: Sequence[FrameSubset], good: Mask
) -> PixelNoise | None:
    """Read noise of each pixel; None where rounding, or the lowest code, hides it."""
    one = evidence[0]
    if not one.dithered or one.lowest_adu is not None:
        return None
    # If frames are too few to split, every part holds the same ones.
    parts = evidence if parted("bias", halves) else evidence[:1]
    bias = [s.adu for e in parts for s in e.of_kind("bias") if len(s.adu) > 1]
    # Noise that jumps between levels is an effect; white noise belongs to the nominal detector.
    noisy = ~np.logical_or.reduce([jumping(frames) for frames in bias])
    return PixelNoise.of(bias, good, 1 - (one.amplifier_noise / one.read_noise) ** 2, noisy)


def parted(name: str, halves: Sequence[FrameSubset]) -> bool:
    """Whether the parts hold different frames of an array."""
    first, *others = (set(h.get(name, ())) for h in halves)
    return not any(first & other for other in others)


def _unlit_stay_so(flat: F32, good: Mask) -> F32:
    """Response, 0 in unlit pixels so that simulations mask them, unless most are unlit."""
    unlit = ~good & (flat <= FLAT_FLOOR)
    return np.where(unlit, np.float32(0), flat) if unlit.mean() < _MOST_UNLIT else flat


def _mean(maps: Sequence[F64]) -> F32:
    values = np.nan_to_num(np.mean(maps, axis=0), nan=1.0, posinf=1.0, neginf=1.0)
    return np.asarray(values, np.float32)


def _bias_before_rounding(evidence: Sequence[Evidence], dtypes: Mapping[str, np.dtype[Any]]) -> F32:
    """Bias (ADU) of the amplifier such that rounded samples have the measured mean."""
    mean = _mean([e.bias for e in evidence])
    if any(dtype.kind == "f" for dtype in dtypes.values()):
        return mean
    one = evidence[0]
    level = level_before_rounding(
        mean.astype(float) / one.step_adu, one.amplifier_noise / one.gain / one.step_adu
    )
    return np.asarray(level * one.step_adu, np.float32)


def _response_of_fringes(evidence: Sequence[Evidence]) -> F32:
    """Response from the mean light of the fringes, if there are no flats."""
    # Noise is removed from its scatter, because the simulation adds its own.
    parts = []
    for one in evidence:
        for fringes in one.fringes.values():
            light = np.where(fringes.good, fringes.theta[0], np.nan)
            contrast = contrast_surface(fringes.theta, fringes.good)
            parts.append(light / light_surface(light, contrast, fringes.good))
    if len(parts) < 2:
        return np.ones(evidence[0].good.shape, np.float32)
    mean, seen = np.mean(parts, axis=0) - 1, float(np.nanvar(np.mean(parts, axis=0)))
    noise = float(np.nanmean(np.var(parts, axis=0, ddof=1))) / len(parts)
    true = np.sqrt(max(seen - noise, 0.0) / seen) if seen > 0 else 0.0
    return np.asarray(1 + true * np.nan_to_num(mean), np.float32)


def _fitted(evidence: Sequence[Evidence], name: str, flat: F64 | None) -> FittedSet:
    parts = [e.fringes[name] for e in evidence]
    one, read_noise_e = parts[0], evidence[0].amplifier_noise
    good = np.all([f.good for f in parts], axis=0)
    k = float(np.hypot(*one.k))
    # The scan starts at an arbitrary phase: rotate the others to the first before averaging.
    phasors = [f.theta[2] + 1j * f.theta[1] for f in parts]
    turns = [np.angle(np.vdot(phasors[0][good], z[good])) for z in phasors]
    z = np.mean([z * np.exp(-1j * a) for z, a in zip(phasors, turns, strict=True)], axis=0)
    theta = np.stack([np.mean([f.theta[0] for f in parts], axis=0), z.imag, z.real])
    delta = np.mean([f.delta for f in parts], axis=0)
    sigma = np.sqrt(np.sum([f.sigma**2 for f in parts], axis=0)) / len(parts) / k
    sigma *= excess_scatter(parts, good)
    bad = ~good
    return FittedSet(
        np.where(bad, np.nan, theta),
        np.where(bad, np.nan, delta),
        np.where(bad, np.nan, sigma),
        one.k,
        evidence[0].origin,
        flat,
        one.name,
        frames=_frames(parts, turns, read_noise_e, evidence[0].origin[0]),
    )


def _frames(
    parts: Sequence[FringeEvidence], turns: Sequence[float], read_noise_e: float, first_row: int
) -> FittedFrames:
    """All frames, with their phases rotated like the maps."""
    wave = np.concatenate(
        [(f.g[:, 1] + 1j * f.g[:, 2]) * np.exp(1j * a) for f, a in zip(parts, turns, strict=True)]
    )
    g = np.stack([np.concatenate([f.g[:, 0] for f in parts]), wave.real, wave.imag], axis=1)
    g = g[np.argsort(np.concatenate([f.frame for f in parts]))]
    one = parts[0]
    period = float(np.median(np.diff(one.time_s))) if len(one.time_s) > 1 else 0.0
    rows = first_row, one.good.shape[0]
    free = any(bool(np.any(f.dk)) for f in parts)
    return FittedFrames(g, rows, read_noise_e, one.exptime_s, period, free)


def excess_scatter(parts: Sequence[FringeEvidence], good: Mask) -> float:
    """Scatter of offsets between independent frames over their errors, at least 1."""
    # A simulation must not contain frame-to-frame changes twice, as offsets and by the effect.
    k = float(np.hypot(*parts[0].k))
    most = 1.0
    for one, other in itertools.pairwise(parts):
        apart = flattened(np.where(good, one.delta - other.delta, np.nan))
        error = np.hypot(one.sigma, other.sigma)[good] / k
        most = max(most, median_and_sigma(apart[good] / error)[1])
    return most


def _dark_rate(evidence: Sequence[Evidence], halves: Sequence[FrameSubset]) -> F32:
    """Dark signal, e-/s, without the part of its scatter that is noise: simulations add it."""
    # The shot noise of what the camera subtracts stays; the simulation subtracts it again.
    rate = _mean([uncoupled(e.dark_rate, np.random.default_rng(0)) for e in evidence])
    rate += np.float32(evidence[0].subtracted_dark)
    separate = parted("bias", halves) and parted("dark", halves)
    noise = _rate_variance(evidence[0]) / (len(evidence) if separate else 1)
    rest = rate - np.median(rate)
    spread = robust_sigma(rest)
    core = np.abs(rest) <= CORE * spread
    true = np.sqrt(max(1 - noise / spread**2, 0.0)) if spread > 0 else 1.0
    centre = rate[core].mean()
    return np.maximum(np.where(core, centre + true * (rate - centre), rate), 0).astype(np.float32)


def _rate_variance(evidence: Evidence) -> float:
    """Noise variance of a pixel's dark signal, (e-/s)²."""
    stacks = [*evidence.of_kind("bias"), *evidence.of_kind("dark")]
    times = np.array([np.nan_to_num(s.exptime_s) for s in stacks for _ in s.adu])
    if not len(times) or np.ptp(times) == 0:
        return 0.0
    charge = float(np.median(evidence.dark_charge_rate)) * times.max()
    return float((evidence.read_noise**2 + charge) / (len(times) * times.var()))


def _set_truth(parts: Sequence[FringeEvidence], frames: Sequence[Indices], count: int) -> SetTruth:
    """Straight, steady fringes of a set, as fitted."""
    one = parts[0]
    good = np.all([f.good for f in parts], axis=0)
    iota = np.mean([f.theta[0] * np.mean(f.g[:, 0]) for f in parts], axis=0)
    contrast = np.mean([contrast_surface(f.theta, good) for f in parts], axis=0)
    surface = light_surface(iota, contrast, good)
    contrast *= np.mean([np.median(np.hypot(*f.g.T[1:]) / f.g[:, 0]) for f in parts])
    ny, nx = good.shape
    y, x = np.arange(ny)[:, None] - (ny - 1) / 2, np.arange(nx)[None, :] - (nx - 1) / 2
    plane = one.k[0] * x + one.k[1] * y
    phasor = np.where(good, (one.theta[2] + 1j * one.theta[1]) * np.exp(-1j * plane), 0)
    psi = plane + np.angle(phasor.sum())
    return SetTruth(
        light=np.maximum(surface, 0).astype(np.float32),
        contrast=np.clip(contrast, 0, 1).astype(np.float32),
        psi=psi,
        k=one.k,
        step=ramp_step(one.phi),
        phi=_phases(parts, frames, count),
    )


def _phases(parts: Sequence[FringeEvidence], frames: Sequence[Indices], count: int) -> F64:
    """Phase (t,) of every frame of a set, counted from the first part's maps; NaN where unknown."""
    phi = np.full(count, np.nan)
    first = parts[0].theta[2] + 1j * parts[0].theta[1]
    for one, numbers in zip(parts, frames, strict=True):
        both = parts[0].good & one.good
        z = one.theta[2] + 1j * one.theta[1]
        phi[numbers] = one.phi + np.angle(np.vdot(first[both], z[both]))
    return phi


def _gain(evidence: Sequence[Evidence], flat: F64, good: Mask, with_flats: bool) -> MeasuredGain:
    """Gain from flats and declared value, and of each amplifier if flats show steps."""
    amplifiers = np.ones(good.shape)
    # mean squared residual over shot and read variance
    noise = [FringeSetData(one, e).moments[0] for e in evidence for one in e.fringes.values()]
    if with_flats and noise:
        amplifiers = relative_gain(flat, np.mean(noise, axis=0), good)
    gains = [(one.gain, *one.photon_transfer) for one in evidence]
    return MeasuredGain(
        amplifiers,
        tuple(
            (value / used, error / used)
            for used, value, error, chi2 in gains
            if np.isfinite(value) and error > 0 and chi2 < MAX_GAIN_CHI2
        ),
        tuple(sorted({lag for e in evidence for lag in e.neighbours})),
    )
