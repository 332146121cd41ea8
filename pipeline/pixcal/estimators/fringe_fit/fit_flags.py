"""Flags of pixels whose fit is not reliable."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pixcal.estimators.fringe_fit.sweep import TileMaps
from pixcal.model.arrays import U8
from pixcal.model.flags import PixelFlag

# largest phase error: beyond it errors are not Gaussian, and deviations of 6 sigma occur (with 0.3
# rad, in one pixel of 500)
MAX_SIGMA_RAD = 0.2
# light is never negative: fringes of a higher visibility have a wrong bias, and the variance of
# their samples is unknown
MAX_VISIBILITY = 1.05
NOISE_MARGIN_SIGMA = 6.0  # standard errors by which noise may exceed this limit


def fit_flags(mask: U8, maps: TileMaps, noise: float, excess: float, chi2_limit: float) -> U8:
    """Flags of pixels: those of the reduction, and NO_DATA and BAD_FIT of the fit.

    noise : usual reduced chi-square, which is not 1 if the noise model is off by a factor
    excess : relative scatter of reduced chi-squares beyond chance, which is not a defect
    chi2_limit : largest reduced chi-square, over ``noise``, of a good pixel
    """
    iota, alpha, sigma = maps.iota, maps.alpha, maps.sigma
    flags = mask.copy()
    flags[maps.count == 0] |= np.uint8(PixelFlag.NO_DATA)
    # A reduced chi-square scatters by sqrt(2 / n) by chance.
    scatter = 8 * np.sqrt(2 / np.maximum(maps.count - 3, 1) + excess**2)
    with np.errstate(invalid="ignore"):
        good = np.isfinite(sigma) & (maps.chi2 / noise < np.maximum(chi2_limit, 1 + scatter))
        good &= (iota > 0) & (sigma < MAX_SIGMA_RAD)
        # Noise that raises an amplitude lowers its phase error: use the median visibility.
        usual = np.nanmedian((alpha / iota)[good]) if good.any() else np.float32(1.0)
        good &= sigma * alpha < MAX_SIGMA_RAD * usual * iota
        good &= alpha < MAX_VISIBILITY * iota + NOISE_MARGIN_SIGMA * sigma * alpha
    flags[~good] |= np.uint8(PixelFlag.BAD_FIT)
    return flags


def typical_chi2(values: NDArray[np.floating], freedom: int) -> float:
    """Median of reduced chi-squares over that of pure noise."""
    return float(np.median(values) / _noise_chi2(0.0, freedom)) if len(values) else 1.0


def excess_scatter(values: NDArray[np.floating], freedom: int) -> float:
    """Relative scatter of reduced chi-squares beyond noise, from their 84 % and 50 % quantiles."""
    if not len(values):
        return 0.0
    usual, high = np.quantile(values, ndtr([0.0, 1.0]))
    chance = _noise_chi2(1.0, freedom) / _noise_chi2(0.0, freedom)
    return float(np.sqrt(max((high / usual - 1) ** 2 - (chance - 1) ** 2, 0.0)))


def _noise_chi2(sigmas: float, freedom: int) -> float:
    """Reduced chi-square of pure noise, ``sigmas`` above its median (Wilson, Hilferty)."""
    part = 2 / (9 * max(freedom, 1))
    return float((1 - part + sigmas * np.sqrt(part)) ** 3)
