"""Run tasks on a cluster of Dask workers, given the address of its scheduler.

The scheduler holds a bounded number of tasks at a time, each of a few kilobytes. If a worker dies,
the scheduler gives its tasks to others (`distributed.scheduler.allowed-failures` times).
"""

import logging
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager, suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path
from tempfile import NamedTemporaryFile
from types import FrameType
from typing import Any
from uuid import uuid4

from distributed import Client, Future, KilledWorker, Security, as_completed
from distributed.comm import CommClosedError

from pixcal.engine.remote_task import Job, RemoteTask, abandon, pack, versions
from pixcal.model.errors import ClusterError, InputError
from pixcal.model.options import Running

AHEAD = 4  # tasks submitted per thread, because the end of a task is reported with a delay
MIN_AHEAD = 32  # least number of submitted tasks, so that an adaptive cluster grows by demand
CHECK_INTERVAL_S = 5.0  # interval between checks of the number of threads
HELD = (".lock", ".partial")  # files that mark a run directory in use (`pixcal.storage.lock`)

Ended = Callable[[int, Any], None]


def workers_of(runtime: Running) -> dict[str, dict[str, Any]]:
    """The present workers of a cluster by address, as Dask describes them; waits for one."""
    with _connect(runtime) as client:
        workers: dict[str, dict[str, Any]] = client.scheduler_info(n_workers=-1)["workers"]
        if not workers and not runtime.quiet:
            at = runtime.cluster
            print(f"no workers at {at} yet: dask worker {at}", file=sys.stderr)
        while not workers:
            time.sleep(0.2)
            workers = client.scheduler_info(n_workers=-1)["workers"]
    return workers


def run_on_cluster(
    function: Callable[[Any], Any], items: Sequence[Any], runtime: Running, ended: Ended, label: str
) -> None:
    """Run tasks on a cluster; ``ended`` gets the number and result of each.

    InputError: no scheduler, or workers lack files or versions; ClusterError: the scheduler is
    lost, or a task kills workers repeatedly.
    """
    if not items:
        return
    packed = pack(function)
    with _connect(runtime) as client, _probe_file(packed.paths + pack(items[0]).paths) as probe:
        job = Job(packed.data, packed.paths + probe, runtime.workers, versions())
        tasks = _Tasks(client, runtime.cluster, job, items, f"{label}-{uuid4().hex[:8]}")
        try:
            with _ctrl_c(tasks.interrupt):
                for number, result in tasks.results():
                    ended(number, result)
                    tasks.stop_if_interrupted()
                tasks.stop_if_interrupted()
        except (CommClosedError, CancelledError) as error:
            message = f"--cluster {runtime.cluster}: the connection to the scheduler was lost"
            raise ClusterError(message) from error
        finally:
            tasks.cancel()


@contextmanager
def _connect(runtime: Running) -> Iterator[Client]:
    address = runtime.cluster
    if address.startswith("tls:") and not Security().get_connection_args("client")["ssl_context"]:
        raise InputError(
            f"--cluster {address}: Dask's configuration names no certificates; give them there "
            "(distributed.comm.tls)"
        )
    # An exception reports a lost connection in one line, instead of its many.
    log = logging.getLogger("distributed.client")
    disabled, log.disabled = log.disabled, True
    try:
        try:
            client = Client(address, timeout="10s", set_as_default=False, name="pixcal")
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"--cluster {address}: no Dask scheduler answers there ({_first_line(error)}); "
                "start one with 'dask scheduler', or correct the address"
            ) from error
        with client:
            with suppress(KeyError):
                _announce(client.dashboard_link, runtime.quiet)
            yield client
    finally:
        log.disabled = disabled


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


@lru_cache
def _announce(dashboard: str, quiet: bool) -> None:
    """Print the address of the dashboard once."""
    if not quiet:
        print(f"dashboard {dashboard}", file=sys.stderr)


@contextmanager
def _probe_file(paths: Sequence[Path]) -> Iterator[tuple[Path, ...]]:
    """A temporary file in the run directory: a worker that does not see it has another disk."""
    # A directory of the same name on the worker's own disk would pass all other checks.
    ups = (up for path in paths for up in path.parents)
    runs = (up for up in ups if all((up / name).exists() for name in HELD))
    run = next(runs, None)
    if run is None:
        yield ()
        return
    for left in run.glob(".cluster-*"):
        left.unlink(missing_ok=True)
    with NamedTemporaryFile(dir=run, prefix=".cluster-") as file:
        yield (Path(file.name),)


@contextmanager
def _ctrl_c(on_interrupt: Callable[[], None]) -> Iterator[None]:
    """Report Ctrl-C in addition to raising it: exceptions in the library's callbacks are lost."""
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or not callable(before):
        yield
        return

    def handler(number: int, frame: FrameType | None) -> None:
        on_interrupt()
        before(number, frame)

    signal.signal(signal.SIGINT, handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


class _Tasks:
    """Tasks of a job on a cluster, a limited number at a time."""

    def __init__(
        self, client: Client, address: str, job: Job, items: Sequence[Any], name: str
    ) -> None:
        self._client, self._address, self._job, self._items = client, address, job, items
        self._name = name
        self._do = job.do()
        self._waiting = iter(range(len(items)))
        self._running: set[Future] = set()
        self._room, self._look_again = 0, 0.0
        self._interrupted = False

    def interrupt(self) -> None:
        """Stop as soon as possible."""
        self._interrupted = True

    def stop_if_interrupted(self) -> None:
        """Raise KeyboardInterrupt if one was lost."""
        if self._interrupted:
            raise KeyboardInterrupt

    def results(self) -> Iterator[tuple[int, Any]]:
        """Number and result of every task, in the order in which they end."""
        ended = as_completed(self._submit(), loop=self._client.loop)
        while self._running:
            batch = self._wait(ended)
            self._running.difference_update(batch)
            good = [future for future in batch if future.status != "error"]
            for future, result in zip(good, self._client.gather(good), strict=True):
                yield future.key[1], result
            for future in batch:
                if future.status == "error":
                    raise self._failure(future.exception(), future.traceback())
                future.release()
            ended.update(self._submit())

    def _wait(self, ended: as_completed) -> list[Future]:
        """Wait for at least one more task to end, as long as there is a scheduler."""
        while not ended.has_ready():
            if self._client.status != "running":
                raise CommClosedError
            self.stop_if_interrupted()
            with ended.thread_condition:
                ended.thread_condition.wait(0.1)
        batch: list[Future] = ended.next_batch(block=False)
        return batch

    def _submit(self) -> list[Future]:
        numbers = list(islice(self._waiting, max(0, self._window() - len(self._running))))
        if not numbers:
            return []
        tasks = [RemoteTask(self._job, pack(self._items[n])).dumps() for n in numbers]
        # Keys in pairs: the dashboard groups tasks by the first element, shown up to the dash.
        keys = [(self._name, n) for n in numbers]
        futures: list[Future] = self._client.map(self._do, tasks, key=keys, pure=False)
        self._running.update(futures)
        return futures

    def _window(self) -> int:
        """Number of tasks that the scheduler may hold, which grows with the workers."""
        if time.monotonic() >= self._look_again:
            at_once = self._job.at_once
            threads = self._client.nthreads().values()
            slots = sum(min(n, at_once) if at_once else n for n in threads)
            self._room = max(AHEAD * slots, MIN_AHEAD)
            self._look_again = time.monotonic() + CHECK_INTERVAL_S
        return self._room

    def _failure(self, error: BaseException, trace: Any) -> BaseException:
        """The exception to raise for a task that failed: its own, unless Dask made it."""
        where = f"--cluster {self._address}"
        if isinstance(error, KilledWorker):
            return ClusterError(
                f"{where}: {error.allowed_failures + 1} workers died on the same task, the last "
                f"was {error.last_worker.address} (out of memory? see their logs); start them with "
                "a larger --memory-limit, or run pixcal with fewer --workers"
            )
        if isinstance(error, ModuleNotFoundError) and str(error.name).startswith("pixcal"):
            return InputError(f"{where}: a worker has no pixcal; install it wherever workers run")
        if type(error).__module__.startswith("distributed."):
            return ClusterError(f"{where}: {_first_line(error)}")
        return error.with_traceback(trace)

    def cancel(self) -> None:
        """Cancel tasks not yet begun, and wait for the rest: two must not write one chunk."""
        if not self._running or self._client.status != "running":
            return
        with suppress(OSError, TimeoutError, CancelledError):
            self._client.cancel(list(self._running), force=True)
            while any(self._client.run(abandon, self._job.name, on_error="ignore").values()):
                time.sleep(0.1)
