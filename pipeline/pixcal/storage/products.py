"""The maps that other programs read: FITS, written aside and renamed."""

import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyUserWarning
from numpy.typing import NDArray

from pixcal import __version__
from pixcal.model.errors import DamagedError
from pixcal.model.flags import PixelFlag
from pixcal.storage.fits_map import word_sum

Card = tuple[str, Any, str]
_NOT_A_MAP = (OSError, KeyError, TypeError, ValueError, AstropyUserWarning, fits.VerifyError)


def write_map(
    path: Path,
    data: NDArray[np.float32],
    sigma: NDArray[np.float32],
    mask: NDArray[np.uint8],
    cards: Sequence[Card],
    history: Sequence[str] = (),
) -> None:
    """Write a map with its errors and flags.

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
    primary = fits.PrimaryHDU(data.astype(">f4", copy=False))
    primary.header["BUNIT"] = ("pixel", "offset from the perfect grid")
    primary.header["CREATOR"] = (f"pixcal {__version__}", "program that wrote this file")
    for key, value, comment in cards:
        primary.header[key] = (value, comment)
    for line in history:
        primary.header.add_history(line)
    errors = fits.ImageHDU(sigma.astype(">f4", copy=False), name="SIGMA")
    errors.header["BUNIT"] = ("pixel", "1-sigma error")
    flags = fits.ImageHDU(mask, name="MASK")
    for flag in PixelFlag:
        flags.header[f"FLAG{flag.value.bit_length()}"] = (flag.value, (flag.name or "").lower())
    hdus = fits.HDUList([primary, errors, flags])
    for hdu in hdus:
        # Not by writeto, which would put the time into the comment: equal maps, equal bytes.
        hdu.add_checksum(when="by pixcal")
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.aside")
    with aside.open("wb") as file:
        hdus.writeto(file)
    aside.replace(path)


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
