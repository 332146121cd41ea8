"""Offsets as a distortion that FITS readers know: lookup tables before all other transformations.

``D2IMDIS1`` and ``D2IMDIS2`` of the headers, with their tables in ``D2IMARR`` (Calabretta et al.
2004, "Representations of distortions in FITS world coordinate systems"; as astropy reads them).
"""

from pathlib import Path

import numpy as np
from astropy.wcs import WCS, DistortionLookupTable
from numpy.typing import NDArray

from pixcal import __version__


def distortion(correction: NDArray[np.float32]) -> WCS:
    """A WCS whose step from detector to image adds a correction to pixel coordinates.

    Parameters
    ----------
    correction : (2, y, x) float32
        What to add to x and y, px, in the middle of each pixel; linear between them.
    """
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
    """Write a WCS with its tables as a FITS file; one that is there is replaced."""
    hdus = wcs.to_fits(relax=True)
    hdus[0].header["CREATOR"] = (f"pixcal {__version__}", "program that wrote this file")
    hdus[0].header.add_history(history)
    aside = path.with_name(f".{path.name}.aside")
    hdus.writeto(aside, overwrite=True)
    aside.replace(path)
