"""FITS images: maps of a detector, and frames; one of 46 Mpix need not be in memory.

Maps are written a band of rows at a time, frames piece by piece from several tasks, under another
name (hidden, ``.aside``). A file is renamed when it is complete: one that exists is whole.
"""

import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from pixcal import __version__
from pixcal.model.arrays import F32, U8, Source
from pixcal.model.errors import DamagedError, reason_of
from pixcal.model.flags import PixelFlag
from pixcal.storage.folder import aside_of, written_aside

BLOCK = 2880
COMPRESSED = ".fits.fz"
_TYPES = {8: ">u1", -32: ">f4", -64: ">f8"}
_PIECE = 1 << 20


@dataclass(frozen=True)
class FitsMap:
    """One image of a FITS file."""

    path: Path
    shape: tuple[int, int]  # (y, x)
    dtype: str  # as stored
    data_at: int  # byte where the image begins

    @classmethod
    def open(cls, path: Path, extension: str | int = 0) -> "FitsMap":
        """Locate an image; DamagedError if it is missing, cut or altered."""
        try:
            with fits.open(path, memmap=True) as hdus:
                hdu: Any = hdus[extension]
                header = hdu.header
                if header["NAXIS"] != 2 or "BSCALE" in header or "BZERO" in header:
                    raise ValueError("not a plain image of two axes")
                shape = (int(header["NAXIS2"]), int(header["NAXIS1"]))
                image = cls(path, shape, _TYPES[header["BITPIX"]], int(hdu.fileinfo()["datLoc"]))
                if path.stat().st_size < image.data_at + image.n_bytes:
                    raise ValueError("cut short")
                if "DATASUM" in header:
                    filled = -(-image.n_bytes // BLOCK) * BLOCK
                    with path.open("rb") as file:
                        if int(header["DATASUM"]) != word_sum(file, image.data_at, filled):
                            raise ValueError("altered: its checksum does not match")
        except (OSError, LookupError, TypeError, ValueError) as error:
            raise _not_a_map(path, error) from error
        return image

    @property
    def n_bytes(self) -> int:
        """Bytes of the image."""
        return self.shape[0] * self.shape[1] * np.dtype(self.dtype).itemsize

    def read(self, y: tuple[int, int], x: tuple[int, int]) -> NDArray[Any]:
        """A block, given (start, stop) of rows and of columns, in the machine's byte order."""
        dtype = np.dtype(self.dtype)
        block = np.empty((y[1] - y[0], x[1] - x[0]), dtype)
        with self.path.open("rb", buffering=0) as file:
            for row, values in zip(range(*y), block, strict=True):
                file.seek(self.data_at + (row * self.shape[1] + x[0]) * dtype.itemsize)
                if file.readinto(values.view(np.uint8)) != values.nbytes:
                    raise DamagedError(self.path, "cut short while it was read")
        return block.astype(dtype.newbyteorder("="))


def _not_a_map(path: Path, error: Exception) -> DamagedError:
    return DamagedError(path, f"not a map that this version reads ({reason_of(error)})")


def word_sum(file: BinaryIO, start: int, n_bytes: int) -> int:
    """Sum of the 32-bit words of a part of a file in ones' complement (FITS 4.0, appendix J)."""
    file.seek(start)
    sizes = (min(_PIECE, n_bytes - at) for at in range(0, n_bytes, _PIECE))
    total = sum(int(np.fromfile(file, ">u4", n // 4).sum(dtype=np.uint64)) for n in sizes)
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def encoded(total: int) -> str:
    """The complement of a `word_sum` in the format of CHECKSUM (FITS 4.0, appendix J.2)."""
    columns = []
    for byte in (total ^ 0xFFFFFFFF).to_bytes(4, "big"):
        parts = [byte // 4 + 48 + (byte % 4 if n == 0 else 0) for n in range(4)]
        # Letters and digits only: one of a pair is increased and the other decreased.
        while any(58 <= c <= 64 or 91 <= c <= 96 for c in parts):
            for n in (0, 2):
                if any(58 <= c <= 64 or 91 <= c <= 96 for c in parts[n : n + 2]):
                    parts[n], parts[n + 1] = parts[n] + 1, parts[n + 1] - 1
        columns.append(parts)
    text = bytes(column[n] for n in range(4) for column in columns).decode("ascii")
    return text[-1] + text[:-1]


BAND = 128  # rows written at a time: those of a chunk

Card = tuple[str, Any, str]
Cards = Mapping[str, Any]  # header keywords: a value, or (value, comment)
_NOT_A_MAP = (OSError, KeyError, TypeError, ValueError, AstropyUserWarning, fits.VerifyError)


def write_map(
    path: Path,
    data: Source | F32,
    sigma: Source | F32,
    mask: Source | U8,
    cards: Sequence[Card],
    history: Sequence[str] = (),
) -> None:
    """Write a map with its errors and flags, a band of rows at a time; ``path`` is replaced.

    ``data, sigma``: (y, x) px, NaN where masked. ``mask``: (y, x) `PixelFlag`. ``cards``: (key,
    value, comment).
    """
    # Headers of images of this shape, without allocating them.
    maps, flags_ = (np.broadcast_to(np.zeros((), t), data.shape) for t in (">f4", "u1"))
    primary, errors = fits.PrimaryHDU(maps), fits.ImageHDU(maps, name="SIGMA")
    flags = fits.ImageHDU(flags_, name="MASK")
    primary.header["BUNIT"] = ("pixel", "offset from the perfect grid")
    primary.header["CREATOR"] = (f"pixcal {__version__}", "program that wrote this file")
    for key, value, comment in cards:
        primary.header[key] = (value, comment)
    for line in history:
        primary.header.add_history(line)
    errors.header["BUNIT"] = ("pixel", "1-sigma error")
    for flag in PixelFlag:
        flags.header[f"FLAG{flag.value.bit_length()}"] = (flag.value, (flag.name or "").lower())
    path.parent.mkdir(parents=True, exist_ok=True)
    with written_aside(path) as aside, aside.open("w+b") as file:
        for hdu, source in ((primary, data), (errors, sigma), (flags, mask)):
            _write_image(file, hdu.header, source)


def _write_image(file: BinaryIO, header: fits.Header, source: Source | NDArray[Any]) -> None:
    """Append an image; its header holds the checksums."""
    # No time in the comments, so that equal maps have equal bytes.
    header["CHECKSUM"] = ("0" * 16, "by pixcal")
    header["DATASUM"] = ("0", "by pixcal")
    begin = file.tell()
    file.write(header.tostring(padding=True).encode("ascii"))
    data_at = file.tell()
    for y in range(0, source.shape[0], BAND):
        rows = (y, min(y + BAND, source.shape[0]))
        band = source[slice(*rows)] if isinstance(source, np.ndarray) else source.read(rows)
        file.write(band.astype(band.dtype.newbyteorder(">")).tobytes())
    file.write(bytes(-file.tell() % BLOCK))
    end = file.tell()
    for key, start, text in (("DATASUM", data_at, str), ("CHECKSUM", begin, encoded)):
        header[key] = text(word_sum(file, start, end - start))
        file.seek(begin)
        file.write(header.tostring(padding=True).encode("ascii"))
    file.seek(end)


def is_whole(path: Path) -> bool:
    """Whether a map exists and is unaltered, header and data."""
    try:
        with _checked(path):
            return True
    except _NOT_A_MAP:
        return False


@contextmanager
def _checked(path: Path) -> Iterator[fits.HDUList]:
    """The images of a file, verified by checksum."""
    # CHECKSUM makes the sum of each header and data unit, and so of the file, minus zero.
    size = path.stat().st_size
    with path.open("rb") as file:
        if size % BLOCK or word_sum(file, 0, size) != 0xFFFFFFFF:
            raise ValueError("altered: its checksum does not match")
    with warnings.catch_warnings():
        # astropy reports a truncated file by this warning.
        warnings.simplefilter("error", AstropyUserWarning)
        with fits.open(path) as hdus:
            if [hdu.name for hdu in hdus] != ["PRIMARY", "SIGMA", "MASK"]:
                raise ValueError("not the images that pixcal writes")
            yield hdus


def read_map(path: Path) -> tuple[F32, F32, U8, dict[str, Any]]:
    """Read a map of `write_map`: data, sigma, mask, primary header; DamagedError if altered."""
    try:
        with _checked(path) as hdus:
            header = {
                k: v for k, v in hdus[0].header.items() if k not in ("HISTORY", "COMMENT", "")
            }
            data = np.array(hdus[0].data, dtype=np.float32)
            sigma = np.array(hdus["SIGMA"].data, dtype=np.float32)
            mask = np.array(hdus["MASK"].data, dtype=np.uint8)
    except _NOT_A_MAP as error:
        raise _not_a_map(path, error) from error
    return data, sigma, mask, header


# Frames


@dataclass(frozen=True)
class FrameWriter:
    """A FITS image that is written in pieces, from any thread or process that sees the folder."""

    path: Path  # name of the file once it is complete
    shape: tuple[int, ...]  # (y, x), or (time, y, x) for a cube
    dtype: str  # `uint16` (through BZERO), `uint8` or `float32`
    data_at: int  # byte where the data begin

    @classmethod
    def create(
        cls, path: Path, shape: tuple[int, ...], dtype: str, cards: Cards | None = None
    ) -> "FrameWriter":
        """Write the header and allocate the space on disk; OSError if there is none."""
        header = _header(shape, dtype, cards or {}).tostring(padding=True).encode("ascii")
        data_bytes = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        blocks = -(-data_bytes // BLOCK)
        with aside_of(path).open("wb") as file:
            file.write(header)
            file.flush()
            os.posix_fallocate(file.fileno(), 0, len(header) + blocks * BLOCK)
        return cls(path, shape, dtype, len(header))

    def write_rows(self, row: int, data: NDArray[Any], plane: int = 0) -> None:
        """Write whole rows (rows, x) of a plane; different ones may be written at the same time."""
        ny, nx = self.shape[-2:]
        if data.dtype != self.dtype or data.shape[1] != nx or row + data.shape[0] > ny:
            raise ValueError(f"{self.path}: {data.dtype} {data.shape} at row {row} does not fit")
        stored = data ^ np.uint16(0x8000) if self.dtype == "uint16" else data  # as BZERO does
        body = stored.astype(stored.dtype.newbyteorder(">"), order="C").data.cast("B")
        at = self.data_at + (plane * ny + row) * nx * data.itemsize
        with aside_of(self.path).open("r+b", buffering=0) as file:
            while body:
                done = os.pwrite(file.fileno(), body, at)
                body, at = body[done:], at + done

    def finish(self) -> Path:
        """Put the file in place, once all rows are written."""
        with written_aside(self.path, durable=True):
            return self.path

    def finish_compressed(self) -> Path:
        """Put the file in place tile-compressed (RICE, lossless for integers), as ``.fits.fz``."""
        plain, packed = aside_of(self.path), self.path.with_name(self.path.stem + COMPRESSED)
        with written_aside(packed, durable=True) as aside, fits.open(plain, memmap=False) as file:
            image = file[0]
            tile = (1,) * (len(self.shape) - 2) + (min(16, self.shape[-2]), self.shape[-1])
            fits.CompImageHDU(
                image.data, image.header, compression_type="RICE_1", tile_shape=tile
            ).writeto(aside, overwrite=True)
        plain.unlink()
        return packed


def ascii_text(text: str) -> str:
    """Text as a header can hold it: ASCII, at most 60 characters."""
    return text.encode("ascii", "replace").decode()[:60]


def _header(shape: tuple[int, ...], dtype: str, cards: Cards) -> fits.Header:
    header = fits.Header()
    header["SIMPLE"] = (True, "conforms to FITS standard")
    header["BITPIX"] = ({"uint16": 16, "uint8": 8, "float32": -32}[dtype], "array data type")
    header["NAXIS"] = len(shape)
    for number, length in enumerate(reversed(shape), start=1):
        header[f"NAXIS{number}"] = length
    if dtype == "uint16":
        header["BSCALE"] = 1
        header["BZERO"] = (32768, "unsigned 16-bit samples")
    for key, card in cards.items():
        header[key] = card
    return header
