"""Rms of centroid errors, corrected for the added random draw of the maps' errors.

On a detector that is the maps plus a draw of their errors, true offsets t, errors of the maps e and
the draw d are independent, e and d alike. Stars fitted on a perfect grid err by K(t + e + d), with
K the weights of the pixels; those fitted where the maps say by K d. So the mean square that the
true offsets alone would give is that of the first less twice that of the second, whatever the
pattern of the offsets.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]

RESAMPLES = 300
SEEN = 2.0  # what is left of a mean square is seen when it is so many of its errors above nothing


@dataclass(frozen=True)
class Value:
    """A number and its 1-sigma error by resampling the stars; NaN where there is none."""

    value: float
    error: float


@dataclass(frozen=True)
class Comparison:
    """Root mean square errors of centroids, px, and how many times the maps make them smaller."""

    # perfect, measured: pixels taken for a perfect grid, and where the maps say. `perfect` is
    # NaN where the offsets' own scatter is not seen above the maps' errors
    perfect: Value
    measured: Value
    gain: Value


def compare(perfect: F64, measured: F64, noise: F64, rng: np.random.Generator) -> Comparison:
    """Root mean squares of errors.

    Parameters
    ----------
    perfect, measured : (star, position) float64
        Errors, px; NaN where there is none.
    noise : (star, position) float64
        Errors whose mean square ``perfect`` holds twice without having it on a real detector: the
        maps' own. Zeros where the detector is the truth.
    rng : Generator
        For resampling the stars.
    """
    columns = (perfect**2, measured**2, noise**2)
    good = np.isfinite(perfect) & np.isfinite(measured)
    sums = np.stack([np.where(good, c, 0.0).sum(axis=1) for c in columns] + [good.sum(axis=1)])
    rms = _roots(sums.sum(axis=1))
    stars = sums.shape[1]
    picks = (np.bincount(rng.integers(0, stars, stars), minlength=stars) for _ in range(RESAMPLES))
    again = np.array([_roots(sums @ pick) for pick in picks])
    # Squares: their errors are meaningful where the root of one does not exist.
    square_error = np.std(again[:, 3])
    if not rms[3] > SEEN * square_error:
        rms[0] = rms[2] = np.nan
    with np.errstate(invalid="ignore"):
        return Comparison(*(Value(float(rms[n]), _spread(again[:, n])) for n in range(3)))


def _roots(sums: F64) -> F64:
    """Perfect, measured, gain, and the first one's square, from sums of squares and a count."""
    perfect, measured, noise = sums[:3] / max(sums[3], 1)
    square = perfect - 2 * noise
    root = np.sqrt(square) if square > 0 else np.nan
    other = np.sqrt(measured)
    return np.array([root, other, root / other if other > 0 else np.nan, square])


def _spread(values: F64) -> float:
    """Standard deviation of the finite values."""
    finite = values[np.isfinite(values)]
    return float(np.std(finite)) if len(finite) > 1 else float("nan")


def running_means(errors: F64, lengths: list[int]) -> list[F64]:
    """Mean error of each star over its first positions, NaN left out.

    Parameters
    ----------
    errors : (star, position) float64
    lengths : list of int
        Positions to average.

    Returns
    -------
    list of (star, 1) float64
        One for each length; NaN where a star has none.
    """
    good = np.isfinite(errors)
    sums, counts = np.cumsum(np.where(good, errors, 0.0), axis=1), np.cumsum(good, axis=1)
    means = np.divide(sums, counts, out=np.full(sums.shape, np.nan), where=counts > 0)
    return [means[:, n - 1 : n] for n in lengths]
