"""Run independent tasks: one by one, or with Dask in threads, in processes or on a cluster."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from typing import Any, TypeVar

import dask.multiprocessing
import dask.threaded
from dask.callbacks import Callback
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from threadpoolctl import ThreadpoolController

from pixcal.engine.bounds import other_memory
from pixcal.engine.malloc import keep_freed_memory
from pixcal.engine.remote_task import Job, RemoteTask, pack
from pixcal.model.errors import ClusterError, InputError
from pixcal.model.options import Running

R = TypeVar("R")
DEATHS = 3  # tolerated successive deaths of workers without a completed task in between

Ended = Callable[[int, Any], None]  # gets the number and the result of a task


@dataclass(frozen=True)
class Runtime(Running):
    """How a stage runs; has no influence on its results.

    Attributes
    ----------
    cluster : str
        ``threads``, ``processes``, ``sync``, or the address ``tcp://…`` of a Dask scheduler.
    workers : int
        Local threads or processes; 0 means as many as there are cores. On a Dask cluster,
        simultaneous tasks of each worker; 0 means as many as it has threads.
    memory : int
        Bytes that the whole stage may use on this machine. Dask workers have their own limits.
    quiet : bool
        No progress on stderr.
    excluded_bytes : int
        Bytes that this process held for other work when this began, which ``memory`` leaves out.
    """

    excluded_bytes: int = field(default_factory=other_memory, compare=False, repr=False)

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
        """The same in this process, for data too large to send."""
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
    """Libraries that use threads; the slow search is repeated only after further imports."""
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

    ``done`` is called here with the number and result of each item as its task ends.
    """
    keep_freed_memory()
    results: dict[int, R] = {}
    times = (TimeElapsedColumn(), "left", TimeRemainingColumn())
    columns = ("{task.description}", BarColumn(), MofNCompleteColumn(), *times)
    hidden = runtime.quiet or not items
    progress = Progress(*columns, console=Console(file=sys.stderr), disable=hidden)
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

            run_on_cluster(function, items, runtime, ended, label)
        elif runtime.cluster == "processes":
            run_in_processes(function, items, runtime.n_workers, ended)
        elif runtime.cluster == "threads" and len(items) > 1:
            run_in_threads(function, items, runtime.n_workers, ended)
        else:
            for number, item in enumerate(items):
                ended(number, function(item))
    return [results[number] for number in range(len(items))]


def run_in_threads(
    function: Callable[[Any], Any], items: Sequence[Any], workers: int, ended: Ended
) -> None:
    """Do the tasks in threads; when one fails, or at Ctrl-C, those that have begun still end."""
    # Bound to the function: inside a graph Dask would take some items for keys or tasks.
    tasks = {number: partial(function, item) for number, item in enumerate(items)}
    with ThreadPoolExecutor(workers) as pool:
        _run_graph(tasks, ended, dask.threaded.get, num_workers=workers, pool=pool)


def run_in_processes(
    function: Callable[[Any], Any], items: Sequence[Any], workers: int, ended: Ended
) -> None:
    """Do the tasks in processes, again if one is killed; ClusterError if that recurs."""
    packed = pack(function)
    job = Job(packed.data, packed.paths)
    left = dict(enumerate(items))
    deaths = 0

    def noted(number: int, result: Any) -> None:
        nonlocal deaths
        del left[number]
        deaths = 0
        ended(number, result)

    while left:
        pool = _process_pool(workers)
        # As bytes: the pool itself pickles by an older protocol.
        do = job.do()
        tasks = {n: partial(do, RemoteTask(job, pack(item)).dumps()) for n, item in left.items()}
        try:
            # One by one, so that each task is noted when it ends.
            _run_graph(
                tasks, noted, dask.multiprocessing.get, num_workers=workers, pool=pool, chunksize=1
            )
        except BrokenProcessPool as error:
            _process_pool.cache_clear()
            deaths += 1
            if deaths > DEATHS:
                raise ClusterError(
                    "--cluster processes: worker processes were killed repeatedly (out of "
                    "memory?); give fewer --workers"
                ) from error
        except BaseException:
            # Running tasks end while this process holds its lock: two must not write one chunk.
            _process_pool.cache_clear()
            pool.shutdown(cancel_futures=True)
            raise


def _run_graph(
    tasks: Mapping[int, Callable[[], Any]], ended: Ended, get: Callable[..., Any], **options: Any
) -> None:
    names = {f"task-{number}": number for number in tasks}
    graph = {name: (tasks[number],) for name, number in names.items()}

    def posttask(key: Any, result: Any, _dsk: Any, _state: Any, _worker: Any) -> None:
        if key in names:
            ended(names[key], result)

    # Passed as a function: to find it by name, Dask would import distributed.
    with Callback(posttask=posttask):
        get(graph, list(names), **options)


@lru_cache(maxsize=1)
def _process_pool(workers: int) -> ProcessPoolExecutor:
    """Worker processes, kept: each takes seconds to import what the tasks need."""
    return ProcessPoolExecutor(workers, get_context("spawn"), _begin_worker)


def _begin_worker() -> None:
    # Ctrl-C also reaches workers; their parent process handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End when the parent process was killed, since nothing else would end this one."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
