"""Cubes (time, y, x) on disk: Zarr 3 arrays in whole, checksummed chunks, one writer per chunk.

zarr-python makes the metadata. Chunks in the same format are read and written here, because the
pipeline of zarr-python does not scale with threads. Cubes are in local folders or at URLs. Every
chunk contains a crc32c; an index beside the array holds its size and crc, and ends with a crc of
itself and of the metadata. A missing, cut or exchanged chunk is refused.
"""

import errno
import json
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
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

from pixcal.model.errors import DamagedError, reason_of
from pixcal.storage.folder import INDEX, File, copy_files, link_files, open_folder, read_file
from pixcal.storage.memory import MemoryArray, MemoryPath
from pixcal.storage.place import Place, UrlPath
from pixcal.storage.read_ahead import AHEAD, ReadAhead

Ints = tuple[int, ...]

CHUNK = (64, 128, 128)  # samples of a chunk along (time, y, x): 2 MiB of uint16

# system errors that mean a damaged file; others may be temporary
_LOST = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO)
_RESIDUE = 0x48674BC7  # CRC-32C of anything that ends with its own CRC-32C, least byte first
_INDEX_DTYPE = np.dtype([("size", "<u4"), ("crc", "<u4")])

# Threads belong to the engine: Blosc must not start its own, nor share a global context.
blosc.use_threads = False


def create_array(
    path: Place,
    shape: Sequence[int],
    dtype: Any,
    *,
    dims: Sequence[str] = ("time", "y", "x"),
    chunks: Sequence[int] = CHUNK,
    fill_value: Any = 0,
    attrs: dict[str, Any] | None = None,
) -> "ArrayWriter":
    """Create an array to be written chunk by chunk, or reopen one that was left unfinished.

    ``shape, chunks``: in the order of ``dims``. ``dtype``: of fixed size; stored little-endian.
    ``fill_value``: outside the array in edge chunks, and CF ``_FillValue`` where ``attrs`` says so.
    """
    shape, chunks = tuple(map(int, shape)), tuple(map(int, chunks))
    dtype = np.dtype(dtype).newbyteorder("<")
    if isinstance(path, MemoryPath):
        path.keep(MemoryArray(np.full(shape, fill_value, dtype), chunks, fill_value, attrs or {}))
        return ArrayWriter(path, shape, chunks, dtype, fill_value, b"")
    text = json.dumps(attrs or {})
    metadata = _array_metadata(shape, chunks, dtype.str, fill_value, tuple(dims), text)
    _write_metadata(path, metadata)
    return ArrayWriter(path, shape, chunks, dtype, fill_value, metadata)


def create_map(
    path: Place, shape: Sequence[int], chunks: Sequence[int], *, units: str = "", number: int = 0
) -> "ArrayWriter":
    """Create a map (y, x) of float32, or several (batch, y, x); NaN where nothing is written."""
    many = (number,) * (number > 0)
    dims = ("batch", "y", "x")[-2 - len(many) :]
    return create_array(
        path,
        (*many, *shape),
        "<f4",
        dims=dims,
        chunks=(*many, *chunks),
        fill_value=np.nan,
        attrs={"units": units} if units else None,
    )


# Cached: many arrays have the same metadata, and zarr-python takes a millisecond for each.
@lru_cache(maxsize=512)
def _array_metadata(
    shape: Ints, chunks: Ints, dtype: str, fill_value: Any, dims: tuple[str, ...], attrs: str
) -> bytes:
    """Metadata as zarr-python writes it for an array; attributes as JSON."""
    made: dict[str, Any] = {}
    size = np.dtype(dtype).itemsize
    blosc_codec = BloscCodec(typesize=size, cname="lz4", clevel=1, shuffle="bitshuffle")
    zarr.create_array(
        store=made,
        shape=shape,
        chunks=chunks,
        dtype=np.dtype(dtype),
        fill_value=fill_value,
        serializer=BytesCodec(endian="little"),
        compressors=[blosc_codec, Crc32cCodec()],
        filters=None,
        dimension_names=dims,
        attributes=json.loads(attrs),
    )
    content: bytes = made["zarr.json"].to_bytes()
    return content


def create_group(path: Place, attrs: dict[str, Any] | None = None) -> None:
    """Create a Zarr group (a folder that xarray opens as a dataset) if it does not exist."""
    if isinstance(path, MemoryPath):
        return
    _write_metadata(path, _group_metadata(json.dumps(attrs or {})))


@lru_cache(maxsize=512)
def _group_metadata(attrs: str) -> bytes:
    """Metadata as zarr-python writes it for a group; attributes as JSON."""
    made: dict[str, Any] = {}
    zarr.create_group(store=made, attributes=json.loads(attrs))
    content: bytes = made["zarr.json"].to_bytes()
    return content


def _write_metadata(path: Place, content: bytes) -> None:
    """Write the metadata of an array or a group, unless the same content exists already."""
    try:
        there = (path / "zarr.json").read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        there = b""
    # Metadata of an unfinished build are rewritten: they have no checksum yet.
    if there != content:
        open_folder(path).write([("zarr.json", [content])])


def write_array(path: Place, data: NDArray[Any], **options: Any) -> None:
    """Write a whole small array (maps, coordinates) at once; options as `create_array`."""
    options.setdefault("chunks", tuple(max(1, min(1024, n)) for n in data.shape))
    writer = create_array(path, data.shape, data.dtype, **options)
    writer.write(tuple(0 for _ in data.shape), data)
    writer.finish()


def _grid(shape: Ints, chunks: Ints) -> Ints:
    return tuple(-(-n // c) for n, c in zip(shape, chunks, strict=True))


def _shapes(metadata: dict[str, Any]) -> tuple[Ints, Ints]:
    """Shapes of an array and of its chunks."""
    chunks = metadata["chunk_grid"]["configuration"]["chunk_shape"]
    return tuple(metadata["shape"]), tuple(chunks)


def _seal(metadata: bytes, index: bytes) -> bytes:
    """Checksum of an array's metadata and index, kept at the end of the index."""
    seal: int = google_crc32c.value(metadata + index)
    return seal.to_bytes(4, "little")


def _chunk_name(index: Sequence[int]) -> str:
    return "/".join(["c", *map(str, index)])


def _names(grid: Ints) -> Iterator[list[str]]:
    """Names of all chunks, by steps along the first axis."""
    for first in range(grid[0]):
        yield [_chunk_name((first, *rest)) for rest in np.ndindex(grid[1:])]


@dataclass
class ArrayWriter:
    """Writes whole chunks of an array; made by `create_array`."""

    path: Place
    shape: tuple[int, ...]
    chunks: tuple[int, ...]
    dtype: np.dtype[Any]
    fill_value: Any
    metadata: bytes

    def write(self, start: Sequence[int], data: NDArray[Any]) -> None:
        """Write a block that begins and ends on chunk borders (or at the array's end).

        A chunk that exists is whole. Blocks that share no chunk may be written at the same time.
        Raises RemoteError if the array is at a URL that refuses it.
        """
        first = []
        for s, n, c, size in zip(start, data.shape, self.chunks, self.shape, strict=True):
            if s % c or not (n % c == 0 or s + n == size):
                block_at = f"block {tuple(start)} + {data.shape}"
                raise ValueError(f"{block_at} is not on chunks {self.chunks}")
            first.append(s // c)
        if isinstance(self.path, MemoryPath):
            self.path.array.write(start, data)
            return
        open_folder(self.path).write(self._encode(first, data))

    def _encode(self, first: Sequence[int], data: NDArray[Any]) -> Iterator[File]:
        """Name and content of the chunks of a block."""
        codec = Blosc("lz4", 1, Blosc.BITSHUFFLE)
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
            crc: int = google_crc32c.value(body)
            name = _chunk_name([f + o for f, o in zip(first, offset, strict=True)])
            yield name, (body, crc.to_bytes(4, "little"))

    def take(self, source: Place) -> None:
        """Link or copy the chunks of another such array, unchecked; existing chunks stay."""
        if isinstance(source, Path) and isinstance(self.path, Path):
            link_files(source / "c", self.path / "c")
            return
        for names in _names(_grid(self.shape, self.chunks)):
            copy_files(source, self.path, names)

    def finish(self) -> NDArray[Any]:
        """Check that every chunk is there, write the index and return it (``size``, ``crc``).

        Raises DamagedError naming the first chunk that is missing or cut.
        """
        grid = _grid(self.shape, self.chunks)
        index = np.zeros(grid, _INDEX_DTYPE)
        if isinstance(self.path, MemoryPath):
            return index
        folder = open_folder(self.path)
        for first, names in enumerate(_names(grid)):
            rows = []
            try:
                for name, (size, tail) in zip(names, folder.ends(names), strict=True):
                    if len(tail) < 4:
                        raise DamagedError(self.path / name, "truncated chunk")
                    rows.append((size, int.from_bytes(tail, "little")))
            except OSError as error:
                if error.errno not in _LOST:
                    raise
                raise DamagedError(error.filename, f"chunk missing ({error.strerror})") from error
            index[first] = np.array(rows, _INDEX_DTYPE).reshape(grid[1:])
        body = BytesIO()
        np.save(body, index)
        content = body.getvalue()
        folder.write([(INDEX, (content, _seal(self.metadata, content)))])
        return index


def chunks_whole(folder: Path) -> bool:
    """Whether every chunk below a folder agrees with its crc, in arrays without an index yet."""
    for at, folders, names in os.walk(folder):
        if "zarr.json" in names and "c" in folders:
            folders.clear()
            chunks = (f for f in Path(at, "c").rglob("*") if f.name.isdigit() and f.is_file())
            if any(google_crc32c.value(file.read_bytes()) != _RESIDUE for file in chunks):
                return False
    return True


def remove_arrays(path: Place) -> None:
    """Remove the groups and arrays in a folder, but no other files."""
    folder = open_folder(path)
    for child in folder.children():
        try:
            meta = json.loads((path / child / "zarr.json").read_bytes())
        except (OSError, ValueError):
            continue
        node = open_folder(path / child)
        if meta["node_type"] == "group":
            remove_arrays(path / child)
        else:
            for names in _names(_grid(*_shapes(meta))):
                node.remove(names)
        # Last, so that an interrupted removal can be repeated.
        node.remove([INDEX, "zarr.json"])


class ArrayReader:
    """Reads blocks of an array written by `ArrayWriter`, checking every chunk.

    Raises DamagedError if metadata or index are missing, cut or altered, RemoteError if the URL
    does not answer.
    """

    def __init__(self, path: Place) -> None:
        self.path = path
        self.chunks_read = 0
        self.shape: Ints
        self.chunks: Ints
        self._memory = path.array if isinstance(path, MemoryPath) else None
        if self._memory is not None:
            self.shape, self.chunks = self._memory.values.shape, self._memory.chunks
            self.dtype, self.attrs = self._memory.values.dtype, self._memory.attrs
            return
        try:
            body = (path / INDEX).read_bytes()
            metadata = (path / "zarr.json").read_bytes()
            if _seal(metadata, body[:-4]) != body[-4:]:
                raise ValueError(f"zarr.json or {INDEX} was altered")
            # The seal guarantees zarr's metadata, so zarr's event loop is not needed, which is slow
            # when many threads open many arrays.
            meta = json.loads(metadata)
            self.shape, self.chunks = _shapes(meta)
            self.dtype, self.attrs = np.dtype(meta["data_type"]), meta["attributes"]
            count = self.n_chunks
            # Not np.load: parsing its header as Python is not safe in the threads of a Dask worker,
            # where callbacks of the garbage collector come in between (CPython 3.11, gh-106905).
            begin = len(body) - 4 - count * _INDEX_DTYPE.itemsize
            index = np.frombuffer(body, _INDEX_DTYPE, count, begin)
            self._index = index.reshape(_grid(self.shape, self.chunks))
        except (OSError, ValueError, KeyError, TypeError) as error:
            if isinstance(error, OSError) and error.errno not in _LOST:
                raise
            raise DamagedError(path, f"not a complete array ({reason_of(error)})") from error
        self._ahead = ReadAhead(path) if isinstance(path, UrlPath) else None
        # Absolute, because a reader may be sent to a process in another folder.
        self._folder = f"{path.absolute() if isinstance(path, Path) else path}/"

    @property
    def n_chunks(self) -> int:
        """Number of chunks of the array."""
        return math.prod(_grid(self.shape, self.chunks))

    def read_chunk(self, index: Sequence[int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """One whole chunk, padded with the fill value, decoded into ``out``, or DamagedError."""
        if self._memory is not None:
            return self._memory.chunk(index)
        name = _chunk_name(index)
        size, crc = self._index[tuple(index)].item()
        try:
            if self._ahead is None:
                body = read_file(f"{self._folder}{name}", size, self._next(index))
            else:
                body = self._fetch(self._ahead, index)
        except OSError as error:
            if error.errno not in _LOST:
                raise
            what = f"chunk missing ({error.strerror})"
            raise DamagedError(self.path / name, what) from error
        if len(body) != size:
            raise DamagedError(self.path / name, f"{len(body)} bytes where {size} were written")
        if int.from_bytes(body[-4:], "little") != crc or google_crc32c.value(body) != _RESIDUE:
            what = "checksum does not match, the chunk was altered"
            raise DamagedError(self.path / name, what)
        buffer = np.empty(self.chunks, self.dtype) if out is None else out
        try:
            blosc.decompress(memoryview(body)[:-4], buffer)
        except (RuntimeError, ValueError) as error:
            raise DamagedError(self.path / name, f"cannot be decoded ({error})") from error
        self.chunks_read += 1
        return buffer

    def _next(self, index: Sequence[int]) -> str | None:
        """File of the chunk to read after the next one, if reading proceeds in time."""
        first, *rest = index
        if first + 2 >= len(self._index):
            return None
        return f"{self._folder}{_chunk_name((first + 2, *rest))}"

    def _fetch(self, ahead: ReadAhead, index: Sequence[int]) -> bytes:
        """Content of a chunk at a URL; starts to fetch those that follow in time."""
        first, *rest = index
        places = [(n, *rest) for n in range(first, min(first + 1 + AHEAD, len(self._index)))]
        file, *following = [(_chunk_name(at), int(self._index[at]["size"])) for at in places]
        return ahead.read(file, following)

    def read(self, *ranges: tuple[int, int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """A block, given (start, stop) of the first axes; fastest if aligned to chunks."""
        full = [(0, n) for n in self.shape]
        full[: len(ranges)] = [(max(0, a), min(b, n)) for (a, b), (_, n) in zip(ranges, full)]  # noqa: B905
        block = np.empty(tuple(b - a for a, b in full), self.dtype) if out is None else out
        if self._memory is not None:
            block[...] = self._memory.values[tuple(slice(*ends) for ends in full)]
            return block
        scratch = np.empty(self.chunks, self.dtype)
        for index in self._within(full):
            chunk = self.read_chunk(index, scratch)
            source, target = [], []
            for i, c, (a, b) in zip(index, self.chunks, full, strict=True):
                lo, hi = max(a, i * c), min(b, (i + 1) * c)
                source.append(slice(lo - i * c, hi - i * c))
                target.append(slice(lo - a, hi - a))
            block[tuple(target)] = chunk[tuple(source)]
        return block

    def _within(self, ranges: Sequence[tuple[int, int]]) -> Iterator[tuple[int, ...]]:
        """Indices of the chunks that contain a block."""
        return product(
            *(range(a // c, -(-b // c)) for (a, b), c in zip(ranges, self.chunks, strict=True))
        )


class CachedReader(ArrayReader):
    """An `ArrayReader` that keeps chosen chunks in memory; in another process it keeps none."""

    def __init__(self, path: Place, *, keeps: bool = True) -> None:
        super().__init__(path)
        self._keeps = keeps
        self._kept: dict[tuple[int, ...], NDArray[Any]] = {}

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(CachedReader, keeps=False), (self.path,)

    def keep(self, index: Sequence[int]) -> NDArray[Any]:
        """Read a chunk and keep it for later calls of `read_chunk`."""
        key = tuple(index)
        if not self._keeps:
            return super().read_chunk(key)
        if key not in self._kept:
            self._kept[key] = super().read_chunk(key)
        return self._kept[key]

    def keep_block(self, *ranges: tuple[int, int]) -> None:
        """Keep the chunks of a block, given one (start, stop) for each of the last axes."""
        whole = [(0, n) for n in self.shape[: len(self.shape) - len(ranges)]]
        for index in self._within([*whole, *ranges]):
            self.keep(index)

    def holds(self, index: Sequence[int]) -> bool:
        """Whether a chunk is in memory."""
        return tuple(index) in self._kept

    def read_chunk(self, index: Sequence[int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """As `ArrayReader.read_chunk`; a kept chunk is returned itself and must not be changed."""
        kept = self._kept.get(tuple(index))
        return super().read_chunk(index, out) if kept is None else kept
