"""Correction, by a map of offsets, of centroids measured on a perfect grid.

A pixel whose offset is +d responds at larger x by d: the star that it shows lies at larger x than
its index says. A centroid is wrong by a weighted sum of the offsets under the star
(`centroids`), and each pixel counts by what it tells of the position.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter
from scipy.signal import oaconvolve
from scipy.special import erf

from pixcal.estimators.star_centroids.centroids import Star
from pixcal.kernels.psf import MARGIN, Psf
from pixcal.model.arrays import F32, F64

# share of a star's weights on pixels without an offset beyond which it is not corrected
MAX_UNKNOWN = 0.1
_SIGMA_OF_FWHM = 1 / math.sqrt(8 * math.log(2))
_KNOTS = 24
_FAINT = 1e12  # variance of a pixel beside which that of the star's own light does not count, e-²


def gaussian_star(fwhm: float, electrons: float | None, read_noise: float) -> Star:
    """A Gaussian star of a full width at half maximum, px, averaged over square pixels.

    Its ``electrons`` set the weights of its fit by photon noise; None where all pixels of the fit
    count alike. ``read_noise`` in e-.
    """
    sigma = fwhm * _SIGMA_OF_FWHM
    half = max(2, math.ceil(4 * sigma))
    step = min(fwhm / _KNOTS, 0.25)
    at = step * np.arange(math.ceil((half + MARGIN) / step) + 3)
    ends = [erf((at + side) / (math.sqrt(2) * sigma)) for side in (-0.5, 0.5)]
    line = (ends[1] - ends[0]) / 2
    line = np.concatenate([line[:0:-1], line])
    table = spline_filter(line[:, None] * line[None, :], order=3, mode="mirror")
    psf = Psf(np.asarray(table), step)
    if electrons is None:
        return Star(psf, half, 1.0, read_variance=_FAINT)
    return Star(psf, half, electrons, read_variance=read_noise**2)


@dataclass(frozen=True)
class Corrected:
    """Places of stars."""

    # (n, 2) (x, y), px, the first pixel's centre being 0; NaN where too little is known of the
    # pixels
    place: F64
    error: F64  # (n, 2) what the errors of the map leave in it, px, 1 sigma


def correct_centroids(
    place: F64, offsets: NDArray[np.floating], sigma: NDArray[np.floating], star: Star
) -> Corrected:
    """Correct each centroid (n, 2), (x, y) px on a perfect grid, for the offsets under the star.

    Offsets (2, y, x) along x and y and their errors are in px, NaN where unknown.
    """
    _, ny, nx = offsets.shape
    corrected, error = np.full((2, *place.shape), np.nan)
    around = np.arange(-star.half, star.half + 1)
    inside = np.isfinite(place).all(axis=1)
    # Far from the detector, and beyond what integers hold.
    inside &= (np.abs(np.nan_to_num(place)) < 2 * max(ny, nx)).all(axis=1)
    for n in np.flatnonzero(inside):
        middle = np.rint(place[n]).astype(int)
        weights = star.weights(place[n] - middle)
        x, y = middle[0] + around, (middle[1] + around)[:, None]
        window = np.array([m[:, y.clip(0, ny - 1), x.clip(0, nx - 1)] for m in (offsets, sigma)])
        known = np.isfinite(window).all(axis=(0, 1))
        known &= (x >= 0) & (x < nx) & (y >= 0) & (y < ny)
        lost = np.abs(weights * ~known).sum() / np.abs(weights).sum()
        if lost > MAX_UNKNOWN:
            continue
        delta, spread = np.where(known, window, 0.0)
        corrected[n] = place[n] - np.einsum("acyx,cyx->a", weights, delta)
        error[n] = np.sqrt(np.einsum("acyx,cyx->a", weights**2, spread**2))
    return Corrected(corrected, error)


def correction_map(offsets: NDArray[np.floating], star: Star | None) -> F32:
    """Correction (2, y, x) of the centroid of a star centred on each pixel, or of the pixels.

    Offsets (2, y, x) along x and y are in px; NaN, where unknown, counts as 0.
    """
    known = np.nan_to_num(offsets.astype(np.float32))
    if star is None:
        return known
    weights = star.weights(np.zeros(2))[..., ::-1, ::-1].astype(np.float32)
    made = [
        -sum(oaconvolve(d, w, mode="same") for d, w in zip(known, along, strict=True))
        for along in weights
    ]
    return np.stack(made).astype(np.float32)
