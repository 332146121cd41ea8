"""Files of star positions: tables in every format of astropy, and distortions of a FITS WCS.

Offsets are a distortion that FITS readers know: lookup tables before all other transformations,
``D2IMDIS1`` and ``D2IMDIS2`` of the headers, with their tables in ``D2IMARR`` (Calabretta et al.
2004, "Representations of distortions in FITS world coordinate systems"; as astropy reads them).
"""

from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from astropy.wcs import WCS, DistortionLookupTable

from pixcal import __version__
from pixcal.model.arrays import F32, F64
from pixcal.model.errors import InputError, reason_of
from pixcal.storage.folder import written_aside


def read_table(path: Path) -> Table:
    """Read a table."""
    kinds = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv", ".txt": "ascii", ".dat": "ascii"}
    try:
        return Table.read(path, format=kinds.get(path.suffix.lower()))
    except Exception as error:  # the readers raise a dozen kinds, all of which mean one thing
        reason = reason_of(error)[:200] if path.exists() else "no such file"
        raise InputError(
            f"{path}: cannot be read as a table ({reason}); give CSV, ECSV, FITS or VOTable"
        ) from error


def column(table: Table, name: str, path: Path, option: str) -> F64:
    """Numbers of a column; NaN where it is masked."""
    if name not in table.colnames:
        raise InputError(
            f"{option}: {path} has no column {name!r}; its columns are {', '.join(table.colnames)}"
        )
    try:
        values: Any = np.ma.filled(np.ma.asarray(table[name], dtype=float), np.nan)
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{option}: column {name!r} of {path} holds no numbers; name another"
        ) from error


def write_table(table: Table, path: Path, *, overwrite: bool) -> None:
    """Write a table in the format given by the file's extension."""
    if path.exists() and not overwrite:
        raise InputError(f"{path}: exists; choose another --out, or add --overwrite")
    kinds = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv", ".fits": "fits", ".vot": "votable"}
    if path.suffix.lower() not in kinds:
        raise InputError(f"{path}: write a name that ends in {', '.join(kinds)}")
    table.write(path, format=kinds[path.suffix.lower()], overwrite=overwrite)


def distortion(correction: F32) -> WCS:
    """A WCS whose detector-to-image step adds a correction (2, y, x) to x and y, px."""
    _, ny, nx = correction.shape
    wcs = WCS(naxis=2)
    wcs.pixel_shape = (nx, ny)
    # A pixel of the table is a pixel of the detector, both counted from 1.
    tables = [
        DistortionLookupTable(np.ascontiguousarray(part), (1.0, 1.0), (1.0, 1.0), (1.0, 1.0))
        for part in correction
    ]
    wcs.det2im1, wcs.det2im2 = tables
    return wcs


def write_distortion(wcs: WCS, path: Path, history: str) -> None:
    """Write a WCS with its tables as a FITS file; replaces an existing file."""
    hdus = wcs.to_fits(relax=True)
    hdus[0].header["CREATOR"] = (f"pixcal {__version__}", "program that wrote this file")
    hdus[0].header.add_history(history)
    with written_aside(path) as aside:
        hdus.writeto(aside, overwrite=True)
