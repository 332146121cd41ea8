"""Maps in FITS files read block by block: one of 46 Mpix need not be in memory."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pixcal.model.errors import DamagedError

_TYPES = {8: ">u1", -32: ">f4", -64: ">f8"}
_PIECE = 8 << 20


@dataclass(frozen=True)
class FitsMap:
    """One image of a FITS file."""

    path: Path
    shape: tuple[int, int]  # (y, x)
    dtype: str  # as stored
    data_at: int  # byte where the image begins

    @classmethod
    def open(cls, path: Path, extension: str | int = 0) -> "FitsMap":
        """Read where the image is, and check that all of it is there and unaltered.

        Raises
        ------
        DamagedError
            If the file is missing, cut, altered (where it has a checksum), or holds no such image.
        """
        try:
            with fits.open(path, memmap=True) as hdus:
                hdu: Any = hdus[extension]
                header = hdu.header
                if header["NAXIS"] != 2 or "BSCALE" in header or "BZERO" in header:
                    raise ValueError("not a plain image of two axes")
                shape = (int(header["NAXIS2"]), int(header["NAXIS1"]))
                found = cls(path, shape, _TYPES[header["BITPIX"]], int(hdu.fileinfo()["datLoc"]))
                if path.stat().st_size < found.data_at + found.n_bytes:
                    raise ValueError("cut short")
                if "DATASUM" in header and int(header["DATASUM"]) != word_sum(
                    path, found.data_at, found.n_bytes
                ):
                    raise ValueError("altered: its checksum does not match")
        except (OSError, LookupError, TypeError, ValueError) as error:
            reason = " ".join(str(error).split())
            message = f"{path}: not a map that this pixcal reads ({reason})"
            raise DamagedError(message, path) from error
        return found

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
                    raise DamagedError(f"{self.path}: cut short while it was read", self.path)
        return block.astype(dtype.newbyteorder("="))


def word_sum(path: Path, start: int, n_bytes: int) -> int:
    """Sum of the 32-bit words of a part of a file in ones' complement (FITS 4.0, appendix J)."""
    total = 0
    with path.open("rb") as file:
        file.seek(start)
        for at in range(0, n_bytes, _PIECE):
            total = add_words(total, file.read(min(_PIECE, n_bytes - at)))
    return total


def add_words(total: int, part: bytes, at: int = 0) -> int:
    """Add the next part of some data, which begins at a byte, to their `word_sum`."""
    part = bytes(at % 4) + part
    words = np.frombuffer(part + bytes(-len(part) % 4), ">u4")
    total += int(words.sum(dtype=np.uint64))
    while total >> 32:
        total = (total & 0xFFFFFFFF) + (total >> 32)
    return total


def encoded(total: int) -> str:
    """The complement of a `word_sum` as CHECKSUM holds it (FITS 4.0, appendix J.2)."""
    columns = []
    for byte in (total ^ 0xFFFFFFFF).to_bytes(4, "big"):
        parts = [byte // 4 + 48 + (byte % 4 if n == 0 else 0) for n in range(4)]
        # Letters and digits only: what one of a pair gains the other loses.
        while any(58 <= c <= 64 or 91 <= c <= 96 for c in parts):
            for n in (0, 2):
                if any(58 <= c <= 64 or 91 <= c <= 96 for c in parts[n : n + 2]):
                    parts[n], parts[n + 1] = parts[n] + 1, parts[n + 1] - 1
        columns.append(parts)
    text = bytes(column[n] for n in range(4) for column in columns).decode("ascii")
    return text[-1] + text[:-1]
