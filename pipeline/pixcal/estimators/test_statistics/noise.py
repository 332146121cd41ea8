"""Statistics of noise: size, covariance of neighbours, rows and columns, outlying pixels."""

from collections.abc import Sequence
from functools import partial

import numpy as np
from scipy.ndimage import maximum_filter

from pixcal.estimators.detector.pixel_read_noise import FEWEST, squares_without_hits
from pixcal.estimators.diagnosis.evidence import Evidence
from pixcal.estimators.test_statistics import Curve, family, statistic
from pixcal.estimators.test_statistics.fringe_set_data import (
    ADJACENT,
    OUTLIERS,
    STEPS,
    FringeSetData,
    by_cell,
    neighbour_sums_by_level,
)
from pixcal.kernels.medians import robust_sigma
from pixcal.kernels.sample_sums import count_beyond, frame_means
from pixcal.model.arrays import F32, F64, Mask

of_noise = partial(statistic, "noise")
of_noise_power = partial(statistic, "noise", power=True)

MIN_DARKS = 5
# Read noise, in steps of the converter, below which the variance of a pixel depends on where its
# level lies between two codes.
COARSE = 0.65
QUANTILES = (0.5, 0.9, 0.99, 0.999)
LINES = "rows, columns: in pairs, alternating"
STILL = 1e-12  # ADU²: variance of pixels that do not change, whose square float32 still holds


@of_noise_power("residual variance against signal", "noise / expected noise", x="bin of level")
def variance_by_level(data: FringeSetData) -> Curve:
    """Mean square of residuals over their noise, in bins of the level."""
    return Curve.numbered(data.by_level[1])


@of_noise_power("residual noise", "rms residual", unit="e-")
def residual_noise(data: FringeSetData) -> Curve:
    """Mean square of the residuals."""
    squares = np.einsum("tp,tp->p", data.electrons, data.electrons) / len(data.electrons)
    return Curve.numbered([float(squares[data.good.ravel()].mean())])


@of_noise_power("residual variance by position", "noise / expected noise", x="cell of 4 × 4")
def variance_by_place(data: FringeSetData) -> Curve:
    """Mean square of residuals over their noise, in cells of the window, row by row."""
    return Curve.numbered(by_cell(data.moments[0], data.good))


@of_noise_power(
    "residual variance against time", "noise / expected noise", x="eighth of the frames"
)
def variance_by_time(data: FringeSetData) -> Curve:
    """Mean square of residuals over their noise, in eighths of the frames."""
    squares = np.einsum("tyx,tyx->t", data.residual, data.residual) / data.good.sum()
    value = [float(part.mean()) for part in np.array_split(squares, 8)]
    return Curve(np.arange(1.0, 9.0), np.array(value))


# most crosstalk is between pixels that touch; the others are two to four rows or columns apart
RANGES = (
    ("neighbours", "adjacent pixels", "neighbour"),
    ("far_neighbours", "pixels further apart", "far neighbour"),
)


def in_range(distance: str, correlation: F64) -> Curve:
    """The part of correlations by `STEPS` that is in one of `RANGES`."""
    steps = slice(ADJACENT) if distance == "neighbours" else slice(ADJACENT, None)
    return Curve(np.arange(float(len(STEPS)))[steps], correlation[steps])


@family("{0}", RANGES, "noise", "correlation of {1}", "correlation", x="{2}")
def neighbours(distance: str, data: FringeSetData) -> Curve:
    """Correlation of the residuals of pixels."""
    return in_range(distance, _mean_product(*data.neighbours))


@of_noise(
    "correlation of neighbours by row, modulo 4", "correlation", x="row of four, down then right"
)
def neighbours_by_row(data: FringeSetData) -> Curve:
    """Correlation with the pixel below and to the right, for each row of four."""
    sums, count = (of[[STEPS.index((1, 0)), STEPS.index((0, 1))]] for of in data.neighbours)
    row = (np.arange(data.good.shape[0]) + data.fringes.origin[0]) % 4
    value = np.stack(
        [_mean_product(sums[:, row == n], count[:, row == n]) for n in range(4)], axis=1
    )
    return Curve.numbered((value - value.mean(axis=1, keepdims=True)).ravel())


@of_noise("correlation of neighbours, bright minus dark", "correlation", x="neighbour")
def neighbours_by_level(data: FringeSetData) -> Curve:
    """Covariance over shot noise in bright samples less that in dark ones."""
    (bright, dark), count = neighbour_sums_by_level(
        data.residual, data.fringes.model, data.good, STEPS[:ADJACENT], data.thinned
    )
    return Curve.numbered(2 * _mean_product(bright - dark, count))


def _mean_product(sums: F64, count: F64) -> F64:
    """Mean (step,) of sums by rows and their numbers of pairs (step, y)."""
    return np.asarray(sums.sum(axis=1) / np.maximum(count.sum(axis=1), 1))


def line_power(rest: F32, good: Mask) -> F64:
    """Mean squares (4,) of means of lines over those of white noise, rows first; bad pixels zero.

    Of sums, then of differences of adjacent lines: noise that is white from line to line adds as
    much to both, a pattern does not.
    """
    squares = float(np.einsum("tyx,tyx->t", rest, rest).mean(dtype=float)) / good.sum()
    out = []
    for axis in (2, 1):
        count = np.maximum(good.sum(axis=axis - 1), 1)
        means = rest.sum(axis=axis) / np.sqrt(count)
        means -= means.mean(axis=1, keepdims=True)
        out += [means[:, 1:] + means[:, :-1], means[:, 1:] - means[:, :-1]]
    return np.array([float((own**2).mean()) / (2 * max(squares, 1e-30)) for own in out])


@of_noise_power("row and column noise", "noise / white noise", x=LINES)
def lines(data: FringeSetData) -> Curve:
    """Of the fringe frames' residuals."""
    return Curve.numbered(line_power(data.residual, data.good))


def _calm(frames: F32, good: Mask) -> F32:
    """Frames less the mean of each pixel and of each frame, over the noise; outliers zero."""
    rest = frames - frames.mean(axis=0)
    rest -= frame_means(rest, good)[:, None, None].astype(np.float32)
    spread = robust_sigma(rest[:, good]) or 1.0
    rest = rest / np.float32(spread)
    rest[np.abs(rest) > 8] = 0
    return np.asarray(rest * good, np.float32)


@of_noise("outliers", "outliers", x="sigma, low then high", unit="(2 √count)", floor=1.0)
def outliers(data: FringeSetData) -> Curve:
    """Twice the root of the number of residuals of good pixels beyond 5, 7 and 10 sigma."""
    limits = np.array(OUTLIERS)
    return Curve(np.concatenate([-limits, limits]), 2 * np.sqrt(data.outliers.ravel()))


@of_noise(
    "outliers in bias and dark frames",
    "outliers",
    x="sigma, low then high",
    unit="(2 √count)",
    floor=1.0,
)
def dark_outliers(evidence: Evidence) -> Curve | None:
    """The same without light: darks have long exposures, bias frames show hits during readout."""
    limits, counts = np.array(OUTLIERS), np.zeros((2, len(OUTLIERS)))
    every = (*evidence.of_kind("bias"), *evidence.of_kind("dark"))
    stacks = [stack for stack in every if len(stack.adu) >= MIN_DARKS]
    for stack in stacks:
        rest, sigma = evidence.dark_noise(stack)
        # The read noise is that of most pixels.
        spread = robust_sigma(rest / sigma)
        variance = np.ascontiguousarray((max(spread, 1.0) * sigma) ** 2)
        counts += count_beyond(np.nan_to_num(rest), variance, evidence.good, limits)
    value = 2 * np.sqrt(counts.ravel())
    return Curve(np.concatenate([-limits, limits]), value) if stacks else None


@of_noise_power("noise distribution of the pixels", "noise / expected noise", x="quantile")
def pixel_noise(data: FringeSetData) -> Curve:
    """Quantiles over the pixels of the mean square of their residuals."""
    return Curve(np.array(QUANTILES), np.quantile(data.moments[0][data.good], QUANTILES))


@of_noise("kurtosis of the pixels' residuals", "kurtosis", x="quantile")
def pixel_peakedness(data: FringeSetData) -> Curve:
    """Quantiles over the pixels of the kurtosis of their residuals."""
    second, fourth = (moment[data.good] for moment in data.moments)
    return Curve(np.array(QUANTILES), np.quantile(fourth / second**2, QUANTILES))


@of_noise_power(
    "read noise distribution of the pixels (bias frames)", "noise / expected noise", x="quantile"
)
def read_noise(evidence: Evidence) -> Curve | None:
    """Quantiles over the pixels of variance over squared read noise, without particle hits."""
    # Masked pixels count if they jump.
    stacks = [s for s in evidence.of_kind("bias") if len(s.adu) >= FEWEST]
    if not stacks or not evidence.dithered:
        return None
    rounded = evidence.read_noise > evidence.amplifier_noise
    if rounded and evidence.amplifier_noise < COARSE * evidence.gain * evidence.step_adu:
        return None
    # Where noise is clipped at the lowest code, its size depends on the level of a pixel.
    if evidence.lowest_adu is not None:
        return None
    # A median of integers jumps by a code.
    level = frame_means(stacks[0].adu, evidence.good).astype(np.float32)
    frames = stacks[0].adu - level[:, None, None]
    variance = squares_without_hits(frames) / (len(frames) - 1)
    variance *= (evidence.gain / evidence.read_noise) ** 2
    counted = evidence.good | jumping(frames)
    return Curve(np.array(QUANTILES), ranges_about(variance[counted], QUANTILES))


def jumping(frames: F32) -> Mask:
    """Pixels (y, x) of frames (t, y, x) that stay at a level, or whose noise has a flat top."""
    off = frames - frames.mean(axis=0)
    steps = (np.diff(off, axis=0) ** 2).mean(axis=0)
    off *= off
    square = np.maximum(off.mean(axis=0), STILL)
    steps /= 2 * square
    off *= off  # numpy takes a fourth power by logarithms
    peak = off.mean(axis=0) / square**2 - 3
    error = 1 / np.sqrt(len(frames))
    return np.asarray((steps < 1 - 2 * error) | (peak < -2 * np.sqrt(24) * error))


def ranges_about(values: F64, quantiles: Sequence[float]) -> F64:
    """Mean around each quantile q, over ranks within min(q, 1 - q) / 2, as integers jump."""
    ordered, means = np.sort(values), []
    for q in quantiles:
        apart = min(q, 1 - q) / 2
        first = int((q - apart) * len(ordered))
        means.append(float(ordered[first : max(int((q + apart) * len(ordered)), first + 1)].mean()))
    return np.array(means)


@of_noise(
    "neighbours of hot pixels", "dark current / that of hot pixel", x="left, right, above, below"
)
def hot_neighbours(evidence: Evidence) -> Curve | None:
    """Dark current beside hot pixels over theirs."""
    dark = evidence.dark_rate - np.median(evidence.dark_rate)
    spread = robust_sigma(dark)
    # Only the brightest in its surroundings: charge from it does not make its neighbours hot.
    hot = (dark > max(40 * spread, 1e-9)) & (dark >= maximum_filter(dark, size=5))
    hot[[0, -1]] = hot[:, [0, -1]] = False
    y, x = np.nonzero(hot)
    # A neighbour may be warm itself, or rows may differ: medians over equivalent rows.
    classes = [own for row in range(4) if (own := (y + evidence.origin[0]) % 4 == row).sum() >= 3]
    if not classes:
        return None
    value = []
    for dy, dx in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        share = dark[y + dy, x + dx] / dark[y, x]
        value.append(float(np.mean([np.median(share[own]) for own in classes])))
    return Curve.numbered(value)


@family(
    "lines_of_{0}",
    (("bias",), ("dark",)),
    "noise",
    "row and column noise in {0} frames",
    "noise / white noise",
    x=LINES,
    power=True,
)
def lines_of_stacks(kind: str, evidence: Evidence) -> Curve | None:
    """Of frames without light."""
    stacks = [s for s in evidence.of_kind(kind) if len(s.adu) >= 3]
    if not stacks or not evidence.dithered:
        return None
    rests = [_calm(stack.adu, evidence.good) for stack in stacks]
    values = [line_power(rest, evidence.good) for rest in rests]
    return Curve.numbered(np.average(values, axis=0, weights=list(map(len, rests))))
