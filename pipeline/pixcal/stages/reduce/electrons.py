"""Fringe frames in electrons: from ``raw.zarr`` to the datasets of ``reduced.zarr``."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels.quantise import FILL, Scale, coefficients, encode, extremes
from pixcal.model.flags import PixelFlag
from pixcal.stages.reduce.calibration import FLAG_ATTRS
from pixcal.stages.reduce.columns import Index, extent, grid
from pixcal.storage.cube import (
    CHUNK,
    ArrayReader,
    ArrayWriter,
    create_array,
    create_group,
    write_array,
)
from pixcal.storage.place import Place

F32 = NDArray[np.float32]

CONVERT_BYTES = 8 * 4 * CHUNK[0] * CHUNK[1] * CHUNK[2]
"""Peak of `convert`: a raw chunk, its codes, both compressed, and maps."""


@dataclass(frozen=True)
class FringeSet:
    """A fringe set, raw.

    Attributes
    ----------
    name : str
        As in ``acquisition.yaml``.
    raw : Path or UrlPath
        Array of the frames.
    calibration : Path
        ``calibration.zarr``.
    exptime : (t,) float32
        Exposure times for the dark signal (s).
    saturation : float
        Samples at or above it have no weight (ADU).
    gain : float
        e-/ADU.
    """

    name: str
    raw: Place
    calibration: Path
    exptime: F32
    saturation: float
    gain: float

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.exptime)

    def maps(self, shape: tuple[int, int], index: Index) -> dict[str, NDArray[Any]]:
        """Calibration maps of a column of chunks."""
        ranges = extent(shape, index)
        names = ("bias", "dark_rate", "flat", "read_noise", "mask")
        return {name: ArrayReader(self.calibration / name).read(*ranges) for name in names}


def _window(raw: ArrayReader) -> tuple[int, int]:
    return raw.shape[1], raw.shape[2]


def _chunks(raw: ArrayReader, index: Index) -> Iterator[tuple[int, NDArray[Any]]]:
    """First frame and samples (t, y, x) of the chunks of a column."""
    chunk = np.empty(raw.chunks, raw.dtype)
    (y0, y1), (x0, x1) = extent(_window(raw), index)
    for first in range(0, raw.shape[0], CHUNK[0]):
        raw.read_chunk((first // CHUNK[0], *index), chunk)
        yield first, chunk[: min(CHUNK[0], raw.shape[0] - first), : y1 - y0, : x1 - x0]


def signal_range(fringes: FringeSet, index: Index) -> tuple[float, float]:
    """Least and largest electrons of the samples of good pixels in a column of chunks."""
    raw = ArrayReader(fringes.raw)
    maps = fringes.maps(_window(raw), index)
    lowest = np.full(maps["bias"].shape, np.inf, np.float32)
    highest = -lowest
    for _, samples in _chunks(raw, index):
        extremes(samples, np.float32(fringes.saturation), lowest, highest)
    seconds = np.array([fringes.exptime.max(), fringes.exptime.min()], np.float32)
    dark = maps["dark_rate"] * seconds[:, None, None]
    ends = (fringes.gain * (np.stack([lowest, highest]) - maps["bias"]) - dark) / maps["flat"]
    good = (maps["mask"] == 0) & np.isfinite(ends).all(axis=0)
    if not good.any():
        return np.inf, -np.inf
    return float(ends[0][good].min()), float(ends[1][good].max())


@dataclass(frozen=True)
class Converting:
    """What the task of a column needs.

    Attributes
    ----------
    fringes : FringeSet
    scale : Scale
        Codes of the electrons.
    writers : dict
        Arrays of the dataset, and ``counts`` for what `convert` counts.
    """

    fringes: FringeSet
    scale: Scale
    writers: dict[str, ArrayWriter]


def set_writers(
    folder: Place, scratch: Path, frames: int, shape: tuple[int, int], scale: Scale
) -> dict[str, ArrayWriter]:
    """Make the arrays of a dataset that `convert` writes, and one for its counts."""
    signal = {
        "long_name": "signal",
        "units": "electron",
        "scale_factor": scale.step,
        "add_offset": scale.offset,
        "_FillValue": FILL,
        "ancillary_variables": "read_variance shot_factor mask",
        "comment": "variance of a sample: shot_factor * expected signal + read_variance",
    }
    read = {"units": "electron2", "long_name": "variance of a sample without light"}
    shot = {"units": "1", "long_name": "shot variance over signal: one over the flat"}
    create_group(folder.parent)
    create_group(folder, {"Conventions": "CF-1.11", "title": f"fringe set {folder.name}"})
    made = {
        "signal": create_array(
            folder / "signal", (frames, *shape), np.uint16, fill_value=FILL, attrs=signal
        )
    }
    for name, dtype, attrs in (
        ("read_variance", np.float32, read),
        ("shot_factor", np.float32, shot),
        ("mask", np.uint8, FLAG_ATTRS),
    ):
        made[name] = create_array(
            folder / name, shape, dtype, dims=("y", "x"), chunks=CHUNK[1:], attrs=attrs
        )
    made["counts"] = create_array(
        scratch, (*grid(shape), 5), np.int64, dims=("i", "j", "count"), chunks=(1, 1, 5)
    )
    return made


def write_coordinates(folder: Place, time_s: Any, shape: tuple[int, int]) -> None:
    """Write the coordinates of a dataset."""
    for name, values, attrs in (
        ("time", np.asarray(time_s, float), {"units": "s", "long_name": "since the first frame"}),
        ("y", np.arange(shape[0], dtype=np.int32), {"units": "1", "long_name": "row"}),
        ("x", np.arange(shape[1], dtype=np.int32), {"units": "1", "long_name": "column"}),
    ):
        write_array(folder / name, values, dims=(name,), attrs=attrs)


STRAY_SHARE = 1e-3
"""Share of saturated samples up to which a pixel is good: particles hit it now and then, and those
samples have no weight. Light that saturates does so in every bright fringe, and biases the rest."""

STRAY_SAMPLES = 2
"""Saturated samples that a pixel may have in a short run."""


def convert(job: Converting, index: Index) -> None:
    """Write a column of chunks in electrons, its maps, and its counts.

    The counts are: samples that are saturated; others without weight; samples with weight; the sum
    of their codes; the largest sample (ADU; zero for real numbers).
    """
    fringes, writers = job.fringes, job.writers
    raw = ArrayReader(fringes.raw)
    (y0, _), (x0, _) = extent(_window(raw), index)
    maps = fringes.maps(_window(raw), index)
    flat, rate = maps["flat"], maps["dark_rate"]
    slope, start, dark = coefficients(job.scale, fringes.gain, maps["bias"], rate, flat)
    saturated = np.zeros(flat.shape, np.uint32)
    lost = np.zeros_like(saturated)
    codes = np.empty((CHUNK[0], *flat.shape), np.uint16)
    total = largest = 0
    for first, samples in _chunks(raw, index):
        out = codes[: len(samples)]
        exptime = fringes.exptime[first : first + len(samples)]
        total += encode(
            samples, slope, start, dark, exptime, np.float32(fringes.saturation),
            out, saturated, lost,
        )  # fmt: skip
        writers["signal"].write((first, y0, x0), out)
        if raw.dtype.kind in "iu":
            largest = max(largest, int(samples.max()))
    seconds = float(fringes.exptime.mean())
    read = (maps["read_noise"] ** 2 + np.maximum(rate, 0) * seconds) / flat**2 + job.scale.variance
    often = saturated > max(STRAY_SHARE * fringes.frames, STRAY_SAMPLES)
    mask = maps["mask"] | PixelFlag.SATURATED * often | PixelFlag.NO_DATA * (lost > 0)
    for name, data in (("read_variance", read), ("shot_factor", 1 / flat), ("mask", mask)):
        writers[name].write((y0, x0), data.astype(writers[name].dtype))
    without = int(saturated.sum()), int(lost.sum())
    weighted = flat.size * fringes.frames - sum(without)
    writers["counts"].write((*index, 0), np.array([[[*without, weighted, total, largest]]]))
