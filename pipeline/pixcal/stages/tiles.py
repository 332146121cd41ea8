"""Tiles, columns of chunks of 128 × 128 pixels of all frames, and strips of neighbours in a row."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.storage.cube import CHUNK

Index = tuple[int, int]
Strip = tuple[Index, ...]
Range = tuple[int, int]  # first row or column, and one after the last
Part = tuple[Range, Range]  # rows and columns

STRIP = 4  # tiles side by side whose maps are in one chunk: a file costs more than what is in it


def spans(stop: int, size: int, start: int = 0) -> Iterator[Range]:
    """Ranges from ``start`` to ``stop`` that end at multiples of a size."""
    for edge in range(start // size * size, stop, size):
        yield max(edge, start), min(edge + size, stop)


def grid(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of columns of chunks of a window (y, x)."""
    return -(-shape[0] // CHUNK[1]), -(-shape[1] // CHUNK[2])


def indices(shape: tuple[int, ...]) -> list[Index]:
    """All columns of chunks, in order."""
    rows, columns = grid(shape)
    return [(i, j) for i in range(rows) for j in range(columns)]


def extent(shape: tuple[int, ...], index: Index) -> Part:
    """((y0, y1), (x0, x1)) of a column of chunks."""
    (i, j), (_, cy, cx), (ny, nx) = index, CHUNK, shape
    return (i * cy, min((i + 1) * cy, ny)), (j * cx, min((j + 1) * cx, nx))


def map_chunk(shape: tuple[int, ...]) -> tuple[int, int]:
    """Rows and columns of a chunk of maps (y, x)."""
    return CHUNK[1], CHUNK[2] * min(STRIP, grid(shape)[1])


def span(shape: tuple[int, ...], strip: Sequence[Index]) -> Part:
    """((y0, y1), (x0, x1)) of a strip."""
    (rows, (x0, _)), (_, (_, x1)) = extent(shape, strip[0]), extent(shape, strip[-1])
    return rows, (x0, x1)


def by_column(block: NDArray[Any]) -> list[NDArray[Any]]:
    """Views of a strip's samples or maps (..., y, x), column of chunks by column."""
    return np.split(block, range(CHUNK[2], block.shape[-1], CHUNK[2]), axis=-1)


def centred(shape: tuple[int, int], side: int) -> Part:
    """Rows and columns in the middle of a window, at most ``side`` of each."""
    (y0, y1), (x0, x1) = (((n - m) // 2, (n + m) // 2) for n in shape for m in [min(n, side)])
    return (y0, y1), (x0, x1)


def strips(todo: Sequence[Index], width: int) -> list[Strip]:
    """Neighbouring columns, divided into strips of at most this number."""
    grouped: list[list[Index]] = []
    for i, j in todo:
        if grouped and len(grouped[-1]) < width and grouped[-1][-1] == (i, j - 1):
            grouped[-1].append((i, j))
        else:
            grouped.append([(i, j)])
    return [tuple(strip) for strip in grouped]
