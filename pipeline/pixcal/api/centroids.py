"""Centroids and WCS distortions from the maps of a run, for notebooks and programs."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from pixcal.model.arrays import F64
from pixcal.model.config import StrPath
from pixcal.model.errors import InputError

if TYPE_CHECKING:
    from astropy.wcs import WCS


def correct_centroids(
    run: StrPath, x: ArrayLike, y: ArrayLike, *, fwhm_px: float, electrons: float | None = None
) -> tuple[F64, F64, F64, F64]:
    """Correct centroids that were measured as if the pixels were a perfect grid.

    Parameters
    ----------
    run : Run, str or path
        With maps of offsets; corrected ones are used where there are any.
    x, y : (n,) array_like
        Column and row of each star, px, 0 being the centre of the first pixel.
    fwhm_px : float
        Full width at half maximum of the stars.
    electrons : float, optional
        Of a star, if the centroids were fitted with weights of its photon noise; by default all
        pixels of the fit have equal weights.

    Returns
    -------
    x, y, error_x, error_y : (n,) float64
        Corrected positions, and their errors from those of the maps, px, 1 sigma; NaN off the
        detector, and where masked pixels carry more than 10 % of the position information.

    Raises
    ------
    InputError
        If the run has no maps, the width is out of range, or x and y have different lengths.
    """
    from pixcal.stages import centroids as stage  # here, as in `pixcal.api.commands`

    columns: Any = [np.asarray(values, dtype=float) for values in (x, y)]
    if columns[0].ndim != 1 or columns[0].shape != columns[1].shape:
        raise InputError(f"x, y: shapes {columns[0].shape} and {columns[1].shape}; give (n,) each")
    place = np.stack(columns, axis=1)
    corrected = stage.correct(Path(run), place, fwhm_px=fwhm_px, electrons=electrons)
    return (*corrected.place.T, *corrected.error.T)


def distortion_wcs(run: StrPath, *, fwhm_px: float | None = None) -> "WCS":
    """The maps of a run as an astropy WCS, whose ``det2im1`` and ``det2im2`` hold them.

    Parameters
    ----------
    run : Run, str or path
        With maps of offsets; corrected ones are used where there are any.
    fwhm_px : float, optional
        For stars of this full width at half maximum; by default for the pixels themselves.

    Raises
    ------
    InputError
        If the run has no maps, or the width is out of range.
    """
    from pixcal.stages import centroids as stage  # here, as in `pixcal.api.commands`

    return stage.wcs_of(Path(run), fwhm_px=fwhm_px)
