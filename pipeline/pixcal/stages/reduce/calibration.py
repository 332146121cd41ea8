"""The calibration maps of ``RUN/reduce``, made from the statistics of the frames.

First the medians over the whole detector, then, by columns of chunks, the maps in electrons and the
flags of outlying pixels.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.estimators.detector.bad_pixels import dead, hot, noisy, noisy_factor, variance_nearby
from pixcal.estimators.detector.calibration import usual_variance
from pixcal.kernels.medians import median_and_sigma
from pixcal.model.arrays import F32, F64, U8
from pixcal.model.flags import PixelFlag
from pixcal.stages import tiles
from pixcal.stages.reduce.measuring import STATISTICS, Measuring
from pixcal.stages.tiles import STRIP, Index, Strip
from pixcal.storage.cube import ArrayWriter, create_array, create_group
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.place import Place

_SAMPLES = 1 << 20
_MIN_READ_FRAMES = 8  # fewest to measure the noise of each pixel; else that of the detector is used
FLAT_FLOOR = 0.05  # least relative response in the map, which pixels without light have
# weight of the detector's read variance relative to a pixel's own, in degrees of freedom, for read
# noise that differs by 13 % rms among pixels. A few frames alone would give good pixels wrong
# weights, and at low light a chi-square that flags them.
_PRIOR_DOF = 30

# attributes of a mask by the CF conventions
FLAG_ATTRS = {
    "long_name": "why a pixel is not to be used",
    "flag_masks": [int(flag) for flag in PixelFlag],
    "flag_meanings": " ".join(str(flag.name).lower() for flag in PixelFlag),
}

_MAPS: dict[str, tuple[Any, dict[str, Any]]] = {
    "bias": (np.float32, {"units": "adu", "long_name": "signal at exposure zero"}),
    "dark_rate": (np.float32, {"units": "electron s-1", "long_name": "dark signal"}),
    "flat": (np.float32, {"units": "1", "long_name": "response over the median response"}),
    "read_noise": (np.float32, {"units": "electron", "long_name": "read noise, rms"}),
    "mask": (np.uint8, FLAG_ATTRS),
}


@dataclass(frozen=True)
class Usual:
    """Typical values over the detector."""

    # response, response_error: median response of the flats and its error for one pixel, relative
    # to the mean light of the detector; NaN without flats
    response: float
    response_error: float
    # dark_rate, dark_rate_sigma: median and robust spread of the dark signal (ADU/s)
    dark_rate: float
    dark_rate_sigma: float
    dark_variance: float  # variance of a sample without light and without dark signal (ADU²)
    bias: float  # median (ADU)
    noisy: float  # factor of the typical noise above which a pixel is noisy


def on_grid(
    folder: Place, shape: tuple[int, int], names: Sequence[str], light: F64 | None = None
) -> F64:
    """Maps that `measure` wrote, (name, pixel), of at most a million pixels on a regular grid.

    ``names``: of `STATISTICS`. ``light``: of each tile, a factor on its response.
    """
    reader = ArrayReader(folder / "maps")
    stride = int(np.ceil(np.sqrt(shape[0] * shape[1] / _SAMPLES)))
    wanted = [STATISTICS.index(name) for name in names]
    parts = []
    for strip in tiles.strips(tiles.indices(shape), STRIP):
        blocks = tiles.by_column(reader.read((0, len(STATISTICS)), *tiles.span(shape, strip)))
        for index, block in zip(strip, blocks, strict=True):
            (y0, _), (x0, _) = tiles.extent(shape, index)
            some = block[wanted, -y0 % stride :: stride, -x0 % stride :: stride]
            part = some.reshape(len(wanted), -1).astype(float)
            if light is not None:
                part[[name.startswith("response") for name in names]] *= light[index]
            parts.append(part)
    return np.concatenate(parts, axis=1)


def usual(job: Measuring, folder: Place, light: F64) -> Usual:
    """Medians of the maps that `measure` wrote; ``light``: of each tile, relative to all."""
    names = ("response", "response_error", "dark_rate", "dark_variance", "dark_dof", "bias")
    response, error, rate, variance, dof, bias = on_grid(folder, job.shape, names, light)
    freedom = int(np.median(dof))
    return Usual(
        median_and_sigma(response[response > 0])[0],
        median_and_sigma(error[error > 0])[0],
        *median_and_sigma(rate),
        usual_variance(variance[dof > 0], freedom),
        median_and_sigma(bias)[0],
        noisy_factor(job.options.noisy_factor, variance[dof > 0], freedom, job.quantum),
    )


@dataclass(frozen=True)
class Finishing:
    """Input of the second task of a column."""

    measured: Measuring  # input of the first task
    statistics: Place  # what it wrote
    usual: Usual  # typical values over the detector
    light: F64  # light of each tile over that of the detector
    gain: float  # to use (e-/ADU)
    read_noise: float  # of the detector (e-)
    floor: float  # least read noise of a pixel (e-): the rounding of the converter
    writers: Mapping[str, ArrayWriter]  # arrays for the maps


def calibration_writers(folder: Place, shape: tuple[int, int]) -> dict[str, ArrayWriter]:
    """Make the arrays of ``calibration.zarr``."""
    create_group(folder, {"Conventions": "CF-1.11", "title": "calibration of the detector"})
    return {
        name: create_array(
            folder / name, shape, dtype, dims=("y", "x"), chunks=tiles.map_chunk(shape), attrs=a
        )
        for name, (dtype, a) in _MAPS.items()
    }


def finish(job: Finishing, strip: Strip) -> F64:
    """Write the calibration maps of `STRIP` columns.

    Returns (column, 4) over the good pixels: least and largest flat, largest bias (ADU) and dark
    signal (e-/s); infinity of the opposite sign without good pixels.
    """
    rows, columns = tiles.span(job.measured.shape, strip)
    block = ArrayReader(job.statistics / "maps").read((0, len(STATISTICS)), rows, columns)
    parts = [_maps(job, *one) for one in zip(strip, tiles.by_column(block), strict=True)]
    for name, writer in job.writers.items():
        data = np.concatenate([maps[name] for maps in parts], axis=1)
        writer.write((rows[0], columns[0]), data.astype(writer.dtype))
    return np.array([_ends(maps) for maps in parts])


def _maps(job: Finishing, index: Index, block: F32) -> dict[str, NDArray[Any]]:
    """Calibration maps (y, x) of a column, from what `measure` wrote."""
    stats = dict(zip(STATISTICS, block.astype(float), strict=True))
    flat = np.ones_like(stats["bias"])
    error = np.zeros_like(flat)
    if job.measured.flat:
        light = job.light[index] / job.usual.response
        flat, error = (light * stats[name] for name in ("response", "response_error"))
    mask = _flags(job, stats, flat, error)
    read = np.full_like(flat, job.read_noise)
    series = job.measured.read_series
    if series is not None and len(series.frames) >= _MIN_READ_FRAMES:
        variance, dof = job.gain**2 * np.maximum(stats["read_variance"], 0), len(series.frames) - 1
        shared = dof * variance + _PRIOR_DOF * job.read_noise**2
        of_pixel = np.sqrt(shared / (dof + _PRIOR_DOF))
        read = np.where(np.isfinite(of_pixel), np.maximum(of_pixel, job.floor), read)
    return {
        "bias": np.nan_to_num(stats["bias"]),
        "dark_rate": job.gain * np.nan_to_num(stats["dark_rate"]),
        "flat": np.where(np.isfinite(flat), np.maximum(flat, FLAT_FLOOR), 1.0),
        "read_noise": read,
        "mask": mask,
    }


def _ends(maps: Mapping[str, NDArray[Any]]) -> tuple[float, float, float, float]:
    """The four numbers that `finish` returns for a column."""
    good = maps["mask"] == 0
    if not good.any():
        return np.inf, -np.inf, -np.inf, -np.inf
    bias, rate, flat = (maps[name][good] for name in ("bias", "dark_rate", "flat"))
    return float(flat.min()), float(flat.max()), float(bias.max()), float(rate.max())


def _flags(job: Finishing, stats: Mapping[str, F64], flat: F64, error: F64) -> U8:
    mask = stats["flags"].astype(np.uint8)
    limits, medians = job.measured.options, job.usual
    # A level at the boundary of two codes gives either one, however low the noise.
    least = 3 * (job.floor / job.gain) ** 2
    warm = np.zeros(mask.shape, np.bool_)
    if len({group.exptime for group in job.measured.dark}) > 1:
        warm = hot(
            stats["dark_rate"], stats["dark_rate_error"], medians.dark_rate_sigma, limits.hot_sigma
        )
        mask[warm] |= np.uint8(PixelFlag.HOT)
    if job.measured.flat:
        told = mask & (PixelFlag.SATURATED | PixelFlag.NO_DATA) > 0
        mask[~np.isfinite(flat) & ~told] |= np.uint8(PixelFlag.NO_DATA)
        where = dead(flat, error, limits.dead_below, limits.dead_above, FLAT_FLOOR)
        # The response of a hot pixel that its dark signal fills is not known.
        mask[where & ~(warm & (flat > FLAT_FLOOR))] |= np.uint8(PixelFlag.DEAD)
    if np.isfinite(medians.dark_variance):
        variance, dof = stats["dark_variance"], stats["dark_dof"]
        where = noisy(
            variance,
            dof,
            variance_nearby(variance, dof, max(medians.dark_variance, least)),
            stats["kurtosis"],
            stats["outliers"],
            medians.noisy,
        )
        mask[where] |= np.uint8(PixelFlag.NOISY)
    return mask
