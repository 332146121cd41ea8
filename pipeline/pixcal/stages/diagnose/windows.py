"""Choose pixels to analyse: all of a small detector, windows of a large one."""

import math

from pixcal.stages.diagnose.frames import SAMPLES
from pixcal.stages.tiles import Part

SIDE = 128  # side (pixels) of a window on a large detector: the width of a chunk of the cube
LARGEST = 288  # most rows or columns of a detector used whole; beyond, windows do not overlap
WHOLE = 2  # times the samples of a window that a detector without fringes is used whole
APART = 4  # least size of a detector, in window sides, for windows aligned to chunks


def chosen_windows(shape: tuple[int, int], frames: int = 0) -> tuple[Part, tuple[Part, ...]]:
    """The window to which effects are fitted, and those on which they are tested.

    A small detector is one window. On a large one, the first is in the centre, the others are at
    four other places (two if one side is short). Without fringes, ``frames``, the number in each
    half, sets the size: the fewer frames, the more pixels.
    """
    if max(shape) <= LARGEST or 0 < frames * math.prod(shape) <= WHOLE * SAMPLES:
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
