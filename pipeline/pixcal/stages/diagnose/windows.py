"""Choose pixels and frames to analyse: all of a small detector, windows of a large one."""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.model.arrays import Indices
from pixcal.stages.diagnose.parts import FrameSubset, Table
from pixcal.stages.evidence import Part, groups

SIDE = 128  # side (pixels) of a window on a large detector: the width of a chunk of the cube
LARGEST = 288  # most rows or columns of a detector used whole; beyond, windows do not overlap
APART = 4  # least size of a detector, in window sides, for windows aligned to chunks
# samples of a fringe set to analyse, in each half of the frames and each window
SAMPLES = 6_000_000
FEWEST = 4  # least calibration frames of an exposure time to split; fewer serve both halves
# most fringe frames in a half: the computing time of their series grows with the square
MOST_FRAMES = 1500
# number of blocks, and least number of frames for it: with long blocks, few frames lack the
# preceding one; with short ones, both halves have the same drifts
BLOCKS = ((16, 384), (8, 192), (4, 32), (2, FEWEST))
TURN = (False, True, True, False)  # which blocks are held out: a steady drift is alike in both


def chosen_windows(shape: tuple[int, int], frames: int = 0) -> tuple[Part, tuple[Part, ...]]:
    """The window to which effects are fitted, and those on which they are tested.

    A small detector is one window. On a large one, the former is in the middle, the latter at four
    other places (two if one side is short). Without fringes, ``frames``, the number in each half,
    sets the size: the fewer frames, the more pixels.
    """
    if max(shape) <= LARGEST or 0 < frames * math.prod(shape) <= SAMPLES:
        return whole_of(shape), (whole_of(shape),)
    widest = math.isqrt(SAMPLES // frames) if frames else SIDE
    on_chunks = widest <= SIDE

    def place(share_y: float, share_x: float, wanted: int = SIDE) -> Part:
        spans = []
        for size, share in zip(shape, (share_y, share_x), strict=True):
            if size <= LARGEST:
                share = 0.5
            side = min(max(SIDE, min(wanted, size // 3)), size)
            first = (size - side) * share
            if on_chunks:
                # Align to the chunks of the cube if there are enough of them.
                grid = SIDE if size >= APART * SIDE else 1
                first = min(round(first / grid) * grid, size - side)
            elif share != 0.5:
                # Leave the third in the middle free.
                outer = max(size // 3 - side, 0)
                first = min(first, outer) if share < 0.5 else max(first, size - side - outer)
            spans.append((round(first), round(first) + side))
        return spans[0], spans[1]

    corners = ((0.1, 0.1), (0.1, 0.9), (0.9, 0.1), (0.9, 0.9))
    # Together they have as many samples as the middle window.
    tried = tuple(sorted({place(y, x, widest // 2) for y, x in corners}))
    return _widened(place(0.5, 0.5), widest**2, shape, tried), tried


def _widened(middle: Part, pixels: int, shape: tuple[int, int], tried: tuple[Part, ...]) -> Part:
    """The middle window, enlarged to a number of pixels if there is room between the others."""
    rows, columns = (
        (a[1], b[0]) if a != b else (0, size)
        for a, b, size in zip(tried[0], tried[-1], shape, strict=True)
    )
    high = _grown(middle[0], math.isqrt(pixels), rows)
    # Between windows above and below, whole rows are free.
    free = tried[0][0][1] <= high[0] and high[1] <= tried[-1][0][0]
    beside = (0, shape[1]) if free else columns
    return high, _grown(middle[1], pixels // (high[1] - high[0]), beside)


def _grown(span: tuple[int, int], size: int, room: tuple[int, int]) -> tuple[int, int]:
    """Rows or columns of a size in the middle of the room, if larger than the span."""
    size = min(size, room[1] - room[0])
    if size <= span[1] - span[0]:
        return span
    first = (room[0] + room[1] - size) // 2
    return first, first + size


def whole_of(shape: tuple[int, int]) -> Part:
    """All rows and columns."""
    return (0, shape[0]), (0, shape[1])


@dataclass(frozen=True)
class Split:
    """Frames to which effects are fitted (``learn``), and held-out frames (``test``)."""

    learn: FrameSubset
    test: FrameSubset
    shared: tuple[str, ...]  # arrays with exposure times that have too few frames to split


def split(tables: Mapping[str, Table], pixels: int, full_flats: Sequence[int] = ()) -> Split:
    """Assign blocks of every array and exposure time to the halves (`TURN`).

    A long fringe set contributes `SAMPLES` to each half; without fringes, all frames together do.
    Flats with full pixels are left out unless all have them. Without fringes, the first flat of an
    exposure time and the first dark after light are in both halves: they show lag most.
    """
    learn, test = {}, {}
    every = {name: _groups(name, table, full_flats) for name, table in tables.items()}
    most = SAMPLES // pixels
    fringes = any("/" in name for name in tables)
    if fringes:
        most = min(most, MOST_FRAMES)
    else:
        most = _equal_share([len(own) for of_name in every.values() for own in of_name], most)
    after_light = {n: table["after_light"] for n, table in tables.items() if "after_light" in table}
    for name, of_name in every.items():
        fitted, held_out = [], []
        for own in of_name:
            one, other = _halves(own, most)
            fitted.append(one)
            lags = name == "flat" or (name in after_light and after_light[name][own[0]])
            held_out.append(np.union1d(other, own[:1]) if lags and not fringes else other)
        learn[name] = np.sort(np.concatenate(fitted))
        test[name] = np.sort(np.concatenate(held_out))
    short = (name for name, of_name in every.items() if min(map(len, of_name)) < FEWEST)
    return Split(learn, test, tuple(short))


def _groups(name: str, table: Table, full_flats: Sequence[int]) -> list[Indices]:
    """Groups of frames of an array that are split together."""
    if "/" in name:
        return [np.arange(len(table["exptime_s"]))]
    every = groups(table)
    kept = [own for own in every if name != "flat" or not np.isin(own, full_flats).any()]
    return kept or every


def _of_half(count: int) -> int:
    """Number of frames in a half of ``count``."""
    return count if count < FEWEST else count // 2


def frames_of_half(tables: Mapping[str, Table]) -> int:
    """Calibration frames in each half."""
    return sum(
        _of_half(len(own))
        for name, table in tables.items()
        if "/" not in name
        for own in groups(table)
    )


def _equal_share(counts: Sequence[int], total: int) -> int:
    """Largest number of frames per group in a half that keeps the sum within a total."""
    left, share = total, total
    ordered = sorted(map(_of_half, counts))
    for n, count in enumerate(ordered):
        share = left // (len(ordered) - n)
        if count > share:
            return max(share, FEWEST // 2)
        left -= count
    return total


def _halves(frames: Indices, most: int) -> tuple[Indices, Indices]:
    if len(frames) < FEWEST:
        return frames, frames
    count = next(blocks for blocks, fewest in BLOCKS if len(frames) >= fewest)
    edges = [n * len(frames) // count for n in range(count + 1)]
    halves: tuple[list[Indices], list[Indices]] = ([], [])
    for n, (first, last) in enumerate(itertools.pairwise(edges)):
        size = min(last - first, 2 * most // count)
        halves[TURN[n % len(TURN)]].append(frames[first : first + size])
    return np.concatenate(halves[0]), np.concatenate(halves[1])
