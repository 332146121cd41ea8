"""Cubes (time, y, x) on disk: Zarr 3 arrays in whole, checksummed chunks, one writer a chunk.

zarr-python makes the metadata; the chunks of a local store are read and written here, because its
own pipeline does not scale with threads (design note on storage). The bytes are the same: the
tests read each with the other. Every chunk has a crc32c inside (the Zarr codec), and its size and
that crc are kept in an index beside the array, so that a chunk that is missing, cut or exchanged
is refused and never read as zeros. The index ends with a crc of itself and of the metadata.
"""

import json
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import zarr
from numcodecs import Blosc, blosc
from numpy.typing import NDArray
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec

from pixcal.model.errors import DamagedError

CHUNK = (64, 128, 128)
"""Samples of a chunk along (time, y, x): 2 MiB of uint16."""

INDEX = "chunks.npy"
_INDEX_DTYPE = np.dtype([("size", "<u4"), ("crc", "<u4")])

# Threads belong to the engine: Blosc must not start its own, nor share a global context.
blosc.use_threads = False


def create_array(
    path: Path,
    shape: Sequence[int],
    dtype: Any,
    *,
    dims: Sequence[str] = ("time", "y", "x"),
    chunks: Sequence[int] = CHUNK,
    fill_value: Any = 0,
    attrs: dict[str, Any] | None = None,
    durable: bool = False,
) -> "ArrayWriter":
    """Create an array to be written chunk by chunk, or reopen one that was left unfinished.

    Parameters
    ----------
    path : Path
        Folder of the array, e.g. ``raw.zarr/fringes/vertical``.
    shape, chunks : sequence of int
        In the order of ``dims``.
    dtype : dtype
        Of fixed size; stored little-endian.
    fill_value : scalar
        Value outside the array in edge chunks, and CF ``_FillValue`` where ``attrs`` says so.
    durable : bool
        Flush every chunk to the disk as it is written, so that work of hours also outlives a power
        failure half-way. Otherwise the artefact is flushed once, when it is complete.
    """
    shape, chunks = tuple(map(int, shape)), tuple(map(int, chunks))
    dtype = np.dtype(dtype).newbyteorder("<")
    if not (path / "zarr.json").exists():
        path.mkdir(parents=True, exist_ok=True)
        zarr.create_array(
            store=zarr.storage.LocalStore(path),
            shape=shape,
            chunks=chunks,
            dtype=dtype,
            fill_value=fill_value,
            serializer=BytesCodec(endian="little"),
            compressors=[
                BloscCodec(typesize=dtype.itemsize, cname="lz4", clevel=1, shuffle="bitshuffle"),
                Crc32cCodec(),
            ],
            filters=None,
            dimension_names=tuple(dims),
            attributes=attrs or {},
            overwrite=True,
        )
    return ArrayWriter(path, shape, chunks, dtype, fill_value, durable)


def create_group(path: Path, attrs: dict[str, Any] | None = None) -> None:
    """Create a Zarr group (a folder that xarray opens as a dataset) if it is not there."""
    if not (path / "zarr.json").exists():
        zarr.create_group(store=zarr.storage.LocalStore(path), attributes=attrs or {})


def write_array(path: Path, data: NDArray[Any], **options: Any) -> None:
    """Write a whole small array (maps, coordinates) at once; options as `create_array`."""
    options.setdefault("chunks", tuple(max(1, min(1024, n)) for n in data.shape))
    writer = create_array(path, data.shape, data.dtype, **options)
    writer.write(tuple(0 for _ in data.shape), data)
    writer.finish()


def _grid(shape: tuple[int, ...], chunks: tuple[int, ...]) -> tuple[int, ...]:
    return tuple(-(-n // c) for n, c in zip(shape, chunks, strict=True))


def _aside(file: Path) -> Path:
    return file.with_name(f".{file.name}.aside")


def _seal(path: Path, index: bytes) -> bytes:
    """Checksum of an array's metadata and index, kept at the end of the index."""
    seal: int = google_crc32c.value((path / "zarr.json").read_bytes() + index)
    return seal.to_bytes(4, "little")


def _chunk_file(path: Path, index: Sequence[int]) -> Path:
    return path.joinpath("c", *map(str, index))


@dataclass
class ArrayWriter:
    """Writes whole chunks of an array; made by `create_array`."""

    path: Path
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]
    fill_value: Any
    durable: bool = False

    def write(self, start: Sequence[int], data: NDArray[Any]) -> None:
        """Write a block that begins and ends on chunk borders (or at the array's end).

        Each chunk is written aside and renamed: one that exists is whole.
        Blocks that share no chunk may be written at the same time.
        """
        codec = Blosc("lz4", 1, Blosc.BITSHUFFLE)
        first = []
        files: list[Path] = []
        for s, n, c, size in zip(start, data.shape, self.chunks, self.shape, strict=True):
            if s % c or not (n % c == 0 or s + n == size):
                block_at = f"block {tuple(start)} + {data.shape}"
                raise ValueError(f"{block_at} is not on chunks {self.chunks}")
            first.append(s // c)
        for offset in product(*map(range, _grid(data.shape, self.chunks))):
            part = data[
                tuple(slice(o * c, (o + 1) * c) for o, c in zip(offset, self.chunks, strict=True))
            ]
            if part.shape == self.chunks:
                block = np.ascontiguousarray(part, self.dtype)
            else:
                block = np.full(self.chunks, self.fill_value, self.dtype)
                block[tuple(map(slice, part.shape))] = part
            body = bytes(codec.encode(block))
            crc = google_crc32c.value(body)
            file = _chunk_file(self.path, [f + o for f, o in zip(first, offset, strict=True)])
            file.parent.mkdir(parents=True, exist_ok=True)
            with _aside(file).open("wb") as out:
                out.write(body)
                out.write(crc.to_bytes(4, "little"))
            files.append(file)
        # Flushed once all are written: the disk works meanwhile (twice as fast as one by one).
        for file in files:
            if self.durable:
                with _aside(file).open("rb") as written:
                    os.fdatasync(written.fileno())
            _aside(file).replace(file)

    def finish(self) -> None:
        """Check that every chunk is there and write the index of sizes and checksums.

        Raises
        ------
        DamagedError
            Naming the first chunk that is missing or cut.
        """
        grid = _grid(self.shape, self.chunks)
        index = np.zeros(grid, _INDEX_DTYPE)
        for where in np.ndindex(grid):
            file = _chunk_file(self.path, where)
            try:
                with file.open("rb") as handle:
                    size = os.fstat(handle.fileno()).st_size
                    handle.seek(max(0, size - 4))
                    tail = handle.read(4)
            except OSError as error:
                raise DamagedError(f"{file}: chunk missing ({error.strerror})") from error
            if len(tail) < 4:
                raise DamagedError(f"{file}: chunk cut short")
            index[where] = (size, int.from_bytes(tail, "little"))
        body = BytesIO()
        np.save(body, index)
        aside = self.path / f".{INDEX}"
        with aside.open("wb") as out:
            out.write(body.getvalue())
            out.write(_seal(self.path, body.getvalue()))
            if self.durable:
                out.flush()
                os.fsync(out.fileno())
        aside.replace(self.path / INDEX)


class ArrayReader:
    """Reads blocks of an array written by `ArrayWriter`, checking every chunk.

    Parameters
    ----------
    path : Path
        Folder of the array.

    Raises
    ------
    DamagedError
        If the metadata or the chunk index is missing, cut or altered.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            body = (path / INDEX).read_bytes()
            if _seal(path, body[:-4]) != body[-4:]:
                raise ValueError(f"zarr.json or {INDEX} was altered")
            # Sealed, so it is what zarr wrote: no need of zarr's event loop, which takes its time
            # when many threads open many arrays.
            meta = json.loads((path / "zarr.json").read_bytes())
            self._index = np.load(BytesIO(body[:-4]), allow_pickle=False)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DamagedError(
                f"{path}: not a complete array ({' '.join(str(error).split())}); "
                "remove the artefact that holds it and run its stage again"
            ) from error
        self.shape: tuple[int, ...] = tuple(meta["shape"])
        self.chunks: tuple[int, ...] = tuple(meta["chunk_grid"]["configuration"]["chunk_shape"])
        self.dtype: np.dtype[Any] = np.dtype(meta["data_type"])
        self.attrs: dict[str, Any] = meta["attributes"]
        self.chunks_read = 0

    @property
    def n_chunks(self) -> int:
        """Number of chunks of the array."""
        return int(self._index.size)

    def read_chunk(self, index: Sequence[int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """One whole chunk (edge chunks too, padded with the fill value).

        Parameters
        ----------
        index : sequence of int
            Position in the grid of chunks.
        out : ndarray, optional
            Buffer of shape ``chunks`` to decode into.

        Raises
        ------
        DamagedError
            Naming the chunk's file when it is missing, cut or altered.
        """
        file = _chunk_file(self.path, index)
        expected = self._index[tuple(index)]
        mend = "run the stage that wrote it again"
        try:
            body = file.read_bytes()
        except OSError as error:
            raise DamagedError(f"{file}: chunk missing ({error.strerror}); {mend}") from error
        if len(body) != expected["size"]:
            raise DamagedError(
                f"{file}: {len(body)} bytes where {expected['size']} were written; {mend}"
            )
        data, tail = body[:-4], int.from_bytes(body[-4:], "little")
        if tail != expected["crc"] or google_crc32c.value(data) != tail:
            raise DamagedError(f"{file}: checksum does not match, the chunk was altered; {mend}")
        buffer = np.empty(self.chunks, self.dtype) if out is None else out
        try:
            blosc.decompress(data, buffer)
        except (RuntimeError, ValueError) as error:
            raise DamagedError(f"{file}: cannot be decoded ({error}); {mend}") from error
        self.chunks_read += 1
        return buffer

    def read(self, *ranges: tuple[int, int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """A block, given one (start, stop) for each axis; fastest when it follows the chunks.

        Parameters
        ----------
        *ranges : tuple of int
            Start and stop along each axis; missing trailing axes are taken whole.
        out : ndarray, optional
            Buffer of the block's shape.
        """
        full = [(0, n) for n in self.shape]
        full[: len(ranges)] = [(max(0, a), min(b, n)) for (a, b), (_, n) in zip(ranges, full)]  # noqa: B905
        shape = tuple(b - a for a, b in full)
        block = np.empty(shape, self.dtype) if out is None else out
        scratch = np.empty(self.chunks, self.dtype)
        spans = [range(a // c, -(-b // c)) for (a, b), c in zip(full, self.chunks, strict=True)]
        for index in product(*spans):
            chunk = self.read_chunk(index, scratch)
            source, target = [], []
            for i, c, (a, b) in zip(index, self.chunks, full, strict=True):
                lo, hi = max(a, i * c), min(b, (i + 1) * c)
                source.append(slice(lo - i * c, hi - i * c))
                target.append(slice(lo - a, hi - a))
            block[tuple(target)] = chunk[tuple(source)]
        return block

    def tiles(self) -> Iterator[tuple[tuple[int, int], tuple[int, int]]]:
        """Ranges ((y0, y1), (x0, x1)) of the columns of chunks, for arrays (time, y, x)."""
        (_, ny, nx), (_, cy, cx) = self.shape, self.chunks
        for y0, x0 in product(range(0, ny, cy), range(0, nx, cx)):
            yield (y0, min(y0 + cy, ny)), (x0, min(x0 + cx, nx))

    def verify(self) -> None:
        """Read every chunk and check it (DamagedError names the first bad one)."""
        scratch = np.empty(self.chunks, self.dtype)
        for index in np.ndindex(self._index.shape):
            self.read_chunk(index, scratch)


class CachedReader(ArrayReader):
    """An `ArrayReader` that keeps chosen chunks in memory; plain again in another process."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._kept: dict[tuple[int, ...], NDArray[Any]] = {}

    def __reduce__(self) -> tuple[type["CachedReader"], tuple[Path]]:
        return CachedReader, (self.path,)

    def keep(self, index: Sequence[int]) -> NDArray[Any]:
        """Read a chunk and keep it for later calls of `read_chunk`."""
        key = tuple(index)
        if key not in self._kept:
            self._kept[key] = super().read_chunk(key)
        return self._kept[key]

    def holds(self, index: Sequence[int]) -> bool:
        """Whether a chunk is in memory."""
        return tuple(index) in self._kept

    def read_chunk(self, index: Sequence[int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """As `ArrayReader.read_chunk`; a kept chunk is returned itself and must not be changed."""
        kept = self._kept.get(tuple(index))
        return super().read_chunk(index, out) if kept is None else kept
