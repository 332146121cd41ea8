"""Frames in electrons, for notebooks and programs."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from pixcal.model.config import StrPath
from pixcal.model.errors import InputError

if TYPE_CHECKING:
    from astropy.nddata import CCDData


def to_electrons(
    run: StrPath, adu: ArrayLike, *, exptime_s: float = 0.0, own: Sequence[StrPath] = ()
) -> "CCDData":
    """Convert a frame of the detector of a run to electrons.

    Bias, dark signal and flat are removed, and the effects of the diagnosis that change single
    samples, such as a nonlinear response.

    Parameters
    ----------
    run : Run, str or path
        With a reduction; its diagnosis is used if there is one.
    adu : (y, x) array_like
        Samples as read out, ADU.
    exptime_s : float
        Exposure time of the frame, s.
    own : sequence of str or path
        Python files of your own effects that the diagnosis found.

    Returns
    -------
    astropy.nddata.CCDData
        Signal with its error (e-, 1 sigma) and mask; NaN where masked or saturated.

    Raises
    ------
    InputError
        If the run was not reduced, or the frame is not of its detector's window.
    """
    from pixcal.stages.electrons import calibration_of  # here, as in `pixcal.api.commands`

    calibration = calibration_of(Path(run), [Path(file) for file in own])
    samples = np.asarray(adu)
    if samples.shape != calibration.shape:
        raise InputError(
            f"adu: shape {samples.shape} where the detector of {run} has {calibration.shape}"
        )
    return calibration.image(samples, exptime_s)
