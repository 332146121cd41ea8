"""The maps that other programs read: FITS, written aside and renamed."""

import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from pixcal import __version__
from pixcal.model.errors import DamagedError
from pixcal.model.flags import PixelFlag
from pixcal.storage.fits_map import add_words, encoded, word_sum

BLOCK = 2880
BAND = 128  # rows written at a time: those of a chunk

Card = tuple[str, Any, str]
_NOT_A_MAP = (OSError, KeyError, TypeError, ValueError, AstropyUserWarning, fits.VerifyError)


class Rows(Protocol):
    """A map (y, x) that is read in bands of rows, as `pixcal.storage.cube.ArrayReader` does."""

    shape: tuple[int, ...]

    def read(self, rows: tuple[int, int], /) -> NDArray[Any]:
        """Rows from one to before another."""


def write_map(
    path: Path,
    data: Rows | NDArray[np.float32],
    sigma: Rows | NDArray[np.float32],
    mask: Rows | NDArray[np.uint8],
    cards: Sequence[Card],
    history: Sequence[str] = (),
) -> None:
    """Write a map with its errors and flags, a band of rows at a time.

    Parameters
    ----------
    path : Path
        Of the FITS file; what is there is replaced once the new file is whole.
    data, sigma : (y, x) float32
        Map and 1-sigma error, px; NaN where masked.
    mask : (y, x) uint8
        Bits of `pixcal.model.flags.PixelFlag`.
    cards : sequence of (key, value, comment)
        For the primary header.
    history : sequence of str
        HISTORY lines of the primary header.
    """
    # Headers of images of this shape, which are nowhere in memory.
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
    aside = path.with_name(f".{path.name}.aside")
    with aside.open("wb") as file:
        for hdu, source in ((primary, data), (errors, sigma), (flags, mask)):
            _write_image(file, hdu.header, source)
    aside.replace(path)


def _write_image(file: BinaryIO, header: fits.Header, source: Rows | NDArray[Any]) -> None:
    """Append an image with its checksums, which stand before it."""
    # Nothing of the time in the comments: equal maps, equal bytes.
    header["CHECKSUM"] = ("0" * 16, "by pixcal")
    header["DATASUM"] = ("0", "by pixcal")
    begin = file.tell()
    file.write(header.tostring(padding=True).encode("ascii"))
    total = 0
    for y in range(0, source.shape[0], BAND):
        rows = (y, min(y + BAND, source.shape[0]))
        band = source[slice(*rows)] if isinstance(source, np.ndarray) else source.read(rows)
        body = band.astype(band.dtype.newbyteorder(">")).tobytes()
        total = add_words(total, body, file.tell() - begin)
        file.write(body)
    file.write(bytes(-file.tell() % BLOCK))
    header["DATASUM"] = str(total)
    text = header.tostring(padding=True).encode("ascii")
    header["CHECKSUM"] = encoded(add_words(total, text))
    file.seek(begin)
    file.write(header.tostring(padding=True).encode("ascii"))
    file.seek(0, os.SEEK_END)


def is_whole(path: Path) -> bool:
    """Whether a map is there and unaltered, header and data."""
    try:
        with _checked(path):
            return True
    except _NOT_A_MAP:
        return False


@contextmanager
def _checked(path: Path) -> Iterator[fits.HDUList]:
    """The images of a file, every bit of which is as it was written."""
    # CHECKSUM makes the sum of each header and data unit, and so of the file, minus zero.
    if word_sum(path, 0, path.stat().st_size) != 0xFFFFFFFF:
        raise ValueError("altered: its checksum does not match")
    with warnings.catch_warnings():
        # How astropy tells of a file that is cut.
        warnings.simplefilter("error", AstropyUserWarning)
        with fits.open(path) as hdus:
            if [hdu.name for hdu in hdus] != ["PRIMARY", "SIGMA", "MASK"]:
                raise ValueError("not the images that pixcal writes")
            yield hdus


def read_map(
    path: Path,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8], dict[str, Any]]:
    """Read a map written by `write_map`: data, sigma, mask, primary header.

    Raises
    ------
    DamagedError
        If the file is missing, cut or altered.
    """
    try:
        with _checked(path) as hdus:
            header = {
                k: v for k, v in hdus[0].header.items() if k not in ("HISTORY", "COMMENT", "")
            }
            data = np.array(hdus[0].data, dtype=np.float32)
            sigma = np.array(hdus["SIGMA"].data, dtype=np.float32)
            mask = np.array(hdus["MASK"].data, dtype=np.uint8)
    except _NOT_A_MAP as error:
        raise DamagedError(f"{path}: not a map that this pixcal reads ({error})", path) from error
    return data, sigma, mask, header
