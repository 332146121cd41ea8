"""Fringe frames in electrons: from FITS files, or ``raw.zarr``, to ``reduced.zarr``."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels.quantise import FILL, Scale, coefficients, encode, extremes
from pixcal.model.arrays import F32
from pixcal.model.flags import PixelFlag
from pixcal.stages import tiles
from pixcal.stages.reduce.calibration import FLAG_ATTRS
from pixcal.stages.reduce.columns import blocks
from pixcal.stages.tiles import STRIP, Index, Strip
from pixcal.storage import cube
from pixcal.storage.cube import CHUNK, ArrayWriter
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.frame_reader import Reader
from pixcal.storage.place import Place


def convert_bytes(itemsize: int, width: int, frames: int = CHUNK[0]) -> int:
    """Peak of `convert`: two chunks, also compressed; frames, codes and maps of each column."""
    tile = CHUNK[1] * CHUNK[2]
    column = frames * itemsize + CHUNK[0] * np.dtype(np.uint16).itemsize
    return tile * (4 * 4 * CHUNK[0] + width * column + max(width, STRIP) * 16 * 4)


@dataclass(frozen=True)
class RawFringeSet:
    """A raw fringe set."""

    name: str  # as in ``acquisition.yaml``
    raw: Reader  # of the frames
    calibration: Place  # ``calibration.zarr``
    exptime: F32  # (t,) exposure times for the dark signal (s)
    saturation: float  # samples at or above it have no weight (ADU)
    gain: float  # e-/ADU

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.exptime)

    def maps(self, strip: Strip) -> list[dict[str, NDArray[Any]]]:
        """Calibration maps of each column of chunks."""
        ranges = tiles.span(self.raw.shape[1:], strip)
        names = ("bias", "dark_rate", "flat", "read_noise", "mask")
        maps = [
            tiles.by_column(ArrayReader(self.calibration / name).read(*ranges)) for name in names
        ]
        return [dict(zip(names, of_column, strict=True)) for of_column in zip(*maps, strict=True)]


def signal_range(fringes: RawFringeSet, strip: Strip) -> tuple[float, float]:
    """Least and largest sample (e-) of good pixels in columns of chunks."""
    every = fringes.maps(strip)
    lowest = [np.full(maps["bias"].shape, np.inf, np.float32) for maps in every]
    highest = [-low for low in lowest]
    for _, samples in blocks(fringes.raw, strip):
        for n, (low, high) in enumerate(zip(lowest, highest, strict=True)):
            extremes(samples, fringes.saturation, low, high, n * CHUNK[2])
    ranges = [_range_e(fringes, *of) for of in zip(every, lowest, highest, strict=True)]
    return min(low for low, _ in ranges), max(high for _, high in ranges)


def _range_e(
    fringes: RawFringeSet, maps: dict[str, NDArray[Any]], low: F32, high: F32
) -> tuple[float, float]:
    seconds = np.array([fringes.exptime.max(), fringes.exptime.min()], np.float32)
    dark = maps["dark_rate"] * seconds[:, None, None]
    ends = (fringes.gain * (np.stack([low, high]) - maps["bias"]) - dark) / maps["flat"]
    good = (maps["mask"] == 0) & np.isfinite(ends).all(axis=0)
    if not good.any():
        return np.inf, -np.inf
    return float(ends[0][good].min()), float(ends[1][good].max())


def set_writers(
    folder: Place, scratch: Place, frames: int, shape: tuple[int, int], scale: Scale
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
    cube.create_group(folder.parent)
    cube.create_group(folder, {"Conventions": "CF-1.11", "title": f"fringe set {folder.name}"})
    made = {
        "signal": cube.create_array(
            folder / "signal", (frames, *shape), np.uint16, fill_value=FILL, attrs=signal
        )
    }
    for name, dtype, attrs in (
        ("read_variance", np.float32, read),
        ("shot_factor", np.float32, shot),
        ("mask", np.uint8, FLAG_ATTRS),
    ):
        made[name] = cube.create_array(
            folder / name, shape, dtype, dims=("y", "x"), chunks=tiles.map_chunk(shape), attrs=attrs
        )
    made["counts"] = cube.create_array(
        scratch,
        (*tiles.grid(shape), 5),
        np.int64,
        dims=("i", "j", "count"),
        chunks=(1, min(STRIP, tiles.grid(shape)[1]), 5),
    )
    return made


def write_coordinates(folder: Place, time_s: Any, shape: tuple[int, int]) -> None:
    """Write the coordinates of a dataset."""
    for name, values, attrs in (
        ("time", np.asarray(time_s, float), {"units": "s", "long_name": "since the first frame"}),
        ("y", np.arange(shape[0], dtype=np.int32), {"units": "1", "long_name": "row"}),
        ("x", np.arange(shape[1], dtype=np.int32), {"units": "1", "long_name": "column"}),
    ):
        cube.write_array(folder / name, values, dims=(name,), attrs=attrs)


# largest share of saturated samples of a good pixel: occasional particle hits have no weight. Light
# that saturates does so in every bright fringe, and biases the other samples.
STRAY_SHARE = 1e-3

STRAY_SAMPLES = 2  # saturated samples allowed per pixel in a short run


class _Column:
    """A column of chunks during conversion."""

    def __init__(
        self, fringes: RawFringeSet, scale: Scale, index: Index, maps: dict[str, NDArray[Any]]
    ) -> None:
        self.fringes, self.scale, self.index, self.maps = fringes, scale, index, maps
        self.coefficients = coefficients(
            scale, fringes.gain, *(self.maps[name] for name in ("bias", "dark_rate", "flat"))
        )
        self.saturated = np.zeros(self.maps["flat"].shape, np.uint32)
        self.lost = np.zeros_like(self.saturated)
        self.codes = np.empty((CHUNK[0], *self.lost.shape), np.uint16)
        self.total = self.largest = 0

    def add(self, first: int, samples: NDArray[Any], begin: int, signal: ArrayWriter) -> None:
        """Convert frames of a strip's columns from ``begin`` on; write full chunks."""
        fringes, last = self.fringes, first + len(samples)
        at = first % CHUNK[0]
        held = at + len(samples)
        self.total += encode(
            samples,
            *self.coefficients,
            fringes.exptime[first:last],
            np.float32(fringes.saturation),
            self.codes[at:held],
            self.saturated,
            self.lost,
            begin,
        )
        if held == CHUNK[0] or last == fringes.frames:
            (y0, _), (x0, _) = tiles.extent(fringes.raw.shape[1:], self.index)
            signal.write((last - held, y0, x0), self.codes[:held])

    def result(self) -> dict[str, NDArray[Any]]:
        """Maps and counts, by the names of their arrays."""
        fringes, maps = self.fringes, self.maps
        flat, rate, seconds = maps["flat"], maps["dark_rate"], float(fringes.exptime.mean())
        read = (maps["read_noise"] ** 2 + np.maximum(rate, 0) * seconds) / flat**2
        read = read + self.scale.variance
        often = self.saturated > max(STRAY_SHARE * fringes.frames, STRAY_SAMPLES)
        mask = maps["mask"] | PixelFlag.SATURATED * often | PixelFlag.NO_DATA * (self.lost > 0)
        without = int(self.saturated.sum()), int(self.lost.sum())
        weighted = flat.size * fringes.frames - sum(without)
        counts = np.array([[[*without, weighted, self.total, self.largest]]])
        return {"read_variance": read, "shot_factor": 1 / flat, "mask": mask, "counts": counts}


def convert(
    fringes: RawFringeSet, scale: Scale, writers: Mapping[str, ArrayWriter], parts: Sequence[Strip]
) -> None:
    """Write columns of chunks in electrons, their maps, and their counts.

    The counts are: saturated samples; other samples without weight; samples with weight; the sum of
    their codes; the largest sample of the strip (ADU; zero for real numbers).
    """
    results: dict[Index, dict[str, NDArray[Any]]] = {}
    for strip in parts:
        with_maps = zip(strip, fringes.maps(strip), strict=True)
        columns = [_Column(fringes, scale, index, maps) for index, maps in with_maps]
        for first, samples in blocks(fringes.raw, strip):
            largest = int(samples.max()) if samples.dtype.kind in "iu" else 0
            for n, column in enumerate(columns):
                column.add(first, samples, n * CHUNK[2], writers["signal"])
                column.largest = max(column.largest, largest)
        results |= {column.index: column.result() for column in columns}
    for strip in tiles.strips(list(results), STRIP):
        (y0, _), (x0, _) = tiles.extent(fringes.raw.shape[1:], strip[0])
        for name in results[strip[0]]:
            writer = writers[name]
            data = np.concatenate([results[index][name] for index in strip], axis=1)
            start = (*strip[0], 0) if name == "counts" else (y0, x0)
            writer.write(start, data.astype(writer.dtype))
