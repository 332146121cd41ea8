"""Run independent tasks with Dask: local threads or processes, or any distributed cluster."""

import os
import sys
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from threadpoolctl import ThreadpoolController

from pixcal.engine.bounds import held_by_others
from pixcal.engine.local import run_here, run_in_processes, run_in_threads
from pixcal.model.errors import InputError
from pixcal.model.options import Running

R = TypeVar("R")


@dataclass(frozen=True)
class Runtime(Running):
    """How a stage runs; has no influence on its results.

    Attributes
    ----------
    cluster : str
        ``threads``, ``processes``, ``sync``, or the address ``tcp://…`` of a Dask scheduler.
    workers : int
        Local threads or processes; 0 means as many as there are cores. On a Dask cluster, tasks
        that each of its workers does at the same time; 0 means as many as it has threads.
    memory : int
        Bytes that the whole stage may use on this machine. Dask workers have their own limits.
    quiet : bool
        No progress on stderr.
    beside : int
        Bytes that this process held for other work when this began, which ``memory`` leaves out.
    """

    beside: int = field(default_factory=held_by_others, compare=False, repr=False)

    def __post_init__(self) -> None:
        known = ("threads", "processes", "sync")
        if self.cluster not in known and not self.remote:
            raise InputError(
                f"--cluster {self.cluster}: not one of {', '.join(known)}, nor an address tcp://…"
            )

    @property
    def remote(self) -> bool:
        """Whether tasks go to the workers of a Dask scheduler."""
        return "://" in self.cluster

    @property
    def n_workers(self) -> int:
        """Number of local workers (1 for ``sync``)."""
        if self.cluster == "sync":
            return 1
        return self.workers or len(os.sched_getaffinity(0))

    @property
    def here(self) -> "Runtime":
        """The same in this process, for what is too large to be sent about."""
        return self if self.cluster == "sync" else replace(self, cluster="threads")

    def with_workers(self, workers: int) -> "Runtime":
        """The same with another number of local workers, as a memory plan asks for."""
        return replace(self, workers=workers)


def one_blas_thread() -> AbstractContextManager[Any]:
    """Context in which BLAS does not start threads of its own."""
    # Tasks already fill the cores; and the last bits of a product must not depend on how many
    # threads shared it.
    limits: AbstractContextManager[Any] = _libraries(len(sys.modules)).limit(
        limits=1, user_api="blas"
    )
    return limits


@lru_cache(maxsize=1)
def _libraries(modules: int) -> ThreadpoolController:
    """Libraries with threads, once for as many imported modules: to look for them takes time."""
    return ThreadpoolController()


def run_tasks(
    function: Callable[..., R],
    items: Sequence[Any],
    runtime: Runtime,
    *,
    label: str,
    done: Callable[[int, R], None] | None = None,
) -> list[R]:
    """Apply a function to every item, in parallel, with progress; results in their order.

    It must not depend on that order. ``done`` is called in this process with the number and the
    result of each item as its task ends, e.g. to note it in a journal.
    """
    results: dict[int, R] = {}
    times = (TimeElapsedColumn(), "left", TimeRemainingColumn())
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), *times)
    progress = Progress(*columns, console=Console(file=sys.stderr), disable=runtime.quiet)
    shown = progress.add_task(label, total=len(items))
    with progress, one_blas_thread():

        def ended(number: int, result: R) -> None:
            results[number] = result
            if done is not None:
                done(number, result)
            progress.advance(shown)

        if runtime.remote:
            # Here, not at the top: it takes long to import, and starts threads.
            from pixcal.engine.cluster import run_on_cluster

            run_on_cluster(
                runtime.cluster, function, items, ended,
                label=label, at_once=runtime.workers, quiet=runtime.quiet,
            )  # fmt: skip
        elif runtime.cluster == "processes":
            run_in_processes(function, items, runtime.n_workers, ended)
        elif runtime.cluster == "threads" and len(items) > 1:
            run_in_threads(function, items, runtime.n_workers, ended)
        else:
            run_here(function, items, ended)
    return [results[number] for number in range(len(items))]
