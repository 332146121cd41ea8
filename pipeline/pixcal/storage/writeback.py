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


class _Writeback:
    """A thread that flushes files one after the other."""

    def __init__(self) -> None:
        self._files: SimpleQueue[Path | threading.Event] = SimpleQueue()
        self._failed: OSError | None = None
        threading.Thread(target=self._flush_all, daemon=True).start()

    def begin(self, file: Path) -> None:
        self._files.put(file)

    def wait(self) -> None:
        reached = threading.Event()
        self._files.put(reached)
        reached.wait()
        failed, self._failed = self._failed, None
        if failed is not None:
            raise failed

    def _flush_all(self) -> None:
        while True:
            item = self._files.get()
            if isinstance(item, threading.Event):
                item.set()
                continue
            try:
                flush_file(item)
            except OSError as error:
                self._failed = self._failed or error


@cache
def _writeback() -> _Writeback:
    """The writeback thread of this process."""
    return _Writeback()


# A forked process does not inherit the thread.
os.register_at_fork(after_in_child=_writeback.cache_clear)


def begin(file: Path) -> None:
    """Start to flush a file to disk; returns at once."""
    _writeback().begin(file)


def wait() -> None:
    """Wait for all flushes; OSError if a file could not be written."""
    _writeback().wait()


def flush_file(path: str | Path) -> None:
    """Flush a file, or the entries of a folder, to disk; ignores a missing one."""
    with suppress(FileNotFoundError):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
