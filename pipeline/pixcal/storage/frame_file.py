"""A file of frames, as its header describes it: FITS, TIFF or PNG."""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from pixcal.storage.sources import SourceFile

Container = Literal["plain", "gzip", "tiles", "picture"]

# FITS 4.0, section 5.2.5 and table 11: offsets to store unsigned integers as signed ones.
_EXACT = {
    (8, 0): "u1",
    (8, -128): "i1",
    (16, 0): "i2",
    (16, 1 << 15): "u2",
    (32, 0): "i4",
    (32, 1 << 31): "u4",
    (-32, 0): "f4",
}
STORED = {8: "u1", 16: "i2", 32: "i4", -32: "f4"}


@dataclass(frozen=True)
class SampleFormat:
    """How samples are coded: value = bscale × stored + bzero."""

    bitpix: int  # FITS code of the stored type
    bscale: float = 1.0  # bscale, bzero: slope and offset (ADU)
    bzero: float = 0.0
    blank: int | None = None  # stored integer that stands for a missing sample

    @cached_property
    def exact(self) -> bool:
        """Whether the values are of a native type, at most with the sign bit flipped."""
        plain = self.bscale == 1 and self.blank is None
        return plain and (self.bitpix, self.bzero) in _EXACT

    @cached_property
    def stored(self) -> np.dtype[Any]:
        """Type of the stored samples, in native byte order."""
        return np.dtype(STORED[self.bitpix])

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Type of the values: float32 if they are scaled or may be missing (NaN)."""
        return np.dtype(_EXACT[self.bitpix, int(self.bzero)] if self.exact else "f4")


@dataclass(frozen=True)
class FrameFile:
    """A file with one frame or a cube of frames."""

    source: SourceFile  # the file
    # ``tiles``: an image compressed by tiles, in a binary table. ``picture``: TIFF or PNG.
    container: Container
    hdu: int  # number of the header and data unit that holds the image
    offset: int  # first byte of its data (after decompression, for ``gzip``)
    shape: tuple[int, int, int]  # (planes, y, x)
    coding: SampleFormat  # how the samples are stored
    # (planes, rows) of a compressed tile; (1, 1) for other containers
    tile: tuple[int, int] = (1, 1)
    mjd: float | None = None  # time stamp of the first plane (modified Julian date, days)
    # exptime_s, temperature_c: exposure time (s) and detector temperature (degrees Celsius)
    exptime_s: float | None = None
    temperature_c: float | None = None

    @property
    def data_bytes(self) -> int:
        """Bytes of the image's samples, uncompressed."""
        return math.prod(self.shape) * self.coding.stored.itemsize
