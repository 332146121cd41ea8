"""Black level so low that the converter cuts off part of the noise, at its lowest code.

Most converters end at code 0. A camera that subtracts black and then adds an offset ends at that
offset.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pixcal.model.arrays import F64, I64, Mask
from pixcal.stages.reduce.flat_survey import middle_rows, of_whole_numbers
from pixcal.storage.frame_reader import Reader

_FRAMES = 8
_SHARE, _COUNT = 1e-3, 400  # least share, and number, of samples at the lowest code
# A pile: most samples below its code, over those at it (a normal distribution of this noise, in
# steps, has three times as many or more).
_BELOW, _NOISE = 0.01, 1.5
# An edge: least samples lacking at the code below it, over all; least samples at it over the
# expected ones.
_LACKING, _EDGE = 5e-3, 1.05
# A pile spread over two codes: least share of samples at the second, higher, code that noise alone
# does not explain, and in standard errors.
_SPREAD, _SURE = 0.2, 5.0
_SECOND = 0.4  # least share of a pile at a second code over that at the first
_LEAVE = 0.1  # least share of the samples at the lowest code that are above it in the next frame


@dataclass(frozen=True)
class CutOff:
    """Frames without light whose noise is cut off."""

    code: float  # lowest code, ADU
    share: float  # of the samples, at that code
    noise: float  # rough noise of a sample (ADU), from the upper half: the lower is cut off

    @classmethod
    def of(cls, frames: Reader, step: float) -> "CutOff | None":
        """Cut-off of the first frames, whose samples are multiples of a step; None if none."""
        samples = middle_rows(frames, 0, _FRAMES)
        samples = samples[np.isfinite(samples).any(axis=(1, 2))]
        samples = samples[:, np.isfinite(samples).all(axis=0)]
        if not samples.size:
            return None
        lower, upper = np.quantile(samples, ndtr([1.0, 2.0]))
        noise, code = float(upper - lower), 0
        if len(samples) > 1 and of_whole_numbers(frames):
            counts = _Counts.of(samples)
            code = _pile(counts, lower, step) if noise > _NOISE * step else _edge(counts, step)
            # Else a quiet camera: all usual pixels are at this code, and a few warm ones above.
            leaving = samples[1:][samples[:-1] == code] > code
            alike = counts.alike_above(code)
            code = code if code > 0 and leaving.mean() > _LEAVE and alike else 0
        if not code and samples.min() < 0:
            return None
        share = float((samples <= code).mean())
        return cls(float(code), share, noise) if _changing(samples, code) > _SHARE else None


class Black(NamedTuple):
    """How a camera treats frames without light, as measured on whole frames.

    Parts of the frames, and simulations of them, are reduced like the whole.
    """

    cut_off: Mapping[str, CutOff]  # arrays whose noise is cut off at their lowest code
    without_dark: bool | None = None  # `GainFit.without_dark`; None: measured again in each part
    subtracted: float = 0.0  # dark signal (ADU/s) that the camera subtracts: see `subtracted_dark`
    excess_noise_factor: float = 1.0  # `Evidence.excess_noise_factor`, which needs three flats


class _Counts(NamedTuple):
    """Samples of some frames (t, y, x) by code."""

    code: F64  # (n,) ascending
    number: I64  # (n,) samples
    below: I64  # (n,) samples of lower codes, without pixels that never change: these are broken

    @classmethod
    def of(cls, samples: NDArray[Any]) -> "_Counts":
        changing = samples.min(axis=0) != samples.max(axis=0)
        code, number = np.unique(samples, return_counts=True)
        moving = np.sort(samples[:, changing], axis=None)
        return cls(code.astype(float), number, np.searchsorted(moving, code))

    def many(self) -> Mask:
        """Whether a code has enough samples to compare with those below."""
        return np.asarray(self.number > max(_SHARE * self.number.sum(), _COUNT))

    def alike_above(self, code: int) -> bool:
        """Whether the codes above one are equally wide, as far as noise tells."""
        # The logarithm of its counts bends downwards, where pixels differ upwards too, but not to
        # and fro from code to code.
        number = self.number[self.code > code].astype(float)
        error = np.sqrt(1 / number[:-2] + 4 / number[1:-1] + 1 / number[2:])
        bend = np.diff(np.log(number), 2) / error
        up, down = bend > _SURE, bend < -_SURE
        return not bool((down[:-2] & up[1:-1] & down[2:]).any())


def _pile(counts: _Counts, most: float, step: float) -> int:
    """Code up to ``most`` at which samples pile up, with hardly any below; 0 if there is none."""
    low = counts.many() & (counts.code < most)
    piled = low & (counts.below < _BELOW * counts.number)
    if not piled.any():
        return _spread_pile(counts, low, step)
    at = int(np.flatnonzero(piled)[-1])
    # Rounding after the cut may spread the pile over two codes. Noise alone is log-concave.
    after = counts.number[at + 1 : at + 4].astype(float)
    if len(after) == 3 and after[0] - after[1] ** 2 / after[2] > _SECOND * counts.number[at]:
        at += 1
    return int(counts.code[at])


def _spread_pile(counts: _Counts, low: Mask, step: float) -> int:
    """Second code of a pile whose first code has few of its samples; 0 if there is none."""
    at = int(np.argmax(low))
    near = counts.number[at : at + 3].astype(float)
    if at == 0 or len(near) < 3 or counts.below[at - 1] > _BELOW * near[0]:
        return 0
    if counts.code[at + 2] - counts.code[at] != 2 * step:
        return 0
    # Noise alone is log-concave.
    most = near[1] ** 2 / near[2]
    error = math.sqrt(near[0] + most**2 * (4 / near[1] + 1 / near[2]))
    beyond = near[0] - most > max(_SPREAD * near[0], _SURE * error)
    return int(counts.code[at]) if beyond else 0


def _edge(counts: _Counts, step: float) -> int:
    """Lowest code of noise of about a step, if many lower samples are lacking; else 0."""
    # The logarithms of the counts of normal noise lie on a parabola, which the codes above
    # continue.
    code, number, total = counts.code, counts.number, counts.number.sum()
    first = int(np.argmax(counts.many() & (counts.below < _SHARE * total)))
    # Rounding, or dark signal added, after the cut may spread the pile over two codes.
    for at in (first, first + 1):
        near = number[at : at + 4].astype(float)
        even = len(near) == 4 and code[at + 3] - code[first] == (at + 3 - first) * step
        if not even or near.min() < max(_SHARE * total, _COUNT):
            return 0
        above = np.log(near[1:])
        # Those expected at the code below the first; at the first too, where the pile is spread.
        lacking = math.exp(above @ ((6, -8, 3) if at == first else (10, -15, 6)))
        if at > first:
            lacking += math.exp(above @ (6, -8, 3)) - float(number[first])
        lost = lacking > max(_LACKING * total, counts.below[first] / _BELOW)
        if lost and near[0] > _EDGE * math.exp(above @ (3, -3, 1)):
            return int(code[at])
    return 0


def _changing(samples: NDArray[Any], code: int) -> float:
    """Share of samples (t, y, x) at a code, without broken pixels, which never change."""
    at_code = samples == code
    if len(samples) == 1 or np.median(samples) == code:
        return float(at_code.mean())
    return float((at_code & (samples.min(axis=0) != samples.max(axis=0))).mean())


def cut_offs(arrays: Mapping[str, Reader], step: float) -> dict[str, CutOff]:
    """Cut-offs of the bias and dark frames, by array."""
    by_array = {name: CutOff.of(arrays[name], step) for name in ("bias", "dark") if name in arrays}
    dark = by_array.get("dark")
    if dark is not None and "bias" in arrays:
        # Codes below the end, in frames of less charge: dark signal of skewed pixels has an edge.
        samples = middle_rows(arrays["bias"], 0, _FRAMES)
        changing = samples.min(axis=0) != samples.max(axis=0)
        if np.sum(samples[:, changing] < dark.code) > _BELOW * dark.share * samples.size:
            by_array["dark"] = None
    return {name: one for name, one in by_array.items() if one is not None}


def cut_off_warnings(by_array: Mapping[str, CutOff]) -> Sequence[str]:
    """Sentences about cut-offs."""
    return [
        f"{name} frames are cut off at code {one.code:.0f}, where {100 * one.share:.3g} % of their "
        "samples lie: level and noise are estimated from a normal distribution cut off there; "
        "raise the black level (offset) of the camera"
        for name, one in by_array.items()
    ]
