"""Blocks of cubes, read chunk by chunk; every chunk is checked."""

import asyncio
import json
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from functools import partial
from itertools import product
from pathlib import Path
from threading import local
from typing import Any

import google_crc32c
import numpy as np
from numcodecs import blosc
from numpy.typing import NDArray

from pixcal.model.errors import DamagedError, reason_of
from pixcal.storage import zarr_format
from pixcal.storage.folder import INDEX, read_file
from pixcal.storage.memory import MemoryPath
from pixcal.storage.place import Place, UrlPath, explained

File = tuple[str, int]  # name and size (bytes)

AHEAD = 4  # files in transit while one is decoded
_KEPT = 2 * AHEAD  # most waiting files per thread; those of an abandoned column are never used


class ReadAhead:
    """Reads files below a URL, and prefetches following ones after two reads in order.

    An object store has high latency, but serves many requests.
    """

    def __init__(self, path: UrlPath) -> None:
        self.path = path
        self._thread = local()

    def __reduce__(self) -> tuple[type["ReadAhead"], tuple[UrlPath]]:
        return ReadAhead, (self.path,)

    def expected(self) -> dict[File, Future[bytes] | None]:
        """Files that this thread may read next, with their transfers if begun."""
        files: dict[File, Future[bytes] | None] = self._thread.__dict__.setdefault("expected", {})
        return files

    def read(self, file: File, following: Sequence[File]) -> bytes:
        """Content of a file, little more than its size; those ``following`` are read next."""
        expected = self.expected()
        in_order = file in expected
        fetched = expected.pop(file, None)
        for later in following if in_order else following[:1]:
            if expected.get(later) is None:
                expected[later] = self._fetch(later) if in_order else None
        while len(expected) > _KEPT:
            expected.pop(next(iter(expected)))
        if fetched is None:
            return (self.path / file[0]).read_bytes(file[1] + 1)
        with explained(f"{self.path}/{file[0]}"):
            return fetched.result()

    def _fetch(self, file: File) -> Future[bytes] | None:
        """Start an asynchronous read, if the file system supports it."""
        name, size = file
        system, path = (self.path / name).filesystem()
        if not system.async_impl:
            return None
        # On the loop that fsspec runs in its own thread.
        reading = system._cat_file(path, start=0, end=size + 1)
        return asyncio.run_coroutine_threadsafe(reading, system.loop)


class ArrayReader:
    """Reads blocks of an array written by `ArrayWriter`, checking every chunk.

    Raises DamagedError if metadata or index are missing, cut or altered, RemoteError if the URL
    does not answer.
    """

    def __init__(self, path: Place) -> None:
        self.path = path
        self.chunks_read = 0
        self.shape: zarr_format.Ints
        self.chunks: zarr_format.Ints
        self._memory = path.array if isinstance(path, MemoryPath) else None
        if self._memory is not None:
            self.shape, self.chunks = self._memory.values.shape, self._memory.chunks
            self.dtype, self.attrs = self._memory.values.dtype, self._memory.attrs
            return
        try:
            body = (path / INDEX).read_bytes()
            metadata = (path / "zarr.json").read_bytes()
            if zarr_format.seal(metadata, body[:-4]) != body[-4:]:
                raise ValueError(f"zarr.json or {INDEX} was altered")
            # The seal guarantees zarr's metadata, so zarr's event loop is not needed, which is slow
            # when many threads open many arrays.
            meta = json.loads(metadata)
            self.shape, self.chunks = zarr_format.shapes_of(meta)
            self.dtype, self.attrs = np.dtype(meta["data_type"]), meta["attributes"]
            count = self.n_chunks
            # Not np.load: parsing its header as Python is not safe in the threads of a Dask worker,
            # where callbacks of the garbage collector come in between (CPython 3.11, gh-106905).
            begin = len(body) - 4 - count * zarr_format.INDEX_DTYPE.itemsize
            index = np.frombuffer(body, zarr_format.INDEX_DTYPE, count, begin)
            self._index = index.reshape(zarr_format.grid_of(self.shape, self.chunks))
        except (OSError, ValueError, KeyError, TypeError) as error:
            if isinstance(error, OSError) and error.errno not in zarr_format.LOST_ERRORS:
                raise
            raise DamagedError(path, f"not a complete array ({reason_of(error)})") from error
        self._ahead = ReadAhead(path) if isinstance(path, UrlPath) else None
        # Absolute, because a reader may be sent to a process in another folder.
        self._folder = f"{path.absolute() if isinstance(path, Path) else path}/"

    @property
    def n_chunks(self) -> int:
        """Number of chunks of the array."""
        return math.prod(zarr_format.grid_of(self.shape, self.chunks))

    def read_chunk(self, index: Sequence[int], out: NDArray[Any] | None = None) -> NDArray[Any]:
        """One whole chunk, padded with the fill value, decoded into ``out``, or DamagedError."""
        if self._memory is not None:
            return self._memory.chunk(index)
        name = zarr_format.chunk_name(index)
        size, crc = self._index[tuple(index)].item()
        try:
            if self._ahead is None:
                body = read_file(f"{self._folder}{name}", size, self._next(index))
            else:
                body = self._fetch(self._ahead, index)
        except OSError as error:
            if error.errno not in zarr_format.LOST_ERRORS:
                raise
            what = f"chunk missing ({error.strerror})"
            raise DamagedError(self.path / name, what) from error
        if len(body) != size:
            raise DamagedError(self.path / name, f"{len(body)} bytes where {size} were written")
        if (
            int.from_bytes(body[-4:], "little") != crc
            or google_crc32c.value(body) != zarr_format.CRC_RESIDUE
        ):
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
        return f"{self._folder}{zarr_format.chunk_name((first + 2, *rest))}"

    def _fetch(self, ahead: ReadAhead, index: Sequence[int]) -> bytes:
        """Content of a chunk at a URL; starts to fetch those that follow in time."""
        first, *rest = index
        places = [(n, *rest) for n in range(first, min(first + 1 + AHEAD, len(self._index)))]
        file, *following = [
            (zarr_format.chunk_name(at), int(self._index[at]["size"])) for at in places
        ]
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
