"""Noise of frames without light: of samples, of common lines, and of the mean level."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.estimators.detector.calibration import usual_rate
from pixcal.estimators.detector.code_histogram import step_of
from pixcal.estimators.detector.emva import Measure
from pixcal.estimators.detector.missing_codes import missing_codes, noise_before_missing_codes
from pixcal.estimators.detector.pair_noise import (
    LINES,
    along_lines,
    shared_by_blocks,
    shared_by_lines,
)
from pixcal.estimators.detector.rounded_noise import BELOW, FRAMES, noise_of_codes
from pixcal.kernels.photon_transfer import BLOCK
from pixcal.kernels.rounding import SHEPPARD
from pixcal.model.arrays import F32, F64
from pixcal.stages.reduce.calibration import on_grid
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.flat_survey import middle_rows
from pixcal.stages.reduce.measuring import Measuring
from pixcal.storage.place import Place

# Relative error of noise that is cut off at the lowest code: a constant, and a factor on the cube
# of step over noise. It is the largest error if pixels that differ by 10 % rms are treated as
# equal.
_CUT_OFF, _COARSE_CUT_OFF = 0.006, 0.004
_LEAST = 0.05  # smallest measurable noise, in steps
_FILTERED = 0.1  # least correlation of neighbours in filtered samples
_LINE_ERRORS = 3.0  # errors by which noise common to lines may be larger than it appears
_CODES = 1 << 17  # pixels whose codes tell noise below a step
_MOST_CODES = 1 << 20  # most codes of a converter
_PAIRS, _SAMPLES = 16, 1 << 20  # pairs, and samples of each frame, that measure block noise


def lost_in_blocks(job: Measuring) -> Measure:
    """Variance (ADU²) that `pair_statistics` removes with the means of its blocks; its error."""
    lost = [shared_by_blocks(pair, job.quantum) for pair in _pairs(job)]
    if not lost:
        return 0.0, 0.0
    mean = max(float(np.mean(lost)), 0.0)
    return mean, float(np.std(lost, ddof=1)) / math.sqrt(len(lost)) if len(lost) > 1 else mean


@dataclass(frozen=True)
class Nearby:
    """Noise that neighbours share in frames without light."""

    near: dict[str, float]  # by line: correlation of next neighbours beyond a line through far ones
    lines: dict[str, float]  # most variance (ADU²) that all pixels of the line share

    @classmethod
    def of(cls, job: Measuring, variance: float) -> "Nearby | None":
        """Of the read-noise series, whose samples have a variance (ADU²)."""
        shared = np.array([along_lines(pair, job.quantum) for pair in _pairs(job)])
        if len(shared) < 2 or not variance > 0:
            return None
        near, midway, far = np.moveaxis(shared.mean(axis=0), 1, 0)
        error = shared[:, :, 2].std(axis=0, ddof=1) / math.sqrt(len(shared))
        return cls(
            dict(zip(LINES, ((near - 2 * midway + far) / variance).tolist(), strict=True)),
            dict(zip(LINES, (far + _LINE_ERRORS * error).tolist(), strict=True)),
        )

    @property
    def filtered(self) -> bool:
        """Whether samples were filtered before they were written."""
        return max(self.near.values()) > _FILTERED


def _pairs(job: Measuring) -> Iterator[F32]:
    """Differences (y, x), of full blocks, of successive frames of the read-noise series."""
    series = job.read_series
    ny, nx = (n // BLOCK * BLOCK for n in job.shape)
    if series is None or min(ny, nx) < 2 * BLOCK:
        return
    reader = job.frames[series.array]
    apart = BLOCK * max(ny * nx // _SAMPLES, 1)

    def sample(frame: int) -> F32:
        parts = [
            reader.read((frame, frame + 1), (y, y + BLOCK), (0, nx)) for y in range(0, ny, apart)
        ]
        return np.asarray(np.concatenate(parts, axis=1)[0], np.float32)

    for a, b in list(zip(series.frames[::2], series.frames[1::2], strict=False))[:_PAIRS]:
        yield sample(a) - sample(b)


def dark_rate(folder: Place, job: Measuring) -> float:
    """Mean dark signal (ADU/s) of pixels that are not hot; zero if it was not measured."""
    # What the camera subtracts of it is included.
    if not job.dark:
        return 0.0
    rate = usual_rate(on_grid(folder, job.shape, ("dark_rate",))[0], job.options.hot_sigma)
    return rate + job.subtracted[0]


def read_noise(
    dark: F64, lost: Measure, shot: Measure, job: Measuring
) -> tuple[Measure | None, Measure | None, float | None]:
    """Noise without light (ADU), less the variance of the dark signal, with and without rounding.

    Also the scatter of its logarithm over pixels where it is below a step. ``lost``: see
    `lost_in_blocks`. ``shot``: the shot variance of the dark signal (ADU²).
    """
    dof, _, square = dark[:, :3].sum(axis=0)
    if not dof > 0:
        return None, None, None
    whole = square / dof + lost[0]
    error = math.hypot(square / dof * math.sqrt(2 / dof), lost[1], shot[1])
    variance = max(whole - shot[0], SHEPPARD * job.quantum**2), error
    if is_cut_off(job):
        own = max(variance[0] - SHEPPARD * job.quantum**2, (_LEAST * job.quantum) ** 2)
        off = _CUT_OFF + _COARSE_CUT_OFF * (job.quantum / math.sqrt(own)) ** 3
        less_sure = variance[0], math.hypot(variance[1], 2 * off * own)
        return *of_variance(less_sure, job.quantum), None
    noise = math.sqrt(variance[0])
    measured = noise, variance[1] / (2 * noise) if noise else 0.0
    if not job.quantum:
        return measured, measured, None
    return measured, *_before_rounding(variance, shot[0], job)


def line_noise(dark: F64, shape: tuple[int, int]) -> dict[str, Measure]:
    """Variance (ADU²) that pixels of a row, and of a column, share, where it is significant.

    Each line of each pair of frames is one sample of it, which its error counts.
    """
    pixels = dict(zip(LINES, shape[::-1], strict=True))
    return {
        name: (shared, math.hypot(error, shared * math.sqrt(2 * pixels[name] / dark[:, 0].sum())))
        for name, (shared, error) in shared_by_lines(dark).items()
        if shared
    }


def of_few_lines(noise: Measure, dark: F64, shape: tuple[int, int]) -> Measure:
    """Noise whose error allows for the few lines that show what their pixels share."""
    errors = [error / (2 * noise[0]) for _, error in line_noise(dark, shape).values()]
    return noise[0], math.hypot(noise[1], *errors)


def is_cut_off(job: Measuring) -> bool:
    """Whether the noise of the read-noise series is cut off at its lowest code."""
    return job.read_series is not None and job.read_series.array in job.cut_off


def of_variance(variance: Measure, step: float) -> tuple[Measure, Measure]:
    """Noise (ADU) with and without rounding from a variance (ADU²), at any level."""
    least = _LEAST * step
    whole, unrounded = (
        max(math.sqrt(max(v, 0.0)), least) for v in (variance[0], variance[0] - SHEPPARD * step**2)
    )
    return (whole, variance[1] / (2 * whole)), (unrounded, variance[1] / (2 * unrounded))


def _before_rounding(
    variance: Measure, shot: float, job: Measuring
) -> tuple[Measure | None, float | None]:
    """Noise of the amplifier and its error (ADU), from the codes that pixels have.

    Also the scatter of its logarithm over pixels, if the codes show it. ``variance``: without
    ``shot``, that of the dark signal (ADU²).
    """
    assert job.read_series is not None
    step, series = job.quantum, job.read_series
    in_steps = variance[0] / step**2, variance[1] / step**2
    reader, counts = job.frames[series.array], code_counts([series], job)
    measured, spread = None, None
    if len(missing_codes(counts)):
        # A few frames without light cannot show a pattern of missing codes.
        multiple = step_of(code_counts([series, *job.flat], job))[0]
        # With missing codes, means of darks are not linear in exposure time.
        mean = np.mean([middle_rows(reader, n, n + 1) for n in series.frames], axis=0)
        measured = noise_before_missing_codes(
            *in_steps, mean.ravel() / step, len(series.frames), counts, multiple
        )
    elif in_steps[0] > BELOW**2 + SHEPPARD:
        noise = math.sqrt(in_steps[0] - SHEPPARD)
        measured = noise, in_steps[1] / (2 * noise)
    else:
        rows = max(_CODES // job.shape[1], 1)
        frames = [middle_rows(reader, n, n + 1, rows).ravel() for n in series.frames[:FRAMES]]
        samples = np.array(frames, float)
        samples = samples[:, np.isfinite(samples).all(axis=0)]
        codes = np.rint(samples / step).astype(np.int64)
        measured, spread = noise_of_codes(codes, shot / step**2)
    return measured and (step * measured[0], step * measured[1]), spread


def code_counts(groups: Sequence[Group], job: Measuring) -> F64:
    """Counts of each code, in steps, in the middle rows of given series."""
    counts = np.zeros(0)
    for group in groups:
        reader = job.frames[group.array]
        for n in group.frames:
            rows = middle_rows(reader, n, n + 1)
            codes = np.maximum(rows[np.isfinite(rows)], 0) // job.quantum
            codes = codes[codes < _MOST_CODES].astype(np.int64)
            more = np.bincount(codes, minlength=len(counts)).astype(float)
            more[: len(counts)] += counts
            counts = more
    return counts


def bias_wander(job: Measuring) -> float:
    """Frame-to-frame change of the level without light, rms (ADU)."""
    series = job.read_series
    if series is None or len(series.frames) < 2:
        return 0.0
    reader = job.frames[series.array]
    means = [np.nanmean(middle_rows(reader, n, n + 1)) for n in series.frames]
    return float(np.std(means, ddof=1))
