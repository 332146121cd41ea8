"""Gain of a camera that multiplies electrons before the output."""

from dataclasses import replace

import numpy as np

from pixcal.estimators.detector.multiplication import (
    EXCESS,
    EXCESS_ERROR,
    MIN_FRAMES,
    Skew,
    is_multiplied,
    skew,
)
from pixcal.stages.reduce.detector_summary import Summary
from pixcal.stages.reduce.exposures import Group
from pixcal.stages.reduce.halves import frames_of
from pixcal.stages.reduce.ingested import Ingested
from pixcal.stages.reduce.measuring import Measuring
from pixcal.stages.tiles import centred

_SIDE = 512  # longest side of the middle of the detector whose frames are read
_FRAMES = 16  # most frames of a level that are read


def with_excess_noise(summary: Summary, source: Ingested, job: Measuring) -> Summary:
    """The summary with the gain of electrons, where a register multiplied them."""
    # The slope of photon transfer is then F² times that of the light. F² is that of a large
    # multiplication, as only the third moment of the noise is known.
    gain, dark = summary.gain, job.read_series
    if gain is None or dark is None or len(dark.frames) < MIN_FRAMES:
        return summary
    slope, variance = 1 / gain.gain, max(gain.read_variance[0], job.quantum**2 / 12)

    def of(group: Group, level: float) -> Skew | None:
        used, window = group.frames[:_FRAMES], centred(job.shape, _SIDE)
        frames = np.stack([*frames_of(source, group.array, used, window)])
        good = np.ones(frames.shape[1:], np.bool_)
        return skew(frames.astype(np.float32), level, variance, slope, good, job.quantum)

    groups = [(dark, 0.0)]
    groups += [
        (group, float(level))
        for group, level, used in zip(job.flat, summary.levels, summary.usable, strict=True)
        if used and len(group.frames) >= MIN_FRAMES
    ]
    points = [of(*one) for one in groups]
    if points[0] is None or not is_multiplied((p for p in points if p is not None), slope):
        return summary
    return replace(summary, gain=replace(gain, excess=(EXCESS, EXCESS * EXCESS_ERROR)))
