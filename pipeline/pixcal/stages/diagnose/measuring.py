"""The nominal bench is measured: on a part of an acquisition, or several, of the same pixels."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

from pixcal.estimators.evidence import Evidence, FringeEvidence
from pixcal.estimators.structure import smooth_surface
from pixcal.estimators.wander import wander_of
from pixcal.kernels.processes import ramp_step
from pixcal.kernels.scene import DetectorMaps
from pixcal.model.acquisition import Acquisition
from pixcal.stages import reduce
from pixcal.stages.diagnose.description import bench_of, recordings_of
from pixcal.stages.diagnose.nominal import FittedSet, Measured, NominalBench, SetTruth
from pixcal.stages.diagnose.parts import Half, Table

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

HOT = 40.0
"""Robust standard deviations of the dark current beyond which a pixel is hot."""
HOT_REACH = 2
"""Pixels around a hot one that may have got some of its charge: at most a share of `SHARED`."""
SHARED = 0.1


def nominal_bench(
    acquisition: Acquisition,
    tables: Mapping[str, Table],
    evidence: Sequence[Evidence],
    halves: Sequence[Half],
    whole: tuple[int, int],
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
    whole : (int, int)
        Rows and columns of the detector's window.
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
    bench = bench_of(acquisition, tables, one, whole, sets, dtypes)
    recordings, places = recordings_of(bench, acquisition, tables, one)
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
