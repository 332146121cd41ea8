"""Black level so low that the converter cuts off part of the noise, at its lowest code.

Most converters end at code 0. A camera that subtracts black and then adds an offset ends at that.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from pixcal.stages.reduce.flat_survey import middle_rows, of_whole_numbers
from pixcal.storage.frame_reader import Reader

_SHARE = 1e-3  # least share of samples at the lowest code
# A pile: most samples below its code, over those at it (a normal distribution of this noise, in
# steps, has three times as many or more).
_BELOW, _NOISE = 0.01, 1.5
# An edge: least samples lacking at the code below it, over all; least samples at it over the
# expected ones.
_LACKING, _EDGE = 5e-3, 1.05
_SECOND = 0.4  # least share of a pile at a second code over that at the first


@dataclass(frozen=True)
class CutOff:
    """Frames without light whose noise is cut off."""

    code: float  # lowest code, ADU
    share: float  # of the samples, at that code
    noise: float  # rough noise of a sample (ADU), from the upper half: the lower is cut off

    @classmethod
    def of(cls, frames: Reader, step: float) -> "CutOff | None":
        """Cut-off of the first two frames, whose samples are multiples of a step; None if none."""
        samples = middle_rows(frames, 0, 2)
        if samples.min() < 0:
            return None
        lower, upper = np.quantile(samples, ndtr([1.0, 2.0]))
        noise = float(upper - lower)
        code = 0
        if of_whole_numbers(frames):
            code = _pile(samples, lower) if noise > _NOISE * step else _edge(samples, step)
        share = float((samples <= code).mean())
        return cls(float(code), share, noise) if _changing(samples, code) > _SHARE else None


def _pile(samples: NDArray[Any], most: float) -> int:
    """Code up to ``most`` at which samples pile up, with hardly any below; 0 if there is none."""
    codes, counts = np.unique(samples, return_counts=True)
    below = np.cumsum(counts) - counts
    piled = (counts > _SHARE * samples.size) & (below < _BELOW * counts) & (codes < most)
    if not piled.any():
        return 0
    at = int(np.flatnonzero(piled)[-1])
    # Rounding after the cut may spread the pile over two codes. Noise alone is log-concave.
    after = counts[at + 1 : at + 4].astype(float)
    if len(after) == 3 and after[0] - after[1] ** 2 / after[2] > _SECOND * counts[at]:
        at += 1
    return int(codes[at])


def _edge(samples: NDArray[Any], step: float) -> int:
    """Lowest code of noise of about a step, if many lower samples are lacking; else 0.

    The logarithms of the counts of normal noise lie on a parabola, which the codes above continue.
    """
    codes, counts = np.unique(samples, return_counts=True)
    first = int(np.argmax(counts > _SHARE * samples.size))
    # Rounding after the cut may spread the pile over two codes.
    for at, below in ((first, (6, -8, 3)), (first + 1, (10, -15, 6))):
        near = counts[at : at + 4].astype(float)
        even = len(near) == 4 and codes[at + 3] - codes[first] == (at + 3 - first) * step
        if not even or near.min() < _SHARE * samples.size:
            return 0
        above = np.log(near[1:])
        lacking = math.exp(above @ below)  # expected at the code below the first
        lost = lacking > max(_LACKING * samples.size, counts[:first].sum() / _BELOW)
        if lost and near[0] > _EDGE * math.exp(above @ (3, -3, 1)):
            return int(codes[at])
    return 0


def _changing(samples: NDArray[Any], code: int) -> float:
    """Share of samples (t, y, x) at a code, without pixels that are broken: that never change."""
    at_code = samples == code
    if len(samples) == 1 or np.median(samples) == code:
        return float(at_code.mean())
    return float((at_code & (samples[0] != samples[-1])).mean())


def cut_offs(arrays: Mapping[str, Reader], step: float) -> dict[str, CutOff]:
    """Cut-offs of the bias and dark frames, by array."""
    found = {name: CutOff.of(arrays[name], step) for name in ("bias", "dark") if name in arrays}
    return {name: one for name, one in found.items() if one is not None}


def cut_off_warnings(found: Mapping[str, CutOff]) -> Sequence[str]:
    """Sentences about cut-offs."""
    return [
        f"{name} frames are cut off at code {one.code:.0f}, where {100 * one.share:.2g} % of their "
        "samples lie: level and noise are estimated from a normal distribution cut off there; "
        "raise the black level (offset) of the camera"
        for name, one in found.items()
    ]
