"""Samples of FITS frames: bands of rows of given planes, read directly from their byte offset.

This works for plain files only. Compressed ones are first unpacked, once, by `unpack`.
"""

import gzip
import io
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, BinaryIO

import google_crc32c
import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pixcal.model.arrays import F32, F64
from pixcal.model.errors import InputError, reason_of
from pixcal.storage.cube import CHUNK
from pixcal.storage.fits_in import damaged_gzip
from pixcal.storage.frame_file import FrameFile, SampleFormat
from pixcal.storage.sources import SourceFile, reading
from pixcal.storage.tiff_png import picture_bytes, unpack_picture

BAND = CHUNK[1]  # rows with a common checksum: those of a chunk

FACTS = {
    "crc": "CRC-32C of the bytes",
    "largest": "largest sample, adu",
    "last": "last sample, adu",
    "share": "share of the last row that equals the last sample",
    "constant": "rows at the end that hold nothing but the last sample",
}  # what is found of every `BAND` rows of a frame


def by_fact(catalogue: F64) -> dict[str, F64]:
    """Facts (time, band) by name, from a catalogue (time, band, fact)."""
    return dict(zip(FACTS, np.moveaxis(catalogue, -1, 0), strict=True))


_PIECE = 1 << 20  # bytes to read at a time


def bands(rows: tuple[int, int]) -> list[tuple[int, int]]:
    """Rows (first, one after the last) of each band; the last band may have fewer rows."""
    return [(y, min(y + BAND, rows[1])) for y in range(*rows, BAND)]


def read_rows(
    file: FrameFile,
    planes: Sequence[int],
    rows: tuple[int, int],
    out: NDArray[Any] | None = None,
    *,
    crc_alone: bool = False,
) -> F64:
    """Read rows of given planes of a plain file, each byte once.

    Returns (plane, band, fact): `FACTS` of each `BAND` rows, NaN where not looked for. ``rows``:
    first, which begins a band, and the one after the last. ``out``: (plane, y, x), ADU; each plane
    contiguous, of the file's type or one that holds it. ``crc_alone``: leave out the other facts,
    which double the time. Raises InputError if the file was changed, or ends too early.
    """
    _, ny, nx = file.shape
    coding, within = file.coding, bands(rows)
    stored, each = coding.stored, rows_at_once(file) // BAND
    facts = np.full((len(planes), len(within), len(FACTS)), np.nan)
    scratch, spare = np.empty((2, min(each * BAND, rows[1] - rows[0]), nx), stored)
    direct = out is not None and coding.exact and out.dtype == coding.dtype
    with file.source.open() as handle:
        for (n, plane), first in product(enumerate(planes), range(0, len(within), each)):
            some = within[first : first + each]
            y0, y1 = some[0][0], some[-1][1]
            target = None if out is None else out[n, y0 - rows[0] : y1 - rows[0]]
            raw = scratch[: y1 - y0]
            start = file.offset + (plane * ny + y0) * nx * stored.itemsize
            _read_exactly(handle, start, raw, file.source.path)
            parts = [slice(a - y0, b - y0) for a, b in some]
            of_bands = facts[n, first : first + each]
            of_bands[:, 0] = [google_crc32c.value(raw[part]) for part in parts]
            # In stored form: swapping bytes and sign bits takes longer than finding the facts.
            values, zero = raw.view(stored.newbyteorder(">")), coding.bzero
            if target is not None or not coding.exact:
                native = spare[: y1 - y0]
                if direct and target is not None:
                    native = target.view(stored)
                _make_native(raw, coding, native)
                converted = native.view(coding.dtype) if coding.exact else _scale(native, coding)
                if target is not None and not direct:
                    target[...] = converted
                if not coding.exact:
                    values, zero = converted, 0.0
            if not crc_alone:
                of_bands[:, 1:] = [_largest_and_ending(values[part], zero) for part in parts]
        # A file written to since it was opened is invalid.
        file.source.check_read(handle)
    return facts


def rows_at_once(file: FrameFile) -> int:
    """Rows, in bands (more than one), that `read_rows` holds at a time, within a core's cache."""
    return BAND * max(1, _PIECE // (BAND * file.shape[2] * file.coding.stored.itemsize))


def _largest_and_ending(values: NDArray[Any], zero: float) -> tuple[float, float, float, int]:
    """The facts of a band other than its checksum, of samples less ``zero``."""
    bits = values.view(f"u{values.itemsize}")  # NaN equals itself
    largest, last = float(np.fmax.reduce(values, axis=None)) + zero, float(values[-1, -1]) + zero
    share = np.count_nonzero(bits[-1] == bits[-1, -1]) / bits.shape[1]
    if share < 1:
        return largest, last, share, 0
    same = (bits == bits[-1, -1]).all(axis=1)
    return largest, last, share, len(same) if same.all() else int(same[::-1].argmin())


def _make_native(raw: NDArray[Any], coding: SampleFormat, native: NDArray[Any]) -> None:
    """Convert samples to native byte order, with the sign bit flipped if the values need it."""
    bits, flipped = (samples.view(f"u{raw.itemsize}") for samples in (raw, native))
    # In two steps: flipping bits and swapping bytes at once takes twice as long.
    np.copyto(flipped, bits.view(bits.dtype.newbyteorder(">")))
    if coding.exact and coding.bzero:
        # The BZERO that makes unsigned integers of signed ones, and the reverse.
        flipped ^= flipped.dtype.type(1 << (8 * raw.itemsize - 1))


def _read_exactly(handle: io.FileIO, start: int, raw: NDArray[Any], path: Path) -> None:
    view = raw.data.cast("B")
    read = 0
    with reading(path):
        handle.seek(start)
        while read < len(view):
            count = handle.readinto(view[read:])
            if not count:
                raise InputError(f"{path}: cut short while it was being read; copy it again")
            read += count


def _scale(raw: NDArray[Any], coding: SampleFormat) -> F32:
    values = raw.astype(np.float64)
    values *= coding.bscale
    values += coding.bzero
    if coding.blank is not None:
        values[raw == coding.blank] = np.nan
    return values.astype(np.float32)


def unpack(file: FrameFile, target: Path) -> FrameFile:
    """Write a compressed file's image as raw big-endian samples; return that file."""
    with file.source.open() as handle, target.open("wb") as out:
        if file.container == "picture":
            unpack_picture(file, out)
        elif file.container == "gzip":
            _unpack_gzip(file, handle, out)
        else:
            _unpack_tiles(file, out)
        file.source.check_read(handle)
    facts = target.stat()
    if facts.st_size != file.data_bytes:
        raise InputError(
            f"{file.source.path}: {facts.st_size} bytes once unpacked where its header calls for "
            f"{file.data_bytes}; copy it again, or remove it"
        )
    source = SourceFile(target, file.source.name, facts.st_size, facts.st_mtime_ns)
    return replace(file, source=source, container="plain", offset=0)


def unpack_bytes(file: FrameFile) -> int:
    """Memory that `unpack` takes for a file, in bytes (measured, see the tests)."""
    if file.container == "plain":
        return 0
    if file.container == "picture":
        return picture_bytes(file)
    if file.container == "gzip":
        return 4 * _PIECE
    # Decoders hold several copies of a tile; HCOMPRESS, with the most, 7.
    planes, rows = _tiles_at_once(file)
    row_bytes = file.shape[2] * file.coding.stored.itemsize
    return (16 << 20) + 8 * min(planes, file.shape[0]) * min(rows, file.shape[1]) * row_bytes


def _unpack_gzip(file: FrameFile, handle: io.FileIO, out: BinaryIO) -> None:
    left = file.data_bytes
    try:
        with gzip.GzipFile(fileobj=handle) as stream:
            stream.seek(file.offset)
            # Read to the end, beyond the image, where the checksum is.
            while part := stream.read(_PIECE):
                out.write(part[:left])
                left -= min(left, len(part))
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise damaged_gzip(file.source.path, error) from error


def _tiles_at_once(file: FrameFile) -> tuple[int, int]:
    """(planes, rows) decoded at once: whole tiles, about a MiB of them."""
    planes, rows = file.tile
    tile_bytes = planes * rows * file.shape[2] * file.coding.stored.itemsize
    rows *= max(1, _PIECE // tile_bytes)
    # Several small frames at once: astropy reads the header again for each piece.
    return planes * max(1, rows // file.shape[1]), rows


def _unpack_tiles(file: FrameFile, out: BinaryIO) -> None:
    _, ny, nx = file.shape
    big_endian = file.coding.stored.newbyteorder(">")
    for t0, y0, piece in _decoded(file):
        for plane, rows in enumerate(piece, start=t0):
            out.seek((plane * ny + y0) * nx * big_endian.itemsize)
            out.write(rows.astype(big_endian).data)


def _decoded(file: FrameFile) -> Iterator[tuple[int, int, NDArray[Any]]]:
    """Plane, row and (plane, y, x) stored samples of each piece of an image in tiles."""
    n, ny, nx = file.shape
    step_planes, step_rows = _tiles_at_once(file)
    # Without memmap: mapped pages would count as memory until the file is closed.
    options = {"do_not_scale_image_data": True, "memmap": False}
    try:
        with fits.open(file.source.path, **options) as hdus:
            section = hdus[file.hdu].section
            for t0, y0 in product(range(0, n, step_planes), range(0, ny, step_rows)):
                t1, y1 = min(t0 + step_planes, n), min(y0 + step_rows, ny)
                times = [slice(t0, t1) if m > 1 else slice(None) for m in section.shape[:-2]]
                piece = section[(*times, slice(y0, y1))].reshape(t1 - t0, y1 - y0, nx)
                if piece.dtype != file.coding.stored:
                    raise ValueError(f"decoded as {piece.dtype}, header says {file.coding.stored}")
                yield t0, y0, piece
    except Exception as error:  # the decoders raise a dozen kinds, all of which mean one thing
        raise InputError(
            f"{file.source.path}: its tiles cannot be decoded ({reason_of(error)}); copy it again, "
            "or remove it"
        ) from error
