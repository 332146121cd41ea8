"""Writing FITS images piece by piece, from several tasks.

A file is written under another name (hidden, ``.aside``) and renamed when it is complete and on
disk: a file that exists is whole.
"""

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pixcal.storage.folder import aside_of, written_aside

Cards = Mapping[str, Any]  # header keywords: a value, or (value, comment)

BLOCK = 2880
COMPRESSED = ".fits.fz"


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
