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

LOOK_S = 0.2  # from one look at what is used to the next


class Exceeded(BaseException):
    """More was used than planned; no `Exception`, lest who tries several ways goes on."""


@dataclass(frozen=True)
class Bound:
    """What work may use."""

    # processor time of its own thread: what others do on the machine makes no difference
    seconds: float
    memory: int = sys.maxsize  # bytes of this process

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Context whose work is ended by `Exceeded` once it uses more."""
        # That shows between two steps of the interpreter: a compiled kernel still comes to its end.
        thread, done, lock = threading.get_ident(), threading.Event(), threading.Lock()
        clock = time.pthread_getcpuclockid(thread)
        last = time.clock_gettime(clock) + self.seconds

        def watch() -> None:
            while not done.wait(LOOK_S):
                if time.clock_gettime(clock) > last or _beyond(self.memory):
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
