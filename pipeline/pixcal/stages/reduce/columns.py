"""Columns of chunks, the unit of work: 128 by 128 pixels of all frames."""

from collections.abc import Callable, Sequence

from pixcal.engine.run import Runtime, run_tasks
from pixcal.storage.artefact import Build
from pixcal.storage.cube import CHUNK

Index = tuple[int, int]


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


def run_noted(
    made: Build,
    task: Callable[[Index], None],
    todo: Sequence[Index],
    runtime: Runtime,
    label: str,
) -> None:
    """Run a task that writes whole chunks on columns, but for those that are noted as done.

    Parameters
    ----------
    made : Build
        Whose journal to use.
    task : callable
        All that it leaves is on the disk when it returns.
    todo : sequence of (int, int)
        Columns.
    runtime : Runtime
        How to run.
    label : str
        Name of the task in the journal, and for the progress.
    """
    journal = made.journal()
    steps = {index: f"{label} {index[0]} {index[1]}" for index in todo}
    left = [index for index in todo if steps[index] not in journal]
    run_tasks(
        task, left, runtime, label=label, done=lambda number, _: made.note(steps[left[number]])
    )
