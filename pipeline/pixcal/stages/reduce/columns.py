"""Columns of chunks, 128 by 128 pixels of all frames, and strips of neighbours, the unit of work.

FITS files hold rows: a strip as wide as memory allows is read at once. Maps are stored in chunks of
`STRIP` columns, so a task has at least `STRIP` columns, however many it reads at a time.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import Plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.stages.tiles import STRIP, Index, Strip, grid, span, strips
from pixcal.storage.artefact import Workspace
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.frame_reader import Reader
from pixcal.storage.place import UrlPath

SHARE = 0.8  # share of the allowed memory that strips may fill
CAUTIOUS = 4  # tasks assumed to share the memory of this process, on a cluster


def strip_width(readers: Iterable[Reader], need: Callable[[int], int], runtime: Runtime) -> int:
    """Columns of a strip: all, or as many as leave memory for all workers.

    ``readers``: of the frames. Cubes at URLs are read column by column, ahead of time. ``need``:
    bytes of a task, given the number of columns.
    """
    width = 1
    for reader in readers:
        if isinstance(reader, ArrayReader) and isinstance(reader.path, UrlPath):
            return 1
        width = grid(reader.shape[1:])[1]
    # The memory of the workers of a cluster is unknown here.
    at_once = CAUTIOUS if runtime.remote else runtime.n_workers
    while width > 1 and Plan(need(width), 0, at_once).total > SHARE * runtime.memory:
        width = -(-width // 2)
        width -= width % STRIP if width > STRIP else 0
    return width


def blocks(reader: Reader, strip: Strip) -> Iterator[tuple[int, NDArray[Any]]]:
    """First frame and samples (t, y, x) of a strip, a few frames at a time in the same memory."""
    rows, (x0, x1) = span(reader.shape[1:], strip)
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
    """Run a task that writes whole chunks, on columns ``todo`` not yet noted in the journal.

    ``task``: given the strips to read in turn; all its results are written when it returns.
    ``width``: columns to read at a time, from `strip_width`.
    """
    journal = made.journal()
    # Columns whose maps share a chunk are noted together.
    steps = {strip[0]: f"{label} {strip[0][0]} {strip[0][1]}" for strip in strips(todo, STRIP)}
    undone = [s for s in strips(todo, STRIP) if steps[s[0]] not in journal]
    left = strips([index for strip in undone for index in strip], max(width, STRIP))

    def note(number: int, _: Any) -> None:
        for strip in strips(left[number], STRIP):
            made.note(steps[strip[0]])

    parts = [strips(strip, width) for strip in left]
    run_tasks(task, parts, runtime, label=label, done=note)
