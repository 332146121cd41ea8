"""Frames that a camera or grabber delivered twice: their noise is not their own."""

from collections.abc import Mapping, Sequence

import numpy as np

from pixcal.model.arrays import F64
from pixcal.stages.ingest.cut_frames import left_out
from pixcal.storage.frames import Frame

_ONE_VALUE = 0.5  # share of a row with one value from which its noise is not seen


def repeats_of(facts: Mapping[str, F64]) -> list[int | None]:
    """Number of the first frame of an array with the same samples as each; None if there is none.

    By the checksums and largest samples of bands. Frames without noise, or with noise far below one
    code, are alike anyway: it is no evidence if the last row of a frame has one value in half of
    its pixels, as in a saturated flat, or if less than half of the frames are different. ``facts``:
    `pixcal.storage.frame_decoding.FACTS` by name, (time, band).
    """
    first: dict[bytes, int] = {}
    content = np.stack([facts[name] for name in ("crc", "largest", "last", "share")], axis=1)
    found = [first.setdefault(own.tobytes(), n) for n, own in enumerate(content)]
    if 2 * len(first) < len(found):
        return [None] * len(found)
    noisy = facts["share"][:, -1] < _ONE_VALUE
    return [one if one != n and noisy[n] else None for n, one in enumerate(found)]


def repeat_warning(array: str, frames: Sequence[Frame], repeats: Sequence[int | None]) -> list[str]:
    """Warnings on the frames of an array, given the result of `repeats_of`."""
    found = [
        f"{frames[n].name} (same as {frames[first].name})"
        for n, first in enumerate(repeats)
        if first is not None
    ]
    return left_out(f"{array}: frames identical to an earlier one", found, len(frames), "repeat_of")
