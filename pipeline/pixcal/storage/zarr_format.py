"""Metadata, names and checksums of the chunks of an array."""

import errno
import json
from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import google_crc32c
import numpy as np
import zarr
from numcodecs import blosc
from zarr.codecs import BloscCodec, BytesCodec, Crc32cCodec

from pixcal.storage.folder import open_folder
from pixcal.storage.place import Place

Ints = tuple[int, ...]

# Threads belong to the engine: Blosc must not start its own, nor share a global context.
blosc.use_threads = False

# system errors that mean a damaged file; others may be temporary
LOST_ERRORS = (errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EIO)
CRC_RESIDUE = 0x48674BC7  # CRC-32C of anything that ends with its own CRC-32C, least byte first
INDEX_DTYPE = np.dtype([("size", "<u4"), ("crc", "<u4")])


# Cached: many arrays have the same metadata, and zarr-python takes a millisecond for each.
@lru_cache(maxsize=512)
def array_metadata(
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


@lru_cache(maxsize=512)
def group_metadata(attrs: str) -> bytes:
    """Metadata as zarr-python writes it for a group; attributes as JSON."""
    made: dict[str, Any] = {}
    zarr.create_group(store=made, attributes=json.loads(attrs))
    content: bytes = made["zarr.json"].to_bytes()
    return content


def write_metadata(path: Place, content: bytes) -> None:
    """Write the metadata of an array or a group, unless the same content exists already."""
    try:
        there = (path / "zarr.json").read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        there = b""
    # Metadata of an unfinished build are rewritten: they have no checksum yet.
    if there != content:
        open_folder(path).write([("zarr.json", [content])])


def grid_of(shape: Ints, chunks: Ints) -> Ints:
    """Number of chunks along each axis."""
    return tuple(-(-n // c) for n, c in zip(shape, chunks, strict=True))


def shapes_of(metadata: dict[str, Any]) -> tuple[Ints, Ints]:
    """Shapes of an array and of its chunks."""
    chunks = metadata["chunk_grid"]["configuration"]["chunk_shape"]
    return tuple(metadata["shape"]), tuple(chunks)


def seal(metadata: bytes, index: bytes) -> bytes:
    """Checksum of an array's metadata and index, kept at the end of the index."""
    seal: int = google_crc32c.value(metadata + index)
    return seal.to_bytes(4, "little")


def chunk_name(index: Sequence[int]) -> str:
    """Name of a chunk below the array's folder."""
    return "/".join(["c", *map(str, index)])


def chunk_names(grid: Ints) -> Iterator[list[str]]:
    """Names of all chunks, by steps along the first axis."""
    for first in range(grid[0]):
        yield [chunk_name((first, *rest)) for rest in np.ndindex(grid[1:])]
