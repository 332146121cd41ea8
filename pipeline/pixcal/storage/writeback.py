"""Flush files to disk while others are still being written.

The kernel holds written data for half a minute, so completing an artefact would wait for all of it
at once.
"""

import os
import threading
from contextlib import suppress
from functools import cache
from pathlib import Path
from queue import SimpleQueue

LARGE = 1 << 18  # least bytes of a file for a separate request


class _Writeback(threading.Thread):
    """A thread that flushes files one after the other."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.files: SimpleQueue[Path | threading.Event] = SimpleQueue()
        self.failed: OSError | None = None
        self.start()

    def run(self) -> None:
        """Flush what is in the queue; an event there tells that all before it are done."""
        while True:
            item = self.files.get()
            if isinstance(item, threading.Event):
                item.set()
                continue
            try:
                flush_file(item)
            except OSError as error:
                self.failed = self.failed or error


_writeback = cache(_Writeback)  # the one of this process
# A forked process does not inherit the thread.
os.register_at_fork(after_in_child=_writeback.cache_clear)


def begin(file: Path) -> None:
    """Start to flush a file to disk; returns at once."""
    _writeback().files.put(file)


def wait() -> None:
    """Wait for all flushes; OSError if a file could not be written."""
    thread, reached = _writeback(), threading.Event()
    thread.files.put(reached)
    reached.wait()
    failed, thread.failed = thread.failed, None
    if failed is not None:
        raise failed


def flush_file(path: str | Path) -> None:
    """Flush a file, or the entries of a folder, to disk; ignores a missing one."""
    with suppress(FileNotFoundError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
