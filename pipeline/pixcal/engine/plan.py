"""Plan memory in whole numbers before anything is read."""

from dataclasses import dataclass

from pixcal.engine.run import Runtime
from pixcal.model.errors import PlanError

BASE_BYTES = 350 << 20
"""Interpreter with all libraries loaded and kernels compiled (measured, see the tests)."""


@dataclass(frozen=True)
class Plan:
    """Memory that a stage will use.

    Attributes
    ----------
    bytes_per_task : int
        Peak of one task; of its process, where each has its own.
    shared_bytes : int
        Held by the coordinating process during the whole stage.
    workers : int
        Tasks that run at the same time.
    """

    bytes_per_task: int
    shared_bytes: int
    workers: int

    @property
    def total(self) -> int:
        """Predicted peak of the whole process tree, in bytes."""
        return BASE_BYTES + self.shared_bytes + self.workers * self.bytes_per_task


def make_plan(what: str, bytes_per_task: int, shared_bytes: int, runtime: Runtime) -> Plan:
    """Choose the number of workers so that the work fits the memory allowed.

    Raises
    ------
    PlanError
        If not even one worker fits; the message holds both numbers.
    """
    if runtime.cluster == "processes":
        # Each has an interpreter of its own.
        bytes_per_task += BASE_BYTES
    workers = runtime.n_workers
    while workers > 1 and Plan(bytes_per_task, shared_bytes, workers).total > runtime.memory:
        workers -= 1
    plan = Plan(bytes_per_task, shared_bytes, workers)
    if plan.total > runtime.memory:
        need, have = plan.total / 2**20, runtime.memory / 2**20
        raise PlanError(f"--memory: {what} needs {need:.0f} MiB, {have:.0f} MiB are allowed")
    return plan
