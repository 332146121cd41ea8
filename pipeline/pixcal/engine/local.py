"""Tasks on this machine: one after the other, in threads, or in processes of their own."""

import os
import signal
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import lru_cache, partial
from multiprocessing import get_context, parent_process
from typing import Any

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
    with ThreadPoolExecutor(workers) as pool:
        _run(pool, {number: partial(function, item) for number, item in enumerate(items)}, ended)


def run_in_processes(
    function: Callable[[Any], Any], items: Sequence[Any], workers: int, ended: Ended
) -> None:
    """Do the tasks in processes; those that a killed one had in hand are done again.

    Raises
    ------
    ClusterError
        If processes die again and again at the same tasks.
    """
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
        # As bytes: the pool itself pickles by an older protocol.
        do = job.do()
        tasks = {n: partial(do, RemoteTask(job, pack(item)).dumps()) for n, item in left.items()}
        try:
            _run(_process_pool(workers), tasks, noted)
        except BrokenProcessPool as error:
            _process_pool.cache_clear()
            deaths += 1
            if deaths > DEATHS:
                raise ClusterError(
                    "--cluster processes: worker processes were killed again and again (out of "
                    "memory?); give fewer --workers"
                ) from error
        except BaseException:
            _process_pool.cache_clear()
            raise


def _run(pool: Executor, tasks: Mapping[int, Callable[[], Any]], ended: Ended) -> None:
    numbers = {pool.submit(task): number for number, task in tasks.items()}
    try:
        for future in as_completed(list(numbers)):
            ended(numbers.pop(future), future.result())
    except BaseException:
        # What has begun ends while this process holds its lock: two must not write one chunk.
        pool.shutdown(cancel_futures=True)
        raise


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
