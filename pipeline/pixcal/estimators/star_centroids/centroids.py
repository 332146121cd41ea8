"""Centroids of stars by a PSF fit, and the effect of wrong pixel positions.

A pixel whose response lies at (x + dx, y + dy) receives of a star at (a, b), with N electrons on a
background of B in each pixel,

    S = N P(x + dx - a, y + dy - b) + B

(P: `pixcal.kernels.psf`). Fitted are a, b, N and B, by Fisher scoring with the weights
1 / (S + r²) that the model itself gives. Where the fit takes pixels to lie elsewhere than they do,
the centroid is wrong, to first order by a weighted sum of the pixels' errors (`weights`): about the
mean displacement, each pixel counting by what it tells of the position, P_x² / S.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pixcal.kernels.psf import Psf, expected_windows, fit_windows

F64 = NDArray[np.float64]
Good = NDArray[np.bool_]
# least variance of a pixel, as a share of the star's electrons: dark rings weigh no more
TINY = 1e-9


@dataclass(frozen=True)
class Star:
    """A star as it is observed and fitted."""

    psf: Psf
    half: int  # the window has 2 half + 1 pixels a side, the middle one nearest to the star
    electrons: float  # photo-electrons of the star, N
    background: float = 0.0  # of each pixel, e-, B
    read_variance: float = 0.0  # of each pixel, all read-outs together, e-², r²

    @property
    def side(self) -> int:
        """Side of the window, px."""
        return 2 * self.half + 1

    def expected(self, place: F64, offsets: F64) -> F64:
        """Mean electrons in the window.

        Parameters
        ----------
        place : (n, 2) float64
            (x, y) of each star from the middle of its window's middle pixel, px.
        offsets : (n, 2, side, side) float64
            (dx, dy) of the pixels, px.

        Returns
        -------
        (n, side, side) float64
        """
        return np.asarray(
            expected_windows(
                self.psf.coefficients, self.psf.step, place, offsets, self.electrons,
                self.background,
            )
        )  # fmt: skip

    def fit(self, data: F64, offsets: F64, good: Good) -> F64:
        """Fit each star, starting from the middle of its window.

        Parameters
        ----------
        data : (n, side, side) float64
            Electrons.
        offsets : (n, 2, side, side) float64
            Where the fit takes the pixels to lie, (dx, dy), px.
        good : (n, side, side) bool
            Pixels to use.

        Returns
        -------
        (n, 4) float64
            a, b (px), N, B (e-); NaN where the fit does not end.
        """
        return np.asarray(
            fit_windows(
                self.psf.coefficients, self.psf.step, data, offsets, good, self.read_variance,
                self.electrons * TINY, np.array([0.0, 0.0, self.electrons, self.background]),
            )
        )  # fmt: skip

    def information(self, place: F64, good: Good | None = None) -> F64:
        """Fisher's information of a, b, N and B: (4, 4)."""
        jacobian, weight, _ = self._linear(place, good)
        return np.asarray(np.einsum("iyx,jyx,yx->ij", jacobian, jacobian, weight))

    def bound(self, place: F64 | None = None) -> F64:
        """Cramér-Rao bound of the centroid (x, y), px, with N and B fitted.

        Parameters
        ----------
        place : (2,) float64, optional
            Of the star from the middle of its pixel, px; by default the rms over a pixel.
        """
        if place is not None:
            return np.asarray(np.sqrt(np.diag(np.linalg.inv(self.information(place)))[:2]))
        quarters = (np.arange(4) - 1.5) / 4
        places = [np.array([x, y]) for y in quarters for x in quarters]
        return np.asarray(np.sqrt(np.mean([self.bound(p) ** 2 for p in places], axis=0)))

    def weights(self, place: F64, good: Good | None = None) -> F64:
        """Change of the fitted centroid per displacement of each pixel.

        Parameters
        ----------
        place : (2,) float64
            Of the star from the middle of its pixel, (x, y), px.
        good : (side, side) bool, optional
            Pixels that the fit uses; all by default.

        Returns
        -------
        (2, 2, side, side) float64
            Error of the centroid (x, y) for each pixel's displacement (x, y) that the fit does not
            know; a displacement common to all moves the centroid by its opposite.
        """
        jacobian, weight, slopes = self._linear(place, good)
        covariance = np.linalg.inv(np.einsum("iyx,jyx,yx->ij", jacobian, jacobian, weight))
        return np.asarray(
            np.einsum("ai,iyx,yx,cyx->acyx", covariance[:2], jacobian, weight, slopes)
        )

    def _linear(self, place: F64, good: Good | None) -> tuple[F64, F64, F64]:
        """Derivatives by a, b, N, B; weights; and derivatives by the pixel's own place."""
        y, x = np.mgrid[-self.half : self.half + 1, -self.half : self.half + 1]
        value, along_x, along_y = self.psf.at(x - place[0], y - place[1])
        slopes = self.electrons * np.stack([along_x, along_y])
        jacobian = np.concatenate([-slopes, [value, np.ones_like(value)]])
        mean = self.electrons * value + self.background
        weight = 1 / (np.maximum(mean, 0) + self.read_variance + self.electrons * TINY)
        return jacobian, weight if good is None else weight * good, slopes
