"""End work that takes more processor time or memory than planned."""

import ctypes
import os
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from numba.core import event

CHECK_INTERVAL_S = 0.2  # interval between checks of the usage
OWN = 256 << 20  # bytes of a process that has only loaded pixcal


class Exceeded(BaseException):
    """Usage exceeds the plan; not an `Exception`, so that handlers do not continue the work."""


class _Compiling(event.Listener):  # type: ignore[misc]
    """Processor time (s) that each thread has spent on compiling kernels."""

    def __init__(self) -> None:
        self._spent: dict[int, float] = {}
        self._began: dict[int, list[float]] = {}  # kernels may be compiled within others

    def on_start(self, event: event.Event) -> None:
        """Record the start of a compilation."""
        self._began.setdefault(threading.get_ident(), []).append(time.thread_time())

    def on_end(self, event: event.Event) -> None:
        """Add its time."""
        thread = threading.get_ident()
        began = self._began[thread].pop()
        if not self._began[thread]:
            self._spent[thread] = self._spent.get(thread, 0.0) + time.thread_time() - began

    def of(self, thread: int, now: float) -> float:
        """Compiling time of a thread up to a time of its clock."""
        begun = self._began.get(thread)
        return self._spent.get(thread, 0.0) + (now - begun[0] if begun else 0.0)


_COMPILING = _Compiling()
event.register("numba:compile", _COMPILING)


@dataclass(frozen=True)
class Bound:
    """Limits of processor time and memory for work."""

    # processor time of the work's own thread, without compiling, so that neither other processes
    # nor first use matter
    seconds: float
    memory: int = sys.maxsize  # bytes of this process
    excluded_bytes: int = 0  # bytes held for other work, which do not count

    @contextmanager
    def enforced(self) -> Iterator[None]:
        """Context that ends its work by `Exceeded` above the limits."""
        # It acts between two steps of the interpreter: a compiled kernel runs to its end.
        thread, done, lock = threading.get_ident(), threading.Event(), threading.Lock()
        clock = time.pthread_getcpuclockid(thread)

        def used() -> float:
            now = time.clock_gettime(clock)
            return now - _COMPILING.of(thread, now)

        last = used() + self.seconds

        def watch() -> None:
            while not done.wait(CHECK_INTERVAL_S):
                if used() > last or _beyond(self.memory + self.excluded_bytes):
                    with lock:
                        if not done.is_set():
                            raised = ctypes.pythonapi.PyThreadState_SetAsyncExc
                            raised(ctypes.c_ulong(thread), ctypes.py_object(Exceeded))
                    return

        watcher = threading.Thread(target=watch, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            with lock:
                done.set()
            watcher.join()

    def describe(self) -> str:
        """The limits in words."""
        memory = "" if self.memory == sys.maxsize else f" and {self.memory >> 20} MiB of memory"
        return f"{self.seconds:g} s of processor time{memory}"


def other_memory() -> int:
    """Bytes that this process now holds for work outside pixcal."""
    return max(0, _resident() - OWN)


def _beyond(memory: int) -> bool:
    """Whether the process uses more memory, after cached free memory was returned."""
    if _resident() <= memory:
        return False
    with suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    return _resident() > memory


def _resident() -> int:
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return 0  # Not available on other systems.
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
