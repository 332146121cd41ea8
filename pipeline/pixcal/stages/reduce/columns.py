"""Columns of chunks, 128 by 128 pixels of all frames, and strips of neighbours, the unit of work.

FITS files hold rows: a strip as wide as memory allows is read in one go. Maps lie in chunks of
`STRIP` columns, so a task has so many at least, whatever it reads at a time.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import Plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.stages.reduced_set import STRIP
from pixcal.storage.artefact import Workspace
from pixcal.storage.cube import CHUNK, ArrayReader
from pixcal.storage.frame_reader import Reader
from pixcal.storage.place import UrlPath

Index = tuple[int, int]
Strip = tuple[Index, ...]

SHARE = 0.8  # of the memory allowed, that strips may be made wide for
CAUTIOUS = 4  # tasks that share as much memory as this process may use, on a cluster


def grid(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of columns of chunks of a window (y, x)."""
    return -(-shape[0] // CHUNK[1]), -(-shape[1] // CHUNK[2])


def indices(shape: tuple[int, int]) -> list[Index]:
    """All columns of chunks, in order."""
    rows, columns = grid(shape)
    return [(i, j) for i in range(rows) for j in range(columns)]


def extent(shape: tuple[int, int], index: Index) -> tuple[tuple[int, int], tuple[int, int]]:
    """((y0, y1), (x0, x1)) of a column of chunks."""
    (i, j), (_, cy, cx), (ny, nx) = index, CHUNK, shape
    return (i * cy, min((i + 1) * cy, ny)), (j * cx, min((j + 1) * cx, nx))


def map_chunk(shape: tuple[int, int]) -> tuple[int, int]:
    """Rows and columns of a chunk of maps (y, x)."""
    return CHUNK[1], CHUNK[2] * min(STRIP, grid(shape)[1])


def span(shape: tuple[int, int], strip: Sequence[Index]) -> tuple[tuple[int, int], tuple[int, int]]:
    """((y0, y1), (x0, x1)) of a strip."""
    (rows, (x0, _)), (_, (_, x1)) = extent(shape, strip[0]), extent(shape, strip[-1])
    return rows, (x0, x1)


def by_column(block: NDArray[Any]) -> list[NDArray[Any]]:
    """Views of a strip's samples or maps (..., y, x), column of chunks by column."""
    return np.split(block, range(CHUNK[2], block.shape[-1], CHUNK[2]), axis=-1)


def strips(todo: Sequence[Index], width: int) -> list[Strip]:
    """Columns side by side, so many at most in a strip."""
    found: list[list[Index]] = []
    for i, j in todo:
        if found and len(found[-1]) < width and found[-1][-1] == (i, j - 1):
            found[-1].append((i, j))
        else:
            found.append([(i, j)])
    return [tuple(strip) for strip in found]


def strip_width(readers: Iterable[Reader], need: Callable[[int], int], runtime: Runtime) -> int:
    """Columns of a strip: all, or as many as leave memory for all workers.

    ``readers``: of the frames. Cubes at URLs are read column by column, ahead of time. ``need``:
    bytes of a task, given the number of columns.
    """
    width = 1
    for reader in readers:
        if isinstance(reader, ArrayReader) and isinstance(reader.path, UrlPath):
            return 1
        width = grid((reader.shape[1], reader.shape[2]))[1]
    # Nobody knows here what the workers of a cluster may use.
    at_once = CAUTIOUS if runtime.remote else runtime.n_workers
    while width > 1 and Plan(need(width), 0, at_once).total > SHARE * runtime.memory:
        width = -(-width // 2)
        width -= width % STRIP if width > STRIP else 0
    return width


def blocks(reader: Reader, strip: Strip) -> Iterator[tuple[int, NDArray[Any]]]:
    """First frame and samples (t, y, x) of a strip, a few frames at a time in the same memory."""
    rows, (x0, x1) = span((reader.shape[1], reader.shape[2]), strip)
    frames, step = reader.shape[0], reader.chunks[0]
    buffer = np.empty((min(step, frames), rows[1] - rows[0], x1 - x0), reader.dtype)
    for first in range(0, frames, step):
        last = min(first + step, frames)
        yield first, reader.read((first, last), rows, (x0, x1), out=buffer[: last - first])


def run_noted(
    made: Workspace,
    task: Callable[[list[Strip]], None],
    todo: Sequence[Index],
    width: int,
    runtime: Runtime,
    label: str,
) -> None:
    """Run a task that writes whole chunks on columns side by side, but for those noted as done.

    Parameters
    ----------
    made : whose journal to use
    task : given the strips to read one after the other. All that it leaves is written when it
        returns.
    todo : columns
    width : columns to read at a time, from `strip_width`
    label : name of the task in the journal, and for the progress
    """
    journal = made.journal()
    # Those whose maps share a chunk are noted together.
    steps = {strip[0]: f"{label} {strip[0][0]} {strip[0][1]}" for strip in strips(todo, STRIP)}
    undone = [s for s in strips(todo, STRIP) if steps[s[0]] not in journal]
    left = strips([index for strip in undone for index in strip], max(width, STRIP))

    def note(number: int, _: Any) -> None:
        for strip in strips(left[number], STRIP):
            made.note(steps[strip[0]])

    parts = [strips(strip, width) for strip in left]
    run_tasks(task, parts, runtime, label=label, done=note)
