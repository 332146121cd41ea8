"""Frames to leave out: interrupted transfers, and frames that a camera or grabber delivered twice.

An interrupted frame is constant, mostly zero, from some row to the end. A repeated frame has no
independent noise.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from pixcal.model.arrays import F64
from pixcal.storage.frame_decoding import BAND
from pixcal.storage.frames import Frame, first_few

_FULL = 0.98  # least share of a flat's largest sample in a saturated row
_ONE_VALUE = 0.5  # share of a row with one value from which its noise is not seen


def cut_from(array: str, facts: Mapping[str, F64], rows: int) -> list[int | None]:
    """First row without samples of each frame; None if all rows have them.

    Noise makes an exactly constant last row unlikely. Such a row is no evidence if most frames have
    one: rows may be dark on a camera whose noise is cut off at zero or below one code. Saturated
    rows are no evidence either. ``array``: ``bias``, ``dark``, ``flat``, ``fringes/<set>``.
    ``facts``: `pixcal.storage.frame_decoding.FACTS` by name, (time, band). ``rows``: of a frame.
    """
    share = facts["share"][:, -1]
    if np.quantile(share, 0.5, method="lower") >= 0.5:
        return [None] * len(share)
    largest, level = np.fmax.reduce(facts["largest"], axis=1), facts["last"][:, -1]
    usual = np.median(largest)
    # At a saturated step, all flats reach the converter's end, or full wells, which vary by a few
    # codes; in other arrays, most frames do.
    if array == "flat":
        full = level >= _FULL * np.maximum(usual, largest)
    else:
        full = (level == largest) & (level == usual)
    cut = (share == 1) & ~full
    return [
        _first_row(facts["last"][n], facts["constant"][n], rows) if cut[n] else None
        for n in range(len(share))
    ]


def _first_row(last: F64, constant: F64, rows: int) -> int:
    """First of the constant rows at the end, from the last sample and constant rows of bands."""
    first = rows
    for band in range(len(last) - 1, -1, -1):
        if not np.array_equal(last[band], last[-1], equal_nan=True):
            break
        first -= int(constant[band])
        if first > band * BAND:
            break
    return first


def cut_warning(
    array: str, frames: Sequence[Frame], first: Sequence[int | None], facts: Mapping[str, F64]
) -> list[str]:
    """Warnings on the frames of an array, given the arguments and result of `cut_from`."""
    cut = [
        f"{frame.name} (all samples {value:g} from row {row} on)"
        for frame, row, value in zip(frames, first, facts["last"][:, -1], strict=True)
        if row is not None
    ]
    return left_out(f"{array}: incomplete frames", cut, len(frames), "cut_from_row")


def left_out(what: str, frames: Sequence[str], count: int, key: str) -> list[str]:
    """Warning on frames that are not used, if there are any; ``key``: in ``frames.json``."""
    several = f"({len(frames)} of {count}): {first_few(frames)}; frames.json lists them ({key})"
    return [f"{what} are left out {several}"] if frames else []


def repeats_of(facts: Mapping[str, F64]) -> list[int | None]:
    """Number of the first frame of an array with the same samples as each; None if there is none.

    By the checksums and largest samples of bands. Frames with noise far below one code are
    identical anyway. So equal frames are no evidence if half of the pixels of a last row have one
    value, as in a saturated flat, or if less than half of the frames are different. ``facts``:
    `pixcal.storage.frame_decoding.FACTS` by name, (time, band).
    """
    first: dict[bytes, int] = {}
    content = np.stack([facts[name] for name in ("crc", "largest", "last", "share")], axis=1)
    earliest = [first.setdefault(frame.tobytes(), n) for n, frame in enumerate(content)]
    if 2 * len(first) < len(earliest):
        return [None] * len(earliest)
    noisy = facts["share"][:, -1] < _ONE_VALUE
    return [one if one != n and noisy[n] else None for n, one in enumerate(earliest)]


def repeat_warning(array: str, frames: Sequence[Frame], repeats: Sequence[int | None]) -> list[str]:
    """Warnings on the frames of an array, given the result of `repeats_of`."""
    same = [
        f"{frames[n].name} (same as {frames[first].name})"
        for n, first in enumerate(repeats)
        if first is not None
    ]
    return left_out(f"{array}: frames identical to an earlier one", same, len(frames), "repeat_of")
