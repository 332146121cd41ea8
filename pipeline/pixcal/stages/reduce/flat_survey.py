"""A first survey of the frames: the level of each, and where samples saturate.

Frames of one exposure time have several levels if the lamp was changed. At saturation of the
converter or the well, samples pile up at their highest code.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pixcal.estimators.detector.calibration import MIN_STEPS
from pixcal.kernels.medians import finite_median
from pixcal.model.arrays import F32, F64, I64, Mask
from pixcal.model.errors import InputError
from pixcal.storage.frame_reader import Reader

ROWS = 64  # rows that are surveyed, in the middle of the frames
TOGETHER = 64  # frames read at once: those of a chunk of a cube
APART = 0.05  # relative distance of two levels that exceeds the flicker of a lamp
# The same for a steady lamp: least relative distance, and its ratio to the typical difference of
# successive frames.
FINE, STEADY = 0.005, 6.0
MIN_SHARE = 1e-3  # least share of the samples of a frame at the highest code
MIN_SAMPLES = 50
_WRAPS = 1024  # least distance (ADU) of wrapped samples below those that are possible
MIN_CHANGES = 3  # fewest frame-to-frame changes to measure a lamp's flicker
NEIGHBOURS = 16  # codes below the highest that are compared with it
_CLEAR = 5.0  # least level, in noises of a sample, that tells a pixel without light by one flat
_LIT = 1.0  # level of a flat, over the noise of a sample without light, from which it is lit
MIN_DARKS = 5  # fewest steps between levels of darks to separate groups
# least step between two groups, over the median step and over the noise of a sample
JUMP, NOTABLE = 20.0, 0.1
OUTLIER = 9.0  # median deviations above which a difference of two frames is not noise
PILED = 4  # least ratio of samples at a pile to those at any of these codes
WIDE = 4.0  # codes between one sigma below and above in flats that are not full, to know full ones
_STEADY_LAMP = 0.25  # largest relative difference of the light per second of a steady lamp
_ONE_SIGMA = tuple(ndtr([-1.0, 1.0]))


@dataclass(frozen=True)
class FlatSurvey:
    """Levels and saturation of the flats, from a survey."""

    levels: F64  # (t,) mean of each frame above the bias (ADU)
    # code (ADU) at which samples pile up; None if none do, or samples are real numbers
    saturation: float | None
    noise: float = 0.0  # of a sample in bias frames (ADU); zero without two of them
    wrapped: int | None = None  # first flat whose highest codes were read as negative numbers

    @property
    def lit(self) -> Mask:
        """Flats (t,) that hold light: all, if the level without light is unknown, or none does."""
        # A level within the noise of one sample is no flat: the shutter was closed, or the lamp
        # off.
        lit = np.abs(self.levels) > _LIT * self.noise
        return lit if lit.any() else np.ones(len(lit), np.bool_)

    def brightest(self, share: float) -> tuple[int, float] | None:
        """Number of the brightest flat, and a ``share`` of its level (ADU above bias).

        None if that share is within the noise of one sample, or the noise is unknown.
        """
        frame = int(self.levels.argmax())
        least = share * float(self.levels[frame])
        return (frame, least) if self.noise and least > _CLEAR * self.noise else None

    def mistimed(self, exposures: Sequence[float | None]) -> Mask:
        """Flats (t,) of a steady lamp, few of many, whose light contradicts their exposure time."""
        times = np.array([t if t else np.nan for t in exposures], float)
        rates = self.levels / times
        # Full pixels gather less light than their time would give.
        faint = self.levels < self.levels.max() / 2
        usual = float(np.median(rates[known])) if (known := faint & (rates > 0)).any() else np.nan
        off = (rates > 2 * usual) | (faint & (rates < usual / 2))
        rest = np.abs(rates[known & ~off] / usual - 1)
        many = len(np.unique(times[known & ~off])) >= MIN_STEPS and 10 * off.sum() <= len(off)
        return off if many and rest.max() < _STEADY_LAMP else np.zeros(len(off), np.bool_)

    def may_have_bands(
        self, arrays: Mapping[str, Reader], groups: Sequence[Sequence[int]], full: float
    ) -> bool:
        """Whether rows of flats may share noise that counts in `without_bands`.

        ``groups``: numbers of the flats of each level; ``full``: level of saturation, ADU.
        """
        _, ny, nx = arrays["flat"].shape
        each = (zip(group[::2], group[1::2], strict=False) for group in groups if ny > 1)
        pairs = [pair for own in each for pair in own]
        shared = noise = square = 0.0
        for pair in pairs:
            change = self._change(arrays, pair, full)
            own = float(change.var()) / nx
            shared += float(change.mean(axis=1).var(ddof=1)) - own
            noise, square = noise + nx * own, square + 2 * own**2 / len(change)
        least = noise * math.sqrt(2 / max(len(pairs) * ny * nx, 1))
        # Half of it, as rows of two outputs may have bands of their own.
        return not shared + 2 * math.sqrt(square) < least / 2

    def _change(self, arrays: Mapping[str, Reader], pair: Sequence[int], full: float) -> F32:
        """Difference (y, x) of the middle rows of flats made equally bright; zero for outliers."""
        dark = next((arrays[name] for name in ("bias", "dark") if name in arrays), None)
        unlit = np.float32(0) if dark is None else middle_rows(dark, 0, 1)[0].astype(np.float32)
        first, second = (middle_rows(arrays["flat"], n, n + 1)[0].astype(np.float32) for n in pair)
        a, b = self.levels[list(pair)]
        change = (first - unlit) - (second - unlit) * np.float32(a / b if a * b > 0 else 1)
        change[(first >= full) | (second >= full)] = np.nan
        change -= np.float32(finite_median(change.ravel()))
        change[~(np.abs(change) <= OUTLIER * finite_median(np.abs(change).ravel()) + 1)] = 0
        return np.asarray(change, np.float32)

    def of_frames(self, numbers: Sequence[int]) -> "FlatSurvey":
        """The survey of some of the flats."""
        return replace(self, levels=self.levels[list(numbers)])

    @classmethod
    def of(cls, arrays: Mapping[str, Reader]) -> "FlatSurvey":
        """Survey the middle rows of all flats, and of a frame without light."""
        dark = next((arrays[name] for name in ("bias", "dark") if name in arrays), None)
        unlit = None if dark is None else middle_rows(dark, 0, 1)
        pedestal = 0.0 if unlit is None else float(np.nanmean(unlit))
        bias = arrays.get("bias")
        noise = 0.0 if bias is None or bias.shape[0] < 2 else math.sqrt(_noise_of_pair(bias, 0, 1))
        flats = arrays["flat"]
        whole = of_whole_numbers(flats)
        step = code_step([flats]) if whole else 1
        levels: list[float] = []
        tops: list[_Top] = []
        lowest = _lowest(flats, unlit)
        wrapped: list[int] = []
        blocks = range(0, flats.shape[0], TOGETHER)
        for frame in (s for n in blocks for s in middle_rows(flats, n, n + TOGETHER)):
            samples = frame[np.isfinite(frame)] if np.isfinite(frame).any() else np.array(pedestal)
            if np.mean(samples < lowest) > MIN_SHARE:
                wrapped.append(len(levels))
            levels.append(float(samples.mean(dtype=float)) - pedestal)
            if whole:
                top = int(samples.max())
                near = samples[samples >= top - NEIGHBOURS * step].astype(np.int64)
                below = (top - near) // step
                counts = np.bincount(below.ravel(), minlength=NEIGHBOURS + 1)
                low, high = np.quantile(samples, _ONE_SIGMA)
                share, spread = float(counts[0] / samples.size), float(high - low) / step
                tops.append(_Top(top, counts, share, spread))
        return cls(np.array(levels), _pile(tops, step), noise, min(wrapped, default=None))

    def steps(self, exposures: Sequence[float | None]) -> list[int]:
        """Index from 0 of each frame's level among those of its exposure time."""
        steps = np.zeros(len(exposures), int)
        times = np.array([np.nan if t is None else t for t in exposures], float)
        for time in np.unique(times):
            frames = np.flatnonzero((times == time) | (np.isnan(times) & np.isnan(time)))
            order = frames[np.argsort(self.levels[frames], kind="stable")]
            levels = self.levels[order]
            bounds = np.flatnonzero(np.diff(levels) > APART * np.maximum(levels[1:], 1.0)) + 1
            parts = (fine for part in np.split(order, bounds) for fine in self._parted(part))
            for step, part in enumerate(parts):
                steps[part] = step
        return [int(step) for step in steps]

    def _parted(self, frames: I64) -> list[I64]:
        """Split frames of similar levels where a steady lamp was changed slightly."""
        # A level has two or more successive frames, whose differences measure the lamp's flicker.
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


def _lowest(flats: Reader, unlit: NDArray[Any] | None) -> float:
    """Negative sample (ADU) below which no flat of signed 16-bit integers can fall; else -inf."""
    # Light makes no sample darker. ``unlit``: samples of a frame without light, if there is one.
    if flats.dtype != np.int16 or unlit is None:
        return -math.inf
    low, middle = np.nanquantile(unlit, (MIN_SHARE, 0.5))
    return min(float(2 * low - middle), 0.0) - _WRAPS


def rough_gain(arrays: Mapping[str, Reader], levels: F64, groups: Sequence[Sequence[int]]) -> float:
    """Gain (e-/ADU) to a few tens of per cent, from two frames at the level with most shot noise.

    ``levels``: (t,) of the flats (ADU above bias); ``groups``: numbers of the flats of each level.
    InputError if no two flats have one level, or they show no shot noise.
    """
    dark = next((arrays[name] for name in ("bias", "dark") if name in arrays), None)
    read = 0.0 if dark is None or dark.shape[0] < 2 else _noise_of_pair(dark, 0, 1)
    pairs = [
        (_noise_of_pair(arrays["flat"], *group[:2]) - read, float(levels[list(group[:2])].mean()))
        for group in groups
        if len(group) > 1
    ]
    photons, level = max(pairs, default=(0.0, 0.0))
    if not (photons > 0 and level > 0):
        raise InputError(
            "detector.gain_e_per_adu: missing, and not measurable, because no two flats at the "
            "same level show photon noise; give it in e-/ADU"
        )
    return level / photons


def _noise_of_pair(frames: Reader, one: int, other: int) -> float:
    """Variance (ADU²) of a sample from the difference of two frames, without outliers."""
    first, second = (middle_rows(frames, n, n + 1)[0].astype(float) for n in (one, other))
    change = second - first
    change -= np.nanmedian(change)
    within = np.abs(change) <= OUTLIER * np.nanmedian(np.abs(change)) + 1
    return float(np.nanmean(change[within] ** 2)) / 2


def of_several_levels(frames: Reader) -> bool:
    """Whether levels of frames without light form separate groups, as different exposures do."""
    some = [middle_rows(frames, n, n + 1)[0].astype(float) for n in range(frames.shape[0])]
    steps = np.diff(np.sort([np.nanmean(one) for one in some]))
    if len(steps) < MIN_DARKS:
        return False
    noise = float(np.nanstd(some[1] - some[0])) / math.sqrt(2)
    return bool(steps[1:-1].max() > max(JUMP * float(np.median(steps)), NOTABLE * noise))


def of_whole_numbers(frames: Reader) -> bool:
    """Whether samples are whole numbers, which files of real numbers may also hold."""
    if frames.dtype.kind in "iu":
        return True
    ends = (middle_rows(frames, n, n + 1) for n in {0, frames.shape[0] - 1})
    return all(np.array_equal(np.rint(samples), samples, equal_nan=True) for samples in ends)


def code_step(arrays: Sequence[Reader]) -> int:
    """Largest step of which all surveyed samples are multiples; 1 if they are few."""
    ends = [middle_rows(a, n, n + 1) for a in arrays for n in {0, a.shape[0] - 1}]
    codes = {int(code) for rows in ends for code in np.unique(rows[np.isfinite(rows)])}
    return math.gcd(*codes) if len(codes) >= NEIGHBOURS else 1


def middle_rows(frames: Reader, begin: int, end: int, rows: int = ROWS) -> NDArray[Any]:
    """Samples (t, y, x) of the middle ``rows`` of a range of frames."""
    count, ny, nx = frames.shape
    first = max((ny - rows) // 2, 0)
    read: NDArray[Any] = frames.read(
        (begin, min(end, count)), (first, min(first + rows, ny)), (0, nx)
    )
    return read


@dataclass(frozen=True)
class _Top:
    """Highest samples of a frame."""

    code: int  # the highest
    counts: I64  # samples at each code from there down
    share: float  # of the samples at the highest
    spread: float  # codes between the quantiles at one sigma below and above the median


def _pile(tops: Sequence[_Top], step: int) -> float | None:
    """Highest code, or the one below, if it has far more samples than the codes below these."""
    if not tops:
        return None
    highest = max(top.code for top in tops)
    at_top = [top for top in tops if top.code == highest]
    counts = np.sum([top.counts for top in at_top], axis=0)
    piled = counts[0] >= MIN_SAMPLES and counts[0] > PILED * counts[1:].max()
    if piled and max(top.share for top in at_top) >= MIN_SHARE:
        return float(highest)
    # Full wells are read as one of two codes. Flats that are not full vary more if brighter.
    narrow = min(top.spread for top in at_top) <= 1 and max(top.spread for top in tops) >= WIDE
    double = counts[:2].min() >= MIN_SAMPLES and counts[:2].sum() > PILED * counts[2:].max()
    return float(highest - step) if narrow and double else None
