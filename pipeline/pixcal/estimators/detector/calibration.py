"""Bias, dark current, response and linearity of a detector from its combined frames."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from pixcal.kernels.robust import median_and_sigma

F64 = NDArray[np.float64]

MIN_RUNGS = 3  # fewest exposure times that tell a straight line from a bent one


@dataclass(frozen=True)
class DarkLine:
    """Signal without light against exposure time, for each pixel; all (y, x) float64."""

    # ndarray: at exposure zero (ADU); with a single exposure time, the signal at that time
    bias: F64
    rate: F64  # ndarray: dark signal (ADU/s); zero with a single exposure time
    mean_time: F64  # ndarray: weighted mean of the exposure times (s)
    # per_mean, per_rate: ndarray: variance of the signal at `mean_time`, and of the rate (s⁻²),
    # for frames of unit variance
    per_mean: F64
    per_rate: F64

    def signal(self, exptime: float) -> F64:
        """Signal without light (ADU) after an exposure time (s)."""
        return self.bias + self.rate * exptime

    def variance(self, exptime: float) -> F64:
        """Variance of `signal`, for frames of unit variance."""
        return self.per_mean + self.per_rate * (exptime - self.mean_time) ** 2


def dark_line(means: Sequence[F64], counts: Sequence[F64], exptimes: Sequence[float]) -> DarkLine:
    """Straight line through combined dark frames (bias frames are the shortest ones).

    Parameters
    ----------
    means : sequence of (y, x) float64
        Combined frames (ADU), NaN where there is no sample.
    counts : sequence of (y, x) float64
        Samples in each.
    exptimes : sequence of float
        Exposure times (s).

    Returns
    -------
    DarkLine
        Bias NaN where a pixel has no sample, rate NaN where one exposure time of two is missing.
    """
    times = np.asarray(exptimes, float)[:, None, None]
    signal = np.stack(means)
    weight = np.where(np.isfinite(signal), np.stack(counts), 0.0)
    signal = np.where(weight > 0, signal, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = weight.sum(axis=0)
        mean_time = (weight * times).sum(axis=0) / total
        mean = (weight * signal).sum(axis=0) / total
        lever = (weight * (times - mean_time) ** 2).sum(axis=0)
        if len(set(exptimes)) > 1:
            rate = (weight * (times - mean_time) * (signal - mean)).sum(axis=0) / lever
            per_rate = 1 / lever
        else:
            rate = per_rate = np.zeros_like(mean)
            mean_time = np.zeros_like(mean)
        return DarkLine(mean - rate * mean_time, rate, mean_time, 1 / total, per_rate)


@dataclass(frozen=True)
class Rung:
    """Combined flats of one exposure time, bias and dark subtracted; maps are (y, x) float64."""

    exptime: float  # seconds; any number above zero when there is a single rung
    frames: int  # how many were combined
    signal: F64  # ndarray: mean (ADU); NaN where any of the frames is saturated or not finite
    variance: F64  # ndarray: of `signal` (ADU²)


def usual_variance(variance: NDArray[Any], dof: int) -> float:
    """Variance that most pixels of a tile have, from few samples each; NaN with no ``dof``."""
    if dof < 1:
        return np.nan
    # The median of a variance of few samples is below its mean.
    return median_and_sigma(variance)[0] * dof / float(chdtri(dof, 0.5))


def response_rate(rungs: Sequence[Rung]) -> tuple[F64, F64]:
    """Signal per second of flats, from all rungs on which a pixel is not saturated.

    All charge over all time: the weights that photon noise asks for. The lamp's illumination
    stays in it; it changes the mean intensity of a pixel, never its offset.

    Returns
    -------
    rate, error : (y, x) float64
        ADU/s; NaN where no rung can be used.
    """
    frames = np.array([rung.frames for rung in rungs], float)[:, None, None]
    times = np.array([rung.exptime for rung in rungs])[:, None, None]
    signal = np.stack([rung.signal for rung in rungs])
    variance = np.stack([rung.variance for rung in rungs])
    used = np.isfinite(signal)
    with np.errstate(invalid="ignore", divide="ignore"):
        seconds = np.where(used, frames * times, 0.0).sum(axis=0)
        rate: F64 = np.where(used, frames * signal, 0.0).sum(axis=0) / seconds
        error: F64 = np.sqrt(np.where(used, frames**2 * variance, 0.0).sum(axis=0)) / seconds
    return rate, error


@dataclass(frozen=True)
class Linearity:
    """How straight the signal of flats is over their exposure times."""

    max_deviation: float  # largest relative distance from the straight line
    # (rung,) relative distance of each level from the line; NaN for one that is not used
    deviation: F64
    # slope, intercept: of the line (ADU/s; ADU). The intercept takes up an error that all
    # exposure times share
    slope: float
    intercept: float


def linearity(exptimes: F64, levels: F64, used: NDArray[np.bool_]) -> Linearity | None:
    """Line through the levels of a ladder of flats that makes the relative distances least.

    Parameters
    ----------
    exptimes, levels : (rung,) float64
        Seconds; ADU above bias and dark.
    used : (rung,) bool
        Levels to fit, those without saturation.

    Returns
    -------
    Linearity or None
        None with fewer than `MIN_RUNGS` levels.
    """
    used = used & (levels > 0)
    if used.sum() < MIN_RUNGS:
        return None
    weight = 1 / levels[used]
    design = np.stack([exptimes[used], np.ones(used.sum())], axis=1)
    slope, intercept = np.linalg.lstsq(design * weight[:, None], np.ones(len(weight)))[0]
    deviation = np.full(len(levels), np.nan)
    line = slope * exptimes[used] + intercept
    deviation[used] = levels[used] / line - 1
    return Linearity(
        float(np.abs(deviation[used]).max()), deviation, float(slope), float(intercept)
    )
