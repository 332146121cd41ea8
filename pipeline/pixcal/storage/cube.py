"""Cubes (time, y, x) on disk: Zarr 3 arrays in whole, checksummed chunks, one writer per chunk.

zarr-python makes the metadata. Chunks in the same format are read and written here, because the
pipeline of zarr-python does not scale with threads. Cubes are in local folders or at URLs. Every
chunk contains a crc32c; an index beside the array holds its size and crc, and ends with a crc of
itself and of the metadata. A missing, cut or exchanged chunk is refused.
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
from numcodecs import Blosc
from numpy.typing import NDArray

from pixcal.model.errors import DamagedError
from pixcal.storage import zarr_format
from pixcal.storage.folder import INDEX, File, copy_files, link_files, open_folder
from pixcal.storage.memory import MemoryArray, MemoryPath
from pixcal.storage.place import Place

CHUNK = (64, 128, 128)  # samples of a chunk along (time, y, x): 2 MiB of uint16


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
    metadata = zarr_format.array_metadata(shape, chunks, dtype.str, fill_value, tuple(dims), text)
    zarr_format.write_metadata(path, metadata)
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


def create_group(path: Place, attrs: dict[str, Any] | None = None) -> None:
    """Create a Zarr group (a folder that xarray opens as a dataset) if it does not exist."""
    if isinstance(path, MemoryPath):
        return
    zarr_format.write_metadata(path, zarr_format.group_metadata(json.dumps(attrs or {})))


def write_array(path: Place, data: NDArray[Any], **options: Any) -> None:
    """Write a whole small array (maps, coordinates) at once; options as `create_array`."""
    options.setdefault("chunks", tuple(max(1, min(1024, n)) for n in data.shape))
    writer = create_array(path, data.shape, data.dtype, **options)
    writer.write(tuple(0 for _ in data.shape), data)
    writer.finish()


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
        for offset in product(*map(range, zarr_format.grid_of(data.shape, self.chunks))):
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
            name = zarr_format.chunk_name([f + o for f, o in zip(first, offset, strict=True)])
            yield name, (body, crc.to_bytes(4, "little"))

    def take(self, source: Place) -> None:
        """Link or copy the chunks of another such array, unchecked; existing chunks stay."""
        if isinstance(source, Path) and isinstance(self.path, Path):
            link_files(source / "c", self.path / "c")
            return
        for names in zarr_format.chunk_names(zarr_format.grid_of(self.shape, self.chunks)):
            copy_files(source, self.path, names)

    def finish(self) -> NDArray[Any]:
        """Check that every chunk is there, write the index and return it (``size``, ``crc``).

        Raises DamagedError naming the first chunk that is missing or cut.
        """
        grid = zarr_format.grid_of(self.shape, self.chunks)
        index = np.zeros(grid, zarr_format.INDEX_DTYPE)
        if isinstance(self.path, MemoryPath):
            return index
        folder = open_folder(self.path)
        for first, names in enumerate(zarr_format.chunk_names(grid)):
            rows = []
            try:
                for name, (size, tail) in zip(names, folder.ends(names), strict=True):
                    if len(tail) < 4:
                        raise DamagedError(self.path / name, "truncated chunk")
                    rows.append((size, int.from_bytes(tail, "little")))
            except OSError as error:
                if error.errno not in zarr_format.LOST_ERRORS:
                    raise
                raise DamagedError(error.filename, f"chunk missing ({error.strerror})") from error
            index[first] = np.array(rows, zarr_format.INDEX_DTYPE).reshape(grid[1:])
        body = BytesIO()
        np.save(body, index)
        content = body.getvalue()
        folder.write([(INDEX, (content, zarr_format.seal(self.metadata, content)))])
        return index


def chunks_whole(folder: Path) -> bool:
    """Whether every chunk below a folder agrees with its crc, in arrays without an index yet."""
    for at, folders, names in os.walk(folder):
        if "zarr.json" in names and "c" in folders:
            folders.clear()
            chunks = (f for f in Path(at, "c").rglob("*") if f.name.isdigit() and f.is_file())
            if any(
                google_crc32c.value(file.read_bytes()) != zarr_format.CRC_RESIDUE for file in chunks
            ):
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
            for names in zarr_format.chunk_names(zarr_format.grid_of(*zarr_format.shapes_of(meta))):
                node.remove(names)
        # Last, so that an interrupted removal can be repeated.
        node.remove([INDEX, "zarr.json"])
