"""Run independent tasks with Dask: local threads or processes, or any distributed cluster."""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from typing import Any, TypeVar

import dask
from dask.callbacks import Callback
from threadpoolctl import threadpool_limits

from pixcal.engine.progress import Progress
from pixcal.model.errors import InputError

R = TypeVar("R")


@dataclass(frozen=True)
class Runtime:
    """How a stage runs; has no influence on its results.

    Attributes
    ----------
    cluster : str
        ``threads``, ``processes``, ``sync``, or the address ``tcp://…`` of a Dask scheduler.
    workers : int
        Local threads or processes; 0 means as many as there are cores.
    memory : int
        Bytes that the whole stage may use.
    quiet : bool
        No progress on stderr.
    """

    cluster: str = "threads"
    workers: int = 0
    memory: int = 2 << 30
    quiet: bool = True

    def __post_init__(self) -> None:
        known = ("threads", "processes", "sync")
        if self.cluster not in known and "://" not in self.cluster:
            raise InputError(
                f"--cluster {self.cluster}: not one of {', '.join(known)}, nor an address tcp://…"
            )

    @property
    def n_workers(self) -> int:
        """Number of local workers (1 for ``sync``)."""
        if self.cluster == "sync":
            return 1
        return self.workers or len(os.sched_getaffinity(0))

    def with_workers(self, workers: int) -> "Runtime":
        """The same with another number of local workers, as a memory plan asks for."""
        return replace(self, workers=workers)


def one_blas_thread() -> threadpool_limits:
    """Context in which BLAS does not start threads of its own.

    Tasks already fill the cores; and the last bits of a product must not depend on how many
    threads shared it.
    """
    return threadpool_limits(limits=1, user_api="blas")


class _InWorker:
    """A task for another process, where nobody else limits BLAS."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.function = function

    def __call__(self, item: Any) -> Any:
        with one_blas_thread():
            return self.function(item)


def run_tasks(
    function: Callable[..., R],
    items: Sequence[Any],
    runtime: Runtime,
    *,
    label: str,
    done: Callable[[int, R], None] | None = None,
) -> list[R]:
    """Apply a function to every item, in parallel, with progress.

    Parameters
    ----------
    function : callable
        Called with one item; must not depend on the order of the items.
    items : sequence
        One for each task.
    label : str
        What is being done, for the progress line.
    done : callable, optional
        Called in this process with (number of the item, result) as each task ends, e.g. to
        note it in a journal.

    Returns
    -------
    list
        Results in the order of the items.
    """
    with Progress(label, len(items), quiet=runtime.quiet) as progress, one_blas_thread():
        if "://" in runtime.cluster:
            return _run_distributed(function, items, runtime, progress, done)
        if runtime.cluster == "sync" or (len(items) == 1 and runtime.cluster == "threads"):
            results = []
            for number, item in enumerate(items):
                results.append(function(item))
                if done is not None:
                    done(number, results[-1])
                progress.advance()
            return results
        return _run_local(function, items, runtime, progress, done)


@lru_cache(maxsize=1)
def _process_pool(workers: int) -> ProcessPoolExecutor:
    """Worker processes, kept: each takes seconds to import what the tasks need."""
    return ProcessPoolExecutor(workers, mp_context=get_context("spawn"))


def _run_local(
    function: Callable[..., R],
    items: Sequence[Any],
    runtime: Runtime,
    progress: Progress,
    done: Callable[[int, R], None] | None,
) -> list[R]:
    options: dict[str, Any] = {"num_workers": runtime.n_workers}
    if runtime.cluster == "processes":
        function = _InWorker(function)
        options["pool"] = _process_pool(runtime.n_workers)
    names = [f"task-{n}" for n in range(len(items))]
    # Bound to the function: inside a graph Dask would take some items for keys or tasks.
    graph = {name: (partial(function, item),) for name, item in zip(names, items, strict=True)}
    number = {name: n for n, name in enumerate(names)}

    def ended(key: Any, result: Any, _dsk: Any, _state: Any, _worker: Any) -> None:
        if key in number:
            if done is not None:
                done(number[key], result)
            progress.advance()

    get = dask.base.get_scheduler(scheduler=runtime.cluster)
    with Callback(posttask=ended):
        return list(get(graph, names, **options))


def _run_distributed(
    function: Callable[..., R],
    items: Sequence[Any],
    runtime: Runtime,
    progress: Progress,
    done: Callable[[int, R], None] | None,
) -> list[R]:
    from distributed import Client, as_completed  # starts threads on import

    try:
        client = Client(runtime.cluster, timeout="10s", set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise InputError(f"--cluster {runtime.cluster}: no Dask scheduler answers there") from error
    with client:
        futures = client.map(_InWorker(function), items, pure=False)
        number = {future.key: n for n, future in enumerate(futures)}
        results: dict[int, R] = {}
        for future in as_completed(futures, loop=client.loop):
            n = number[future.key]
            results[n] = future.result()
            future.release()
            if done is not None:
                done(n, results[n])
            progress.advance()
    return [results[n] for n in range(len(items))]
