"""Prefetch chunks of a column: an object store has high latency, but serves many requests."""

import asyncio
from collections.abc import Sequence
from concurrent.futures import Future
from threading import local

from pixcal.storage.place import UrlPath, explained

File = tuple[str, int]  # name and size (bytes)

AHEAD = 4  # files in transit while one is decoded

# most waiting files per thread; those of an abandoned column are never used
_KEPT = 2 * AHEAD


class ReadAhead:
    """Reads files below a URL, and prefetches following ones after two reads in order."""

    def __init__(self, path: UrlPath) -> None:
        self.path = path
        self._thread = local()

    def __reduce__(self) -> tuple[type["ReadAhead"], tuple[UrlPath]]:
        return ReadAhead, (self.path,)

    def expected(self) -> dict[File, Future[bytes] | None]:
        """Files that this thread may read next, with their transfers if begun."""
        files: dict[File, Future[bytes] | None] = self._thread.__dict__.setdefault("expected", {})
        return files

    def read(self, file: File, following: Sequence[File]) -> bytes:
        """Content of a file, little more than its size; those ``following`` are read next."""
        expected = self.expected()
        in_order = file in expected
        fetched = expected.pop(file, None)
        for later in following if in_order else following[:1]:
            if expected.get(later) is None:
                expected[later] = self._fetch(later) if in_order else None
        while len(expected) > _KEPT:
            expected.pop(next(iter(expected)))
        if fetched is None:
            return (self.path / file[0]).read_bytes(file[1] + 1)
        with explained(f"{self.path}/{file[0]}"):
            return fetched.result()

    def _fetch(self, file: File) -> Future[bytes] | None:
        """Start an asynchronous read, if the file system supports it."""
        name, size = file
        system, path = (self.path / name).filesystem()
        if not system.async_impl:
            return None
        # On the loop that fsspec runs in its own thread.
        reading = system._cat_file(path, start=0, end=size + 1)
        return asyncio.run_coroutine_threadsafe(reading, system.loop)
