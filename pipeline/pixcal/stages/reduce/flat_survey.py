"""What frames show at first sight: how bright each one is, and where samples saturate.

Frames of one exposure time may be of several levels, where the lamp was changed. Where a converter
or a well ends, samples pile up at their highest code.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pixcal.model.arrays import F64, I64
from pixcal.model.errors import InputError
from pixcal.storage.frame_reader import Reader

ROWS = 64  # rows that are looked at, in the middle of the frames
TOGETHER = 64  # frames that are read at once: those of a chunk of a cube
APART = 0.05  # relative distance of two levels that are not one lamp's flicker
# The same where the lamp is steady: least distance, and that over the usual one of two frames that
# follow one another.
FINE, STEADY = 0.005, 6.0
MIN_SHARE = 1e-3  # of the samples of a frame that lie at the highest code at least
MIN_SAMPLES = 50
MIN_CHANGES = 3  # fewest, from frame to frame, that tell a lamp's flicker
NEIGHBOURS = 16  # codes below the highest that are held against it
MIN_DARKS = 5  # fewest steps between levels of darks that tell groups apart
# least step between two groups: over the median step, and over the noise of a sample
JUMP, NOTABLE = 20.0, 0.1
OUTLIER = 9.0  # median deviations beyond which a difference of two frames is no noise
PILED = 4  # how many times as many samples as at any of these are a pile


@dataclass(frozen=True)
class FlatSurvey:
    """Flats at first sight."""

    levels: F64  # (t,) mean of each frame above the bias (ADU)
    # code (ADU) at which samples pile up; None where none do, or samples are real numbers
    saturation: float | None

    @classmethod
    def of(cls, arrays: Mapping[str, Reader]) -> "FlatSurvey":
        """Look at the middle rows of all flats, and of a frame without light."""
        dark = next((arrays[name] for name in ("bias", "dark") if name in arrays), None)
        pedestal = 0.0 if dark is None else float(np.nanmean(middle_rows(dark, 0, 1)))
        flats = arrays["flat"]
        whole = of_whole_numbers(flats)
        levels, tops = [], []
        for number in range(flats.shape[0]):
            if number % TOGETHER == 0:
                several = middle_rows(flats, number, number + TOGETHER)
            samples = several[number % TOGETHER]
            levels.append(float(np.nanmean(samples)) - pedestal)
            if whole:
                top = int(samples.max())
                below = top - samples[samples >= top - NEIGHBOURS].astype(np.int64)
                counts = np.bincount(below.ravel(), minlength=NEIGHBOURS + 1)
                tops.append((top, counts, float(counts[0] / samples.size)))
        return cls(np.array(levels), _pile(tops))

    def steps(self, exposures: Sequence[float | None]) -> list[int]:
        """Number of the level of each frame among those of the same exposure time, from 0."""
        found = np.zeros(len(exposures), int)
        times = np.array([np.nan if t is None else t for t in exposures], float)
        for time in np.unique(times):
            own = np.flatnonzero((times == time) | (np.isnan(times) & np.isnan(time)))
            order = own[np.argsort(self.levels[own], kind="stable")]
            levels = self.levels[order]
            bounds = np.flatnonzero(np.diff(levels) > APART * np.maximum(levels[1:], 1.0)) + 1
            parts = (fine for part in np.split(order, bounds) for fine in self._parted(part))
            for step, part in enumerate(parts):
                found[part] = step
        return [int(step) for step in found]

    def _parted(self, frames: I64) -> list[I64]:
        """Frames of similar levels, parted where a steady lamp was changed a little between them.

        Frames of a level follow one another, two at least: how much those differ tells the lamp's
        flicker.
        """
        frames = np.sort(frames)
        change = np.abs(np.diff(self.levels[frames])) / max(float(self.levels[frames].max()), 1.0)
        if len(change) < MIN_CHANGES:
            return [frames]
        limit = max(FINE, STEADY * float(np.quantile(change, 0.25)))
        parts = np.split(frames, np.flatnonzero(change > limit) + 1)
        if min(len(part) for part in parts) < 2:
            return [frames]
        levels: list[I64] = []
        for part in sorted(parts, key=self._mean):
            if levels and self._mean(part) - self._mean(levels[-1]) < limit * self._mean(part):
                levels[-1] = np.concatenate([levels[-1], part])
            else:
                levels.append(part)
        return levels

    def _mean(self, frames: I64) -> float:
        return float(self.levels[frames].mean())


def rough_gain(arrays: Mapping[str, Reader], levels: F64, groups: Sequence[Sequence[int]]) -> float:
    """Gain (e-/ADU) to some tens of per cent, by two frames of the level with most photon noise.

    ``levels``: (t,) of the flats (ADU above bias); ``groups``: numbers of the flats of each level.
    InputError if no two flats are of one level, or they show no photon noise.
    """
    dark = next((arrays[name] for name in ("bias", "dark") if name in arrays), None)
    read = 0.0 if dark is None or dark.shape[0] < 2 else _noise_of_pair(dark, 0, 1)
    pairs = [(group[0], group[1]) for group in groups if len(group) > 1]
    found = [
        (_noise_of_pair(arrays["flat"], *pair) - read, float(levels[[*pair]].mean()))
        for pair in pairs
    ]
    photons, level = max(found, default=(0.0, 0.0))
    if not (photons > 0 and level > 0):
        raise InputError(
            "detector.gain_e_per_adu: missing, and cannot be measured, because no two flats of one "
            "level show photon noise; give it in e-/ADU"
        )
    return level / photons


def _noise_of_pair(frames: Reader, one: int, other: int) -> float:
    """Variance (ADU²) of a sample by the difference of two frames, without outliers."""
    first, second = (middle_rows(frames, n, n + 1)[0].astype(float) for n in (one, other))
    change = second - first
    change -= np.nanmedian(change)
    within = np.abs(change) <= OUTLIER * np.nanmedian(np.abs(change)) + 1
    return float(np.nanmean(change[within] ** 2)) / 2


def of_several_levels(frames: Reader) -> bool:
    """Whether frames without light fall into groups of levels far apart: of exposure times."""
    some = [middle_rows(frames, n, n + 1)[0].astype(float) for n in range(frames.shape[0])]
    steps = np.diff(np.sort([np.nanmean(one) for one in some]))
    if len(steps) < MIN_DARKS:
        return False
    noise = float(np.nanstd(some[1] - some[0])) / math.sqrt(2)
    return bool(steps[1:-1].max() > max(JUMP * float(np.median(steps)), NOTABLE * noise))


def share_at_zero(frames: Reader) -> float:
    """Share of the samples of the first frame that are zero, where no sample is below."""
    samples = middle_rows(frames, 0, 1)
    return 0.0 if samples.min() < 0 else float((samples == 0).mean())


def noise_above(frames: Reader) -> float:
    """Noise of the first frame (ADU) by its upper half alone: the lower may be cut off."""
    lower, upper = np.quantile(middle_rows(frames, 0, 1), ndtr([1.0, 2.0]))
    return float(upper - lower)


def of_whole_numbers(frames: Reader) -> bool:
    """Whether samples are whole numbers; files of real numbers may hold such."""
    if frames.dtype.kind in "iu":
        return True
    ends = (middle_rows(frames, n, n + 1) for n in {0, frames.shape[0] - 1})
    return all(np.array_equal(np.rint(samples), samples) for samples in ends)


def code_step(arrays: Sequence[Reader]) -> int:
    """Largest step of which all samples of some frames are multiples; 1 if they are few."""
    ends = ((array, n) for array in arrays for n in {0, array.shape[0] - 1})
    codes = {int(code) for array, n in ends for code in np.unique(middle_rows(array, n, n + 1))}
    return math.gcd(*codes) if len(codes) >= NEIGHBOURS else 1


def middle_rows(frames: Reader, begin: int, end: int) -> NDArray[Any]:
    """Samples (t, y, x) of the middle `ROWS` rows of some frames."""
    count, ny, nx = frames.shape
    first = max((ny - ROWS) // 2, 0)
    read: NDArray[Any] = frames.read(
        (begin, min(end, count)), (first, min(first + ROWS, ny)), (0, nx)
    )
    return read


def _pile(tops: Sequence[tuple[int, I64, float]]) -> float | None:
    """Highest code, if there are far more samples than just below it."""
    if not tops:
        return None
    highest = max(top for top, _, _ in tops)
    own = [(counts, share) for top, counts, share in tops if top == highest]
    counts = np.sum([c for c, _ in own], axis=0)
    piled = counts[0] >= MIN_SAMPLES and counts[0] > PILED * counts[1:].max()
    return float(highest) if piled and max(s for _, s in own) >= MIN_SHARE else None
