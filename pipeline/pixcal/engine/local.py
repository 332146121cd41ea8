"""Tasks on this machine: one after the other, or by Dask's schedulers in threads or processes."""

import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from typing import Any

import dask.multiprocessing
import dask.threaded
from dask.callbacks import Callback

from pixcal.engine.parcel import Job, RemoteTask, pack
from pixcal.model.errors import ClusterError

DEATHS = 3  # deaths of workers in a row, without a task done in between, that are put up with

Ended = Callable[[int, Any], None]


def run_here(function: Callable[[Any], Any], items: Sequence[Any], ended: Ended) -> None:
    """Do the tasks in this thread; ``ended`` gets the number and the result of each."""
    for number, item in enumerate(items):
        ended(number, function(item))


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
    """Do the tasks in processes, again if one is killed; ClusterError if that goes on and on."""
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
            # One by one: a task is noted when it ends, not when some others do.
            _run_graph(
                tasks, noted, dask.multiprocessing.get, num_workers=workers, pool=pool, chunksize=1
            )
        except BrokenProcessPool as error:
            _process_pool.cache_clear()
            deaths += 1
            if deaths > DEATHS:
                raise ClusterError(
                    "--cluster processes: worker processes were killed again and again (out of "
                    "memory?); give fewer --workers"
                ) from error
        except BaseException:
            # What has begun ends while this process holds its lock: two must not write one chunk.
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

    # Given, not looked up by name: for that Dask would import distributed.
    with Callback(posttask=posttask):
        get(graph, list(names), **options)


@lru_cache(maxsize=1)
def _process_pool(workers: int) -> ProcessPoolExecutor:
    """Worker processes, kept: each takes seconds to import what the tasks need."""
    return ProcessPoolExecutor(workers, get_context("spawn"), _begin_worker)


def _begin_worker() -> None:
    # Ctrl-C reaches workers too; what to do about it is the business of the process they work for.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End when the process that this one works for was killed: nobody else would end it."""
    parent = parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
