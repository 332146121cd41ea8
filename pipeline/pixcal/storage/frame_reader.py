"""Read frames from their FITS files, as `pixcal.storage.cube_reader` reads those of a cube.

`ingest` described and read the files once. Each later read is checked against its results: sizes,
times of change, and the checksum of every band of rows.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.model.errors import InputError
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.frame_decoding import BAND, read_rows
from pixcal.storage.frame_file import FrameFile, SampleFormat
from pixcal.storage.sources import SourceFile

_CACHED = 1 << 20
_FRAMES = (64, 32, 16, 8, 4, 2)  # divisors of the frames of a chunk of a cube

# contents of `files.json` for the files of an array, in columns of equal length
Columns = Mapping[str, Sequence[Any]]


def describe(files: Sequence[FrameFile]) -> dict[str, list[Any]]:
    """Positions of the samples of plain files, in columns."""
    return {
        "file": [f.source.name for f in files],
        "size": [f.source.size for f in files],
        "mtime_ns": [f.source.mtime_ns for f in files],
        "offset": [f.offset for f in files],
        "planes": [f.shape[0] for f in files],
        "bitpix": [f.coding.bitpix for f in files],
        "bscale": [f.coding.bscale for f in files],
        "bzero": [f.coding.bzero for f in files],
        "blank": [f.coding.blank for f in files],
    }


def described(columns: Columns, number: int, folder: Path, frame: Sequence[int]) -> FrameFile:
    """One of the files of `describe`, with its frame size (y, x)."""
    row = {name: column[number] for name, column in columns.items()}
    place, known = folder / row["file"], (row["file"], row["size"], row["mtime_ns"])
    changed = "changed since it was ingested; run 'pixcal ingest' again"
    source = SourceFile(place, *known, changed=changed)
    coding = SampleFormat(row["bitpix"], row["bscale"], row["bzero"], row["blank"])
    shape = (row["planes"], frame[0], frame[1])
    return FrameFile(source, "plain", -1, row["offset"], shape, coding)


class FrameReader:
    """Reads blocks of an array (time, y, x) from FITS files, checking every band of rows.

    ``columns``: of `describe`. ``table``: ``file`` and ``plane`` of the frames in order.
    ``checksums``: (time, band).
    """

    def __init__(
        self,
        folder: Path,
        columns: Columns,
        table: Columns,
        shape: Sequence[int],
        dtype: Any,
        checksums: NDArray[Any],
    ) -> None:
        self._made_of = folder, columns, table, shape, dtype, checksums
        self.shape: tuple[int, ...] = tuple(shape)
        self.dtype: np.dtype[Any] = np.dtype(dtype)
        names = enumerate(columns["file"])
        files = {name: described(columns, n, folder, self.shape[1:]) for n, name in names}
        self._files = [files[name] for name in table["file"]]
        self._planes = list(table["plane"])
        # Samples to read at a time (time, y, x), such that they fit in a core's cache.
        band = BAND * self.shape[2] * self.dtype.itemsize
        frames = next((n for n in _FRAMES if n * band <= _CACHED), 1)
        self.chunks: tuple[int, ...] = (frames, BAND, self.shape[2])
        self._checksums = checksums

    def __reduce__(self) -> tuple[Any, ...]:
        # Without the paths, since another process would check each of them.
        return FrameReader, self._made_of

    def read(self, *ranges: tuple[int, int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """A block, as by `ArrayReader.read`; fastest in bands of 128 rows over all columns."""
        full = [(0, n) for n in self.shape]
        full[: len(ranges)] = [(max(0, a), min(b, n)) for (a, b), n in zip(ranges, self.shape)]  # noqa: B905
        (t0, t1), (y0, y1), (x0, x1) = full
        shape = (t1 - t0, y1 - y0, x1 - x0)
        block = np.empty(shape, self.dtype) if out is None else out
        if 0 in shape:
            return block
        _, ny, nx = self.shape
        rows = (y0 - y0 % BAND, min(-(-y1 // BAND) * BAND, ny))
        whole = rows == (y0, y1) and x1 - x0 == nx and block.flags.c_contiguous
        band = np.empty((1, rows[1] - rows[0], nx), self.dtype)
        for t in range(t0, t1):
            self._read_frame(t, rows, block[t - t0 : t - t0 + 1] if whole else band)
            if not whole:
                block[t - t0] = band[0, y0 - rows[0] : y1 - rows[0], x0:x1]
        return block

    def _read_frame(self, t: int, rows: tuple[int, int], out: NDArray[Any]) -> None:
        file = self._files[t]
        checksums = read_rows(file, [self._planes[t]], rows, out, crc_alone=True)[0, :, 0]
        first = rows[0] // BAND
        if (checksums != self._checksums[t, first : first + len(checksums)]).any():
            raise InputError(
                f"{file.source.path}: its contents differ from those ingested (checksum), although "
                "size and time agree; restore it, or touch it and run 'pixcal ingest' again"
            )


@dataclass(frozen=True)
class ChosenFrames:
    """A subset of the frames of an array (time, y, x), as an array."""

    reader: ArrayReader | FrameReader
    numbers: Sequence[int]  # of the frames, increasing

    @property
    def shape(self) -> tuple[int, ...]:
        """Of the array."""
        return len(self.numbers), *self.reader.shape[1:]

    @property
    def dtype(self) -> np.dtype[Any]:
        """Of the samples."""
        return self.reader.dtype

    @property
    def chunks(self) -> tuple[int, ...]:
        """Samples to read at a time."""
        return self.reader.chunks

    def read(self, *ranges: tuple[int, int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """A block, as `ArrayReader.read` gives it."""
        times, *within = ranges or ((0, len(self.numbers)),)
        numbers = np.asarray(self.numbers[slice(*times)], int)
        parts = np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1)
        blocks = [self.reader.read((p[0], p[-1] + 1), *within) for p in parts if len(p)]
        blocks = blocks or [self.reader.read((0, 0), *within)]
        return np.concatenate(blocks, out=out)


Reader = ArrayReader | FrameReader | ChosenFrames  # reader of frames (time, y, x) in any storage
