"""Plan memory in whole numbers before anything is read."""

import sys
from dataclasses import dataclass
from functools import cache

from pixcal.engine.run import Runtime
from pixcal.model.errors import PlanError

# interpreter with all libraries loaded and kernels compiled (measured, see the tests)
BASE_BYTES = 350 << 20

DASK_WORKER_BYTES = 420 << 20  # same for a Dask worker, which persists between stages

USABLE = 0.8  # share of its memory limit above which a Dask worker starts no task (Dask's default)


@dataclass(frozen=True)
class Plan:
    """Memory that a stage will use."""

    bytes_per_task: int  # peak of one task; of its process, where each has its own
    shared_bytes: int  # held by the coordinating process during the whole stage
    workers: int  # tasks that run at the same time; on a Dask cluster, in each of its workers

    @property
    def total(self) -> int:
        """Predicted peak of the whole process tree, in bytes."""
        return BASE_BYTES + self.shared_bytes + self.workers * self.bytes_per_task


def make_plan(what: str, bytes_per_task: int, shared_bytes: int, runtime: Runtime) -> Plan:
    """Choose the number of workers so that the work fits the memory allowed.

    Reports a reduced number on stderr. Raises PlanError, with both numbers, if none fits.
    """
    if runtime.remote:
        return _plan_on_cluster(what, bytes_per_task, shared_bytes, runtime)
    if runtime.cluster == "processes":
        # Each has its own interpreter.
        bytes_per_task += BASE_BYTES
    workers = runtime.n_workers
    while workers > 1 and Plan(bytes_per_task, shared_bytes, workers).total > runtime.memory:
        workers -= 1
    plan = Plan(bytes_per_task, shared_bytes, workers)
    if plan.total > runtime.memory:
        need, have = plan.total / 2**20, runtime.memory / 2**20
        raise PlanError(f"--memory: {what} needs {need:.0f} MiB, but the limit is {have:.0f} MiB")
    if workers < runtime.n_workers and not runtime.quiet:
        all_of_them = Plan(bytes_per_task, shared_bytes, runtime.n_workers).total
        _tell(
            f"{what}: --memory of {runtime.memory >> 20} MiB allows {workers} of "
            f"{runtime.n_workers} workers; all need {-(-all_of_them >> 20)} MiB"
        )
    return plan


def within_memory(what: str, bytes_per_task: int, shared_bytes: int, runtime: Runtime) -> Runtime:
    """The same runtime with as many workers as `make_plan` allows."""
    return runtime.with_workers(make_plan(what, bytes_per_task, shared_bytes, runtime).workers)


@cache
def _tell(note: str) -> None:
    print(note, file=sys.stderr)


def _plan_on_cluster(what: str, bytes_per_task: int, shared_bytes: int, runtime: Runtime) -> Plan:
    """As many concurrent tasks in each worker as fit in the one with the least memory."""
    # Here, not at the top: its import is slow and starts threads.
    from pixcal.engine.cluster import workers_of

    make_plan(what, 0, shared_bytes, Runtime(memory=runtime.memory))
    workers = workers_of(runtime)
    at_once = runtime.workers or max(worker["nthreads"] for worker in workers.values())
    for address, worker in workers.items():
        if not worker["memory_limit"]:
            continue
        have, need = int(USABLE * worker["memory_limit"]), DASK_WORKER_BYTES + bytes_per_task
        if need > have:
            raise PlanError(
                f"--cluster {runtime.cluster}: {what} needs {need >> 20} MiB in a worker, "
                f"{address} may use {have >> 20} MiB ({100 * USABLE:.0f} % of its limit); start it "
                "with a larger --memory-limit"
            )
        at_once = min(at_once, (have - DASK_WORKER_BYTES) // max(bytes_per_task, 1))
    return Plan(bytes_per_task, shared_bytes, at_once)
