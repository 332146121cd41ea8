"""Contents of a FITS file of a bench, read from its header and checked against its length.

No data are read here: all files of an acquisition can be checked in seconds before hours of reading
begin. `pixcal.storage.frame_decoding` reads the samples.
"""

import gzip
import io
import math
import sys
import zlib
from pathlib import Path

from astropy.io import fits

from pixcal.model.errors import InputError, reason_of
from pixcal.storage.frame_file import STORED, Container, FrameFile, SampleFormat
from pixcal.storage.header_values import (
    Header,
    exposure_s,
    integer,
    number,
    temperature_c,
    time_stamp_mjd,
)
from pixcal.storage.sources import SourceFile, reading

_Stream = io.BufferedReader | gzip.GzipFile

_BLOCK = 2880


def inspect(source: SourceFile) -> FrameFile:
    """Read a file's header and check it against the file's length.

    The image is the first data unit of 2-D or 3-D. Raises InputError naming the file: not FITS,
    truncated, no image, dimensions or types unsuitable for frames.
    """
    with source.open() as handle, reading(source.path):
        try:
            packed = handle.read(2) == b"\x1f\x8b"
            handle.seek(0)
            if not packed:
                return _inspect_stream(source, io.BufferedReader(handle), "plain")
            with gzip.GzipFile(fileobj=handle) as stream:
                file = _inspect_stream(source, stream, "gzip")
            _check_gzip_length(file, handle)
            return file
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise damaged_gzip(source.path, error) from error
        except fits.VerifyError as error:
            reason = reason_of(error).partition(",")[0]
            raise InputError(
                f"{source.path}: damaged header ({reason}); copy it again, or remove it"
            ) from error
        except ValueError as error:
            raise InputError(f"{source.path}: {reason_of(error)}") from error


def damaged_gzip(path: Path, error: Exception) -> InputError:
    """The InputError for a gzip file that is cut or altered."""
    reason = "cut short" if isinstance(error, EOFError) else reason_of(error)
    return InputError(f"{path}: damaged gzip file ({reason}); copy it again, or remove it")


def _inspect_stream(source: SourceFile, stream: _Stream, container: Container) -> FrameFile:
    header, primary, hdu = _first_image(source, stream)
    offset = stream.tell()
    tiled = _is_tiled(header)
    if tiled and container == "gzip":
        raise ValueError("both tile-compressed and gzip-compressed; unpack it with gunzip")
    prefix = "Z" if tiled else ""
    headers = (header, primary)
    file = FrameFile(
        source,
        "tiles" if tiled else container,
        hdu,
        offset,
        _frames_shape(_axes(header, prefix)),
        _coding(header, prefix),
        tile=_tile(header) if tiled else (1, 1),
        mjd=time_stamp_mjd(headers),
        exptime_s=exposure_s(headers),
        temperature_c=temperature_c(headers),
    )
    needed = offset + (_data_bytes(header) if tiled else file.data_bytes)
    if file.container != "gzip":
        _require(source, needed)
        _check_rest(stream, needed)
    return file


def _require(source: SourceFile, needed: int) -> None:
    if source.size < needed:
        raise ValueError(
            f"cut short: {source.size} bytes where its header calls for {needed}; copy it again, "
            "or remove it"
        )


def _check_rest(stream: _Stream, end: int) -> None:
    """Refuse data after the image, which its header does not account for."""
    stream.seek(end)
    fill, following = stream.read(-end % _BLOCK), stream.read(_BLOCK)
    extension = following.startswith(b"XTENSION")
    # Constant fill is not data: zeros by the standard, blanks from some writers.
    if len(set(fill)) > 1 or (len(set(following)) > 1 and not extension):
        raise ValueError(
            f"its header describes {end} bytes, but the file holds more; correct NAXISn and "
            "BITPIX, or remove the file"
        )


def _first_image(source: SourceFile, stream: _Stream) -> tuple[Header, Header, int]:
    """Header of the first image with data, where the stream is left; primary header; its number."""
    primary = header = _read_header(stream, b"SIMPLE")
    if primary is None:
        raise ValueError("not a FITS file (nor TIFF or PNG); remove it, or narrow its glob")
    hdu = 0
    while header is not None:
        if _is_tiled(header) or _is_image(header):
            return header, primary, hdu
        following = stream.tell() + -(-_data_bytes(header) // _BLOCK) * _BLOCK
        if isinstance(stream, io.BufferedReader):
            _require(source, following)
        stream.seek(min(following, sys.maxsize))
        header = _read_header(stream, b"XTENSION")
        hdu += 1
    raise ValueError("holds no image; remove it, or narrow the glob that lists it")


def _read_header(stream: _Stream, first: bytes) -> Header | None:
    """Next header, or None where none begins with the keyword ``first``."""
    text = bytearray()
    while True:
        block = stream.read(_BLOCK)
        if not text and not block.startswith(first):
            return None
        if len(block) < _BLOCK or len(text) > 400 * _BLOCK:
            raise ValueError("header cut short or damaged; copy it again, or remove it")
        text += block
        if any(block[n : n + 80].rstrip(b" \0") == b"END" for n in range(0, _BLOCK, 80)):
            return Header.of_text(text.decode("latin-1"))


def _is_tiled(header: Header) -> bool:
    return header.get("XTENSION") == "BINTABLE" and header.get("ZIMAGE") is True


def _is_image(header: Header) -> bool:
    kind = "SIMPLE" in header or header.get("XTENSION") == "IMAGE"
    axes = _axes(header)
    return kind and len(axes) > 0 and 0 not in axes


def _axes(header: Header, prefix: str = "") -> list[int]:
    """Lengths of the axes, fastest first."""
    count = integer(header, f"{prefix}NAXIS")
    axes = [integer(header, f"{prefix}NAXIS{n + 1}") for n in range(count)]
    if min(axes, default=0) < 0:
        raise ValueError(f"header key {prefix}NAXISn is negative; copy it again, or remove it")
    return axes


def _data_bytes(header: Header) -> int:
    axes = _axes(header)
    samples = math.prod(axes) if axes else 0
    groups, extra = integer(header, "GCOUNT", 1), integer(header, "PCOUNT", 0)
    if min(groups, extra) < 0:
        raise ValueError("header key GCOUNT or PCOUNT is negative; copy it again, or remove it")
    return abs(integer(header, "BITPIX")) // 8 * groups * (extra + samples)


def _frames_shape(axes: list[int]) -> tuple[int, int, int]:
    """(planes, y, x) of a frame or a cube; axes of length 1 after the second are dropped."""
    if 0 in axes:
        raise ValueError("an axis has length 0; copy the file again, or remove it")
    later = [n for n in axes[2:] if n != 1]
    if len(axes) < 2 or len(later) > 1:
        lengths = " × ".join(map(str, axes))
        raise ValueError(
            f"{len(axes)}-D data ({lengths}); a file holds one 2-D frame, or a cube with time as "
            "NAXIS3"
        )
    return (later[0] if later else 1, axes[1], axes[0])


def _tile(header: Header) -> tuple[int, int]:
    """(planes, rows) of a compressed tile; one row by default (FITS 4.0, 10.1.1)."""
    lengths = [
        min(integer(header, f"ZTILE{n + 1}", 1), length)
        for n, length in enumerate(_axes(header, "Z"))
    ]
    return max(1, math.prod(lengths[2:])), max(1, lengths[1])


def _coding(header: Header, prefix: str) -> SampleFormat:
    bitpix = integer(header, f"{prefix}BITPIX")
    if bitpix not in STORED:
        raise ValueError(
            f"BITPIX {bitpix}; frames are 8-, 16- or 32-bit integers or 32-bit floats: convert it"
        )
    scale, zero = number(header, "BSCALE", 1.0), number(header, "BZERO", 0.0)
    if not scale or zero is None:
        raise ValueError(
            "header key BSCALE is zero, or BSCALE or BZERO is not a number; correct the header"
        )
    # Only integers have a BLANK; ZBLANK is the name that compressors give it.
    key = "BLANK" if "BLANK" in header else "ZBLANK"
    blank = integer(header, key) if bitpix > 0 and key in header else None
    return SampleFormat(bitpix, scale, zero, blank)


def _check_gzip_length(file: FrameFile, handle: io.FileIO) -> None:
    """Check a gzip file's length modulo 2^32 (RFC 1952) against the header; unpack if in doubt."""
    handle.seek(-4, io.SEEK_END)
    length = int.from_bytes(handle.read(4), "little")
    needed = file.offset + file.data_bytes
    if length in (needed % 2**32, -(-needed // _BLOCK) * _BLOCK % 2**32):
        return
    handle.seek(0)
    with gzip.GzipFile(fileobj=handle) as stream:
        held = stream.seek(min(needed, sys.maxsize))
        if held < needed:
            raise ValueError(
                f"cut short: {held} bytes once unpacked where its header calls for {needed}; copy "
                "it again, or remove it"
            )
        _check_rest(stream, needed)
