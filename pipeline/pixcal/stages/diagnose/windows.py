"""Which pixels and frames are looked at: all of a small window, some windows of a large one."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pixcal.model.arrays import Indices
from pixcal.stages.diagnose.parts import Half, Table, groups
from pixcal.stages.evidence import Part

SIDE = 128  # pixels along the side of a window on a large detector: those of a chunk of the cube
LARGEST = 288  # rows or columns of a detector that are taken whole; of more, windows do not overlap
APART = 4  # sides of a window that a detector has at least where windows lie on chunks
# samples of a fringe set that are looked at in each half of the frames and each window
SAMPLES = 6_000_000
FEWEST = 4  # calibration frames of an exposure time that can be halved; fewer serve both halves


def chosen_windows(shape: tuple[int, int], frames: int = 0) -> tuple[Part, tuple[Part, ...]]:
    """The window that effects are fitted on, and those that they are tried on.

    A small detector is one window, and only the frames are parted. On a large one, effects are
    fitted in the middle and tried in four other places (two, where one side is short). Where there
    are no fringes but few ``frames``, more pixels in the middle make up for them.
    """
    if max(shape) <= LARGEST:
        return whole_of(shape), (whole_of(shape),)

    def place(share_y: float, share_x: float) -> Part:
        spans = []
        for size, share in zip(shape, (share_y, share_x), strict=True):
            if size <= LARGEST:
                share = 0.5
            side = min(SIDE, size)
            # On chunks of the cube, where there are enough to lie apart on.
            grid = SIDE if size >= APART * SIDE else 1
            first = min(round((size - side) * share / grid) * grid, size - side)
            spans.append((first, first + side))
        return spans[0], spans[1]

    middle = place(0.5, 0.5)
    others = {place(y, x) for y, x in ((0.1, 0.1), (0.1, 0.9), (0.9, 0.1), (0.9, 0.9))}
    tried = tuple(sorted(others))
    if not frames:
        return middle, tried
    side = math.isqrt(SAMPLES // frames)
    rows, columns = (
        _widened(own, side, (a[1], b[0]) if a != b else (0, size))
        for own, size, a, b in zip(middle, shape, tried[0], tried[-1], strict=True)
    )
    return (rows, columns), tried


def _widened(span: tuple[int, int], side: int, room: tuple[int, int]) -> tuple[int, int]:
    """Rows or columns in the middle of some room, of a side, if they are more than these."""
    side = min(side, room[1] - room[0])
    if side <= span[1] - span[0]:
        return span
    first = (room[0] + room[1] - side) // 2
    return first, first + side


def whole_of(shape: tuple[int, int]) -> Part:
    """All rows and columns."""
    return (0, shape[0]), (0, shape[1])


@dataclass(frozen=True)
class Split:
    """Frames that effects are fitted on (``learn``), and frames they are tried on (``test``)."""

    learn: Half
    test: Half


def split(tables: Mapping[str, Table], pixels: int, full_flats: Sequence[int] = ()) -> Split:
    """First and second half, in order of time, of every array and exposure time.

    Of long fringe sets the first and the last frames only, `SAMPLES` in each half.

    Parameters
    ----------
    tables : mapping
        As in ``frames.json``.
    pixels : int
        Of a window.
    full_flats : sequence of int
        Flats whose pixels are full; left out unless all are.
    """
    learn, test = {}, {}
    for name, table in tables.items():
        exposures = np.array([np.nan if t is None else t for t in table["exptime_s"]], float)
        fringes = "/" in name
        early, late = [], []
        every = [np.arange(len(exposures))] if fringes else groups(table)
        kept = [own for own in every if name != "flat" or not np.isin(own, full_flats).any()]
        for own in kept or every:
            one, other = _halves(own, SAMPLES // pixels)
            early.append(one)
            late.append(other)
        learn[name] = np.sort(np.concatenate(early))
        test[name] = np.sort(np.concatenate(late))
    return Split(Half(learn), Half(test))


def _halves(frames: Indices, most: int) -> tuple[Indices, Indices]:
    if len(frames) < FEWEST:
        return frames, frames
    middle = len(frames) // 2
    return frames[: min(middle, most)], frames[max(middle, len(frames) - most) :]
