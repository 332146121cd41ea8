"""The maps that other programs read: FITS, written aside and renamed."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from pixcal import __version__
from pixcal.model.errors import DamagedError
from pixcal.model.flags import PixelFlag

Card = tuple[str, Any, str]


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
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.aside")
    fits.HDUList([primary, errors, flags]).writeto(aside, overwrite=True, checksum=True)
    aside.replace(path)


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
        with fits.open(path, checksum=True) as hdus:
            header = {
                k: v for k, v in hdus[0].header.items() if k not in ("HISTORY", "COMMENT", "")
            }
            data = np.array(hdus[0].data, dtype=np.float32)
            sigma = np.array(hdus["SIGMA"].data, dtype=np.float32)
            mask = np.array(hdus["MASK"].data, dtype=np.uint8)
    except (OSError, KeyError, TypeError, ValueError) as error:
        raise DamagedError(f"{path}: not a map that this pixcal reads ({error})") from error
    return data, sigma, mask, header
