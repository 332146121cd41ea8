"""Centroids of stars by a PSF fit, the effect of wrong pixel positions, and its correction.

From a star at (a, b), with N electrons on a background of B in each pixel, a pixel whose response
is centred at (x + dx, y + dy) receives

    S = N P(x + dx - a, y + dy - b) + B

(P: `pixcal.kernels.psf`). a, b, N and B are fitted by Fisher scoring with weights 1 / (S + r²).
If the fit assumes wrong pixel positions, the centroid is wrong, to first order by a weighted sum of
the pixels' errors about their mean, with weights P_x² / S. A map of offsets corrects centroids on a
perfect grid by the same sum (docs/explanation/centroid-errors.md).
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import spline_filter
from scipy.signal import oaconvolve
from scipy.special import erf

from pixcal.kernels.normal_matrix import root_diagonal
from pixcal.kernels.psf import MARGIN, Psf
from pixcal.model.arrays import F32, F64, Mask

# least variance of a pixel, as a share of the star's electrons, to limit the weight of dark rings
TINY = 1e-9
MAX_STEPS = 50
PRECISION = 1e-9  # step below which a fit has converged, px
SINGULAR = 1e-12  # least eigenvalue of a regular normal matrix of unit diagonal
# largest share of a star's weights on pixels without an offset for which it is corrected
MAX_UNKNOWN = 0.1
_SIGMA_OF_FWHM = 1 / math.sqrt(8 * math.log(2))
_KNOTS = 24
_READ_NOISE_LIMITED = 1e12  # variance of a pixel that makes the star's shot noise negligible, e-²


@dataclass(frozen=True)
class Star:
    """A star as it is observed and fitted."""

    psf: Psf
    half: int  # the window's side is 2 half + 1 pixels; the star is nearest to the central one
    electrons: float  # photo-electrons of the star, N
    background: float = 0.0  # of each pixel, e-, B
    read_variance: float = 0.0  # of each pixel, summed over all read-outs, e-², r²

    @property
    def side(self) -> int:
        """Side of the window, px."""
        return 2 * self.half + 1

    def expected(self, place: F64, offsets: F64) -> F64:
        """Mean electrons (n, side, side) of stars at places (n, 2), px from the window's centre.

        ``offsets``: (n, 2, side, side) of the pixels, px.
        """
        return np.asarray(self.electrons * self._at(place, offsets)[0] + self.background)

    def fit(self, data: F64, offsets: F64, good: Mask) -> F64:
        """Fit each star, starting at the centre of its window: a, b (px), N, B (e-), (n, 4).

        ``data`` and ``good``: electrons, and pixels to use (n, side, side). ``offsets``: assumed
        (dx, dy) of the pixels (n, 2, side, side), px. NaN where the fit does not converge.
        """
        # Excluded pixels may have any value.
        data, offsets = np.where(good, data, 0.0), np.where(good[:, None], offsets, 0.0)
        fitted = np.full((len(data), 4), np.nan)
        theta = np.tile([0.0, 0.0, self.electrons, self.background], (len(data), 1))
        left = np.arange(len(data))
        for _ in range(MAX_STEPS):
            stars = theta[left]
            jacobian, weight, mean, _ = self._linear(stars, offsets[left])
            slopes = jacobian.reshape(len(left), 4, -1)
            weighted = slopes * (weight * good[left]).reshape(len(left), 1, -1)
            rest = (data[left] - mean).reshape(len(left), -1, 1)
            step, regular = _solved(weighted @ slopes.swapaxes(1, 2), (weighted @ rest)[:, :, 0])
            length = np.hypot(step[:, 0], step[:, 1])
            # Steps of at most half a pixel, beyond which the PSF is not linear.
            stars = stars + np.minimum(1.0, 0.5 / np.maximum(length, 1e-300))[:, None] * step
            inside = regular & (np.hypot(stars[:, 0], stars[:, 1]) < self.side / 2)
            done = inside & (length < PRECISION)
            theta[left], fitted[left[done]] = stars, stars[done]
            left = left[inside & ~done]
            if not len(left):
                break
        return fitted

    def information(self, place: F64) -> F64:
        """Fisher information of a, b, N and B: (4, 4)."""
        jacobian, weight, _ = self._of_pixels(place, None)
        return np.asarray(np.einsum("iyx,jyx,yx->ij", jacobian, jacobian, weight))

    def bound(self, place: F64 | None = None) -> F64:
        """Cramér-Rao bound of the centroid (x, y), px, N and B free; None: rms over a pixel."""
        if place is not None:
            return np.asarray(np.sqrt(np.diag(np.linalg.inv(self.information(place)))[:2]))
        places = np.indices((4, 4)).reshape(2, -1).T / 4 - 0.375
        return np.asarray(np.sqrt(np.mean([self.bound(p) ** 2 for p in places], axis=0)))

    def weights(self, place: F64, good: Mask | None = None) -> F64:
        """Error of the centroid (x, y) per displacement of each pixel (2, 2, side, side).

        For a star at ``place`` (x, y), px from the centre of its pixel, fitted with all or the good
        pixels, assumed to be on a perfect grid.
        """
        jacobian, weight, slopes = self._of_pixels(place, good)
        covariance = np.linalg.inv(np.einsum("iyx,jyx,yx->ij", jacobian, jacobian, weight))
        return np.asarray(
            np.einsum("ai,iyx,yx,cyx->acyx", covariance[:2], jacobian, weight, slopes)
        )

    def _of_pixels(self, place: F64, good: Mask | None) -> tuple[F64, F64, F64]:
        """For one star: derivatives by a, b, N, B; weights; derivatives by pixel position."""
        theta = np.array([[*place, self.electrons, self.background]])
        jacobian, weight, _, slopes = (part[0] for part in self._linear(theta))
        return jacobian, weight if good is None else weight * good, slopes

    def _linear(self, theta: F64, offsets: F64 | None = None) -> tuple[F64, F64, F64, F64]:
        """At a, b, N, B (n, 4): derivatives by them, weights, mean, derivatives by position."""
        value, along_x, along_y = self._at(theta[:, :2], offsets)
        electrons, background = theta[:, 2:, None, None].swapaxes(0, 1)
        slopes = electrons[:, None] * np.stack([along_x, along_y], axis=1)
        more = np.stack([value, np.ones_like(value)], axis=1)
        mean = electrons * value + background
        weight = 1 / (np.maximum(mean, 0) + self.read_variance + self.electrons * TINY)
        return np.concatenate([-slopes, more], axis=1), weight, mean, slopes

    def _at(self, place: F64, offsets: F64 | None) -> F64:
        """Share of the star's light that pixels receive, and its derivatives (3, n, side, side)."""
        y, x = np.mgrid[-self.half : self.half + 1, -self.half : self.half + 1]
        a, b = place.T[:, :, None, None]
        dx, dy = (0.0, 0.0) if offsets is None else offsets.swapaxes(0, 1)
        return self.psf.at(x + dx - a, y + dy - b)


def _solved(normal: F64, right: F64) -> tuple[F64, Mask]:
    """Solutions (n, m) of normal equations, zero if singular; mask of the regular ones."""
    scale = root_diagonal(normal)
    unit = normal / (scale[:, :, None] * scale[:, None, :])
    regular = np.linalg.eigvalsh(unit)[:, 0] > SINGULAR
    unit[~regular] = np.eye(unit.shape[1])
    step = np.linalg.solve(unit, (right / scale)[:, :, None])[:, :, 0] / scale
    return np.where(regular[:, None], step, 0.0), regular


def gaussian_star(fwhm: float, electrons: float | None, read_noise: float) -> Star:
    """A Gaussian star of given full width at half maximum, px, averaged over square pixels.

    Its ``electrons`` set the fit's weights by photon noise; None gives all pixels equal weight.
    ``read_noise`` in e-.
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
        return Star(psf, half, 1.0, read_variance=_READ_NOISE_LIMITED)
    return Star(psf, half, electrons, read_variance=read_noise**2)


@dataclass(frozen=True)
class Corrected:
    """Corrected positions of stars."""

    # (n, 2) (x, y), px, 0 at the first pixel's centre; NaN where too many pixels lack an offset
    place: F64
    error: F64  # (n, 2) its error due to the errors of the map, px, 1 sigma


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
    # Exclude places far from the detector, which could overflow integers.
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
    """Correction (2, y, x) of a star's (None: pixel's) centroid, px; NaN offsets count as 0."""
    known = np.nan_to_num(offsets.astype(np.float32))
    if star is None:
        return known
    weights = star.weights(np.zeros(2))[..., ::-1, ::-1].astype(np.float32)
    made = [
        -sum(oaconvolve(d, w, mode="same") for d, w in zip(known, along, strict=True))
        for along in weights
    ]
    return np.stack(made).astype(np.float32)
