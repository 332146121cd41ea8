"""Whole files of a folder, many at a time: local or at a URL; linked or copied."""

import errno
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixcal.storage import writeback
from pixcal.storage.memory import MemoryPath
from pixcal.storage.place import Place, UrlPath, explained

# file that an array has beside its metadata: sizes and checksums of its chunks
INDEX = "chunks.npy"
DISK_FULL = (errno.ENOSPC, errno.EDQUOT)  # system errors that are not due to the file
BATCH_BYTES = 16 << 20  # bytes that one task sends to a URL at once; exceeds what it reads ahead
MANY_FILES = 250  # number of files above which they are not flushed one by one

# name of a file below a folder, such as `c/0/1/2`, and its content in parts
File = tuple[str, Sequence[bytes]]


def open_folder(place: Place) -> "LocalFolder | UrlFolder":
    """The files of a folder."""
    assert not isinstance(place, MemoryPath)  # It holds arrays, not files of their chunks.
    return UrlFolder(place) if isinstance(place, UrlPath) else LocalFolder(place)


def transit_bytes(*places: Place) -> int:
    """Memory of a task for data in transit to or from given folders."""
    return BATCH_BYTES * sum(isinstance(place, UrlPath) for place in places)


@dataclass(frozen=True)
class LocalFolder:
    """A folder of this machine. Files are written aside and renamed."""

    path: Path

    def write(self, files: Iterable[File], *, durable: bool = False) -> None:
        """Write files, or replace them, a few at a time: each whole or, ``durable``, on disk."""
        written = []
        for name, content in files:
            file = self.path / name
            aside = aside_of(file)
            # Most folders exist: checking first would take as long as the rest.
            try:
                out = aside.open("wb")
            except FileNotFoundError:
                file.parent.mkdir(parents=True, exist_ok=True)
                out = aside.open("wb")
            with out:
                out.writelines(content)
            written.append((aside, file, sum(map(len, content))))
        # Flushed after all are written, while the disk works (twice as fast as one by one).
        for aside, file, size in written:
            if durable:
                with aside.open("rb") as handle:
                    os.fdatasync(handle.fileno())
            aside.replace(file)
            if not durable and size >= writeback.LARGE:
                writeback.begin(file)

    def ends(self, names: Sequence[str]) -> Iterator[tuple[int, bytes]]:
        """Size and last four bytes (or fewer) of each file; OSError with ``filename``."""
        for name in names:
            with (self.path / name).open("rb") as handle:
                size = os.fstat(handle.fileno()).st_size
                handle.seek(max(0, size - 4))
                yield size, handle.read(4)

    def children(self) -> list[str]:
        """Names of the files and folders directly in it; none if it does not exist."""
        return sorted(f.name for f in self.path.iterdir()) if self.path.is_dir() else []

    def remove(self, names: Sequence[str]) -> None:
        """Remove existing files of these names, and folders that are then empty."""
        files = [self.path / name for name in names]
        for file in files:
            file.unlink(missing_ok=True)
            aside_of(file).unlink(missing_ok=True)
        folders = {up for file in files for up in file.parents if up.is_relative_to(self.path)}
        for folder in sorted(folders, reverse=True):
            with suppress(OSError):
                folder.rmdir()


@contextmanager
def written_aside(path: Path, *, durable: bool = False) -> Iterator[Path]:
    """Temporary name to write a file; renamed at the end, and flushed to disk if ``durable``."""
    aside = aside_of(path)
    try:
        yield aside
    except OSError as error:
        if error.filename == str(aside):
            error.filename = str(path)  # the name that the user gave
        raise
    if durable:
        with aside.open("rb") as file:
            os.fsync(file.fileno())
    aside.replace(path)


def aside_of(path: Path) -> Path:
    """The hidden name under which a file is written."""
    return path.with_name(f".{path.name}.aside")


def flush(folder: Path) -> None:
    """Flush all files and folders below a folder to disk."""
    writeback.wait()
    files = [(at, names) for at, _, names in os.walk(folder)]
    if sum(len(names) for _, names in files) > MANY_FILES:
        os.sync()  # One by one would take longer than flushing the data of all programs.
        return
    for at, names in files:
        for path in (*(f"{at}/{name}" for name in names), at):
            writeback.flush_file(path)


def read_file(path: str, size: int, later: str | None = None) -> bytes:
    """Content of a local file, at most a byte above its size; ``later`` is fetched meanwhile."""
    if later is not None:
        with suppress(OSError):
            ahead = os.open(later, os.O_RDONLY)
            try:
                os.posix_fadvise(ahead, 0, 0, os.POSIX_FADV_WILLNEED)
            finally:
                os.close(ahead)
    handle = os.open(path, os.O_RDONLY)
    try:
        body = os.read(handle, size + 1)
        while len(body) < size and (more := os.read(handle, size + 1 - len(body))):
            body += more
        return body
    finally:
        os.close(handle)


@dataclass(frozen=True)
class UrlFolder:
    """A folder at a URL, with the methods of `LocalFolder`; a store puts whole objects in place."""

    path: UrlPath

    def write(self, files: Iterable[File], *, durable: bool = False) -> None:
        system, root = self.path.filesystem()
        for batch in _batches(files):
            with explained(self.path.url):
                if not system.async_impl:
                    # Those of the object stores are, and there are no folders to be made.
                    for folder in sorted({f"{root}/{name}".rpartition("/")[0] for name in batch}):
                        system.makedirs(folder, exist_ok=True)
                system.pipe({f"{root}/{name}": content for name, content in batch.items()})

    def ends(self, names: Sequence[str]) -> Iterator[tuple[int, bytes]]:
        system, root = self.path.filesystem()
        sizes = self._sizes(names)
        if lost := next((name for name in names if name not in sizes), None):
            raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), f"{self.path}/{lost}")
        whole = [name for name in names if sizes[name] >= 4]
        paths, ends = [f"{root}/{name}" for name in whole], [sizes[name] for name in whole]
        with explained(self.path.url):
            tails = system.cat_ranges(paths, [end - 4 for end in ends], ends, on_error="raise")
        tail = dict(zip(whole, tails, strict=True))
        yield from ((sizes[name], tail.get(name, b"")) for name in names)

    def children(self) -> list[str]:
        system, root = self.path.filesystem()
        with explained(self.path.url):
            system.invalidate_cache()
            try:
                listed = system.ls(root, detail=False)
            except FileNotFoundError:
                return []
        return sorted(path.rstrip("/").rpartition("/")[2] for path in listed)

    def remove(self, names: Sequence[str]) -> None:
        system, root = self.path.filesystem()
        there = list(self._sizes(names))
        with explained(self.path.url):
            if there:
                system.rm([f"{root}/{name}" for name in there])

    def copy(self, source: UrlPath, names: Sequence[str]) -> bool:
        """Copy files from another folder inside the store; false if it is another store."""
        (system, root), (other, there) = self.path.filesystem(), source.filesystem()
        if system is not other:
            return False
        with explained(self.path.url):
            have = self._sizes(names)
            todo = [name for name in names if name not in have]
            system.copy([f"{there}/{n}" for n in todo], [f"{root}/{n}" for n in todo])
        return True

    def _sizes(self, names: Sequence[str]) -> dict[str, int]:
        """Sizes (bytes) of the existing files among these, from fresh listings."""
        system, root = self.path.filesystem()
        listed: dict[str, Any] = {}
        with explained(self.path.url):
            system.invalidate_cache()
            # Each listing is of all chunks of a range of frames, few enough for memory.
            for below in {"/".join(name.split("/")[:2]) for name in names}:
                listed |= system.find(f"{root}/{below}", detail=True)
            return {
                name: facts["size"] if "size" in facts else system.size(f"{root}/{name}")
                for name in names
                if (facts := listed.get(f"{root}/{name}")) is not None
            }


def _batches(files: Iterable[File]) -> Iterator[dict[str, bytes]]:
    """Files in groups that are not much larger than `BATCH_BYTES`."""
    batch: dict[str, bytes] = {}
    for name, content in files:
        batch[name] = b"".join(content)
        if sum(map(len, batch.values())) >= BATCH_BYTES:
            yield batch
            batch = {}
    if batch:
        yield batch


def link_files(source: Path, target: Path) -> None:
    """Link every file below a folder into another; copy where there are no links.

    Existing files stay, so an interrupted call can be repeated; hidden (half-written) files are
    left out. Linked files share their bytes: replace them, and never write into them.
    """
    for folder, _, names in os.walk(source):
        there = target / Path(folder).relative_to(source)
        there.mkdir(parents=True, exist_ok=True)
        for name in names:
            if not name.startswith(".") and not (there / name).exists():
                _link(Path(folder, name), there / name)


def _link(file: Path, target: Path) -> None:
    try:
        target.hardlink_to(file)
    except OSError:
        # Not on this file system, not across two of them, or too many names already.
        with written_aside(target, durable=True) as aside:
            shutil.copyfile(file, aside)


def copy_files(source: Place, target: Place, names: Sequence[str]) -> None:
    """Copy files of a folder to another, either of which may be at a URL.

    Within one store the store copies; existing files stay. Raises OSError if a file is missing.
    """
    if isinstance(source, UrlPath) and isinstance(target, UrlPath):
        inside = UrlFolder(target).copy(source, names)
    else:
        inside = False
    if not inside:
        contents = ((name, [(source / name).read_bytes()]) for name in names)
        open_folder(target).write(contents, durable=True)
