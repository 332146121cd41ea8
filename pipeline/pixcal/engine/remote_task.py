"""Serialise tasks for other processes, and run them there."""

import pickle
import platform
import time
from collections import Counter
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from functools import lru_cache, partial
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from threading import BoundedSemaphore, Lock
from typing import Any
from uuid import uuid4

import cloudpickle
from threadpoolctl import threadpool_limits

import pixcal
from pixcal.engine.malloc import keep_freed_memory
from pixcal.model.code import code_digest
from pixcal.model.errors import ClusterError, InputError

PATIENCE_S = 1.0  # time within which a new file must be visible on other machines
KEPT = 2  # unpacked functions cached per worker: one for each concurrent run
# libraries that may affect the last bit of a result
PACKAGES = ("numpy", "scipy", "numba", "numcodecs", "zarr", "astropy")
CODE, MACHINE = "code of pixcal", "machine"


@dataclass(frozen=True)
class PickledArguments:
    """An object for another process."""

    # the pickled object, with absolute paths, because the current folder differs elsewhere
    data: bytes
    # existing files and folders among those paths, which must also exist there
    paths: tuple[Path, ...]


class _Pickler(cloudpickle.Pickler):  # type: ignore[misc]
    """Makes paths absolute, and remembers them."""

    def __init__(self, file: BytesIO) -> None:
        super().__init__(file)
        self.paths: dict[Path, None] = {}

    def reducer_override(self, obj: Any) -> Any:
        if isinstance(obj, Path):
            path = obj.absolute()
            self.paths[path] = None
            return type(path), (str(path),)
        return super().reducer_override(obj)


def pack(obj: Any) -> PickledArguments:
    """Pickle an object for another process."""
    file = BytesIO()
    pickler = _Pickler(file)
    pickler.dump(obj)
    return PickledArguments(file.getvalue(), tuple(path for path in pickler.paths if path.exists()))


@dataclass(frozen=True)
class Job:
    """Common part of the tasks of one run; unpacked once in every process."""

    function: bytes = field(compare=False)  # pickled; called with the item of a task
    # files and folders that must exist on the worker
    paths: tuple[Path, ...] = field(compare=False)
    at_once: int = field(default=0, compare=False)  # most concurrent tasks per process; 0: no limit
    # versions required on the worker (see `versions`)
    versions: dict[str, str] = field(default_factory=dict, compare=False)
    name: str = field(default_factory=lambda: uuid4().hex)

    def do(self) -> Callable[[bytes], Any]:
        """Function that runs a task of the job, given as `RemoteTask.dumps`, in any process."""
        return partial(pickle.loads, buffers=[self.function])

    def __reduce__(self) -> tuple[Any, ...]:
        function = pickle.PickleBuffer(self.function)
        return Job, (function, self.paths, self.at_once, self.versions, self.name)


@dataclass(frozen=True)
class RemoteTask:
    """A task unpickled only on the worker, so that schedulers without pixcal can hold it."""

    job: Job
    item: PickledArguments

    def __reduce__(self) -> tuple[Any, ...]:
        return call, (self.job, self.item)

    def dumps(self) -> bytes:
        """Bytes for the function of `Job.do`, which returns the task's result."""
        apart: list[pickle.PickleBuffer] = []
        return pickle.dumps(self, protocol=5, buffer_callback=apart.append)


_opening, _counting = Lock(), Lock()
_going_on: Counter[str] = Counter()
_abandoned: set[str] = set()


def call(job: Job, item: PickledArguments) -> Any:
    """Do one task of a job; InputError if versions differ here, or its files are missing."""
    with _counting:
        if job.name in _abandoned:
            raise ClusterError("the run was cancelled by its client")
        _going_on[job.name] += 1
    try:
        with _opening:
            function, slot = _open(job)
        _require_visible(item.paths)
        with slot:
            return function(cloudpickle.loads(item.data))
    finally:
        with _counting:
            _going_on[job.name] -= 1


def abandon(name: str) -> int:
    """Begin no more tasks of a job in this process; return the number still running."""
    with _counting:
        _abandoned.add(name)
        return _going_on[name]


@lru_cache(maxsize=KEPT)
def _open(job: Job) -> tuple[Callable[[Any], Any], AbstractContextManager[Any]]:
    """The function of a job, and the context in which it runs."""
    _compare(job.versions)
    _require_visible(job.paths)
    function = cloudpickle.loads(job.function)
    # Permanently, as in Dask's own workers, since the last task is unknown. Only now, when the
    # libraries that the function needs are loaded.
    threadpool_limits(limits=1, user_api="blas")
    keep_freed_memory()
    return function, BoundedSemaphore(job.at_once) if job.at_once else nullcontext()


def _require_visible(paths: tuple[Path, ...]) -> None:
    """Refuse work on missing files; network disks may show them with a delay."""
    begin = time.monotonic()
    for path in paths:
        while not path.exists():
            if time.monotonic() > begin + PATIENCE_S:
                raise InputError(
                    f"{path}: the worker on {platform.node()} cannot see this path; mount the data "
                    "at the same path on all workers"
                )
            time.sleep(0.1)


@lru_cache(maxsize=1)
def versions() -> dict[str, str]:
    """Versions that must agree in all processes, so that results do not differ."""
    return {
        "Python": ".".join(platform.python_version_tuple()[:2]),
        "pixcal": pixcal.__version__,
        **{package: version(package) for package in PACKAGES},
        CODE: code_digest()[:8],
        MACHINE: platform.node(),
    }


def _compare(wanted: dict[str, str]) -> None:
    if not wanted:
        return
    there = versions()
    # One machine has one code, possibly edited; two may have different clones of one version.
    free = {MACHINE, CODE} if there[MACHINE] == wanted[MACHINE] else {MACHINE}
    for name, here in wanted.items():
        if name not in free and there[name] != here:
            raise InputError(
                f"the worker on {there[MACHINE]} has {name} {there[name]}, this process {here}; "
                "install the same version there and restart the worker"
            )
