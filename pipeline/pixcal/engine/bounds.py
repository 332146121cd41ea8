"""Work that is ended when it takes more processor time or memory than was planned for it."""

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

LOOK_S = 0.2  # from one look at what is used to the next
OWN = 256 << 20  # bytes: a process that has loaded pixcal and nothing else


class Exceeded(BaseException):
    """More was used than planned; no `Exception`, lest who tries several ways goes on."""


class _Compiling(event.Listener):  # type: ignore[misc]
    """Processor time (s) that each thread has spent on compiling kernels."""

    def __init__(self) -> None:
        self._spent: dict[int, float] = {}
        self._began: dict[int, list[float]] = {}  # kernels may be compiled within others

    def on_start(self, event: event.Event) -> None:
        """Note when."""
        self._began.setdefault(threading.get_ident(), []).append(time.thread_time())

    def on_end(self, event: event.Event) -> None:
        """Add it up."""
        thread = threading.get_ident()
        began = self._began[thread].pop()
        if not self._began[thread]:
            self._spent[thread] = self._spent.get(thread, 0.0) + time.thread_time() - began

    def of(self, thread: int, now: float) -> float:
        """Of a thread, by a time of its clock."""
        begun = self._began.get(thread)
        return self._spent.get(thread, 0.0) + (now - begun[0] if begun else 0.0)


_COMPILING = _Compiling()
event.register("numba:compile", _COMPILING)


@dataclass(frozen=True)
class Bound:
    """What work may use."""

    # processor time of its own thread, but for compiling: neither what others do on the machine
    # nor a first use makes a difference
    seconds: float
    memory: int = sys.maxsize  # bytes of this process
    beside: int = 0  # bytes that it holds for other work and that do not count

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Context whose work is ended by `Exceeded` once it uses more."""
        # That shows between two steps of the interpreter: a compiled kernel still comes to its end.
        thread, done, lock = threading.get_ident(), threading.Event(), threading.Lock()
        clock = time.pthread_getcpuclockid(thread)

        def used() -> float:
            now = time.clock_gettime(clock)
            return now - _COMPILING.of(thread, now)

        last = used() + self.seconds

        def watch() -> None:
            while not done.wait(LOOK_S):
                if used() > last or _beyond(self.memory + self.beside):
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

    def told(self) -> str:
        """What it allows, in words."""
        memory = "" if self.memory == sys.maxsize else f" and {self.memory >> 20} MiB of memory"
        return f"{self.seconds:g} s of processor time{memory}"


def held_by_others() -> int:
    """Bytes that this process holds now for other work than pixcal's."""
    return max(0, _resident() - OWN)


def _beyond(memory: int) -> bool:
    """Whether the process uses more, once free memory that it only keeps has gone back."""
    if _resident() <= memory:
        return False
    with suppress(AttributeError):
        ctypes.CDLL(None).malloc_trim(0)
    return _resident() > memory


def _resident() -> int:
    try:
        pages = Path("/proc/self/statm").read_text(encoding="ascii").split()[1]
    except OSError:
        return 0  # Another system does not tell.
    return int(pages) * os.sysconf("SC_PAGE_SIZE")
