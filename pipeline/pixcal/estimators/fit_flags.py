"""Which pixels of a fit are to be believed."""

import numpy as np
from numpy.typing import NDArray

from pixcal.model.flags import PixelFlag

F32 = NDArray[np.float32]

MAX_SIGMA_RAD = 0.5
"""Largest error of a phase that is told from its neighbours on the circle."""


def fit_flags(
    mask: NDArray[np.uint8],
    iota: F32,
    sigma: F32,
    chi2: F32,
    count: F32,
    noise: float,
    chi2_limit: float,
) -> NDArray[np.uint8]:
    """Flags of pixels: those of the reduction, and NO_DATA and BAD_FIT of the fit.

    Parameters
    ----------
    mask : (y, x) uint8
        Flags of the reduction.
    iota, sigma, chi2, count : (y, x) float32
        Maps of the sweep: mean (e-), error of the phase (rad), reduced chi-square, samples.
    noise : float
        Usual reduced chi-square: where the noise model is off by a factor, all pixels are.
    chi2_limit : float
        Reduced chi-square, over ``noise``, above which a pixel does not fit.
    """
    flags = mask.copy()
    flags[count == 0] |= np.uint8(PixelFlag.NO_DATA)
    # Chance alone gives a scatter of sqrt(2 / n) to a reduced chi-square.
    chance = 8 * np.sqrt(2 / np.maximum(count - 3, 1))
    with np.errstate(invalid="ignore"):
        good = np.isfinite(sigma) & (chi2 / noise < np.maximum(chi2_limit, 1 + chance))
        good &= (iota > 0) & (sigma < MAX_SIGMA_RAD)
    flags[~good] |= np.uint8(PixelFlag.BAD_FIT)
    return flags


def usual_chi2(values: NDArray[np.floating], freedom: int) -> float:
    """Median of reduced chi-squares over that of pure noise (Wilson and Hilferty's cube)."""
    return float(np.median(values) / (1 - 2 / (9 * max(freedom, 1))) ** 3)
