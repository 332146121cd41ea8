"""The files of an acquisition, and whether they are unchanged.

``headers.csv`` beside ``acquisition.yaml`` holds header keywords of files that have no header: its
first column, ``file``, names or globs relative to the folder; the others are named as the keywords
of FITS headers, and mean the same.
"""

import csv
import io
import math
import os
import stat
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path, PurePosixPath

from pixcal.model.acquisition import Frames
from pixcal.model.errors import InputError, reason_of
from pixcal.storage.manifest import digest

HEADERS = "headers.csv"
KEYWORDS = ("EXPTIME", "MJD-OBS", "DATE-OBS", "CCD-TEMP")

Header = tuple[tuple[str, str | float], ...]  # keywords and values


def read_headers(folder: Path, names: Iterable[str]) -> dict[str, Header]:
    """Headers of files by their names; empty where there is no ``headers.csv``.

    Raises InputError naming the line that matches none of the ``names``, repeats one, or has no
    usable value.
    """
    path = folder / HEADERS
    if not path.exists():
        return {}
    headers: dict[str, Header] = {}
    names = list(names)
    try:
        with path.open(encoding="utf-8-sig", newline="") as handle:
            rows = csv.DictReader(handle, skipinitialspace=True)
            columns = list(rows.fieldnames or ())
            if columns[:1] != ["file"] or not set(columns[1:]) <= set(KEYWORDS):
                raise InputError(
                    f"{path}: the columns are {', '.join(columns) or 'missing'}; write file, then "
                    f"any of {', '.join(KEYWORDS)}"
                )
            for row in rows:
                place = f"{path}: line {rows.line_num}"
                header = tuple(_cards(place, row))
                matched = [name for name in names if fnmatchcase(name, row["file"] or "")]
                if not matched:
                    raise InputError(f"{place}: {row['file']!r:.80} matches no frame; correct it")
                for name in matched:
                    if name in headers:
                        raise InputError(f"{place}: {name} is matched by two lines; list it once")
                    headers[name] = header
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(
            f"{path}: cannot be read ({reason_of(error)}); write it as UTF-8 text"
        ) from error
    return headers


def _cards(place: str, row: dict[str, str | None]) -> Iterable[tuple[str, str | float]]:
    for key in KEYWORDS:
        text = (row.get(key) or "").strip()
        if not text:
            continue
        if key not in ("EXPTIME", "MJD-OBS", "CCD-TEMP"):
            yield key, text
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (key == "EXPTIME" and value < 0):
            raise InputError(f"{place}: {key} {text!r:.40} is not a valid number")
        yield key, value


@dataclass(frozen=True)
class SourceFile:
    """A file as found."""

    path: Path  # where it is
    name: str  # relative to the acquisition's folder, with `/`
    size: int  # bytes
    mtime_ns: int  # time of the last change (ns since 1970)
    header: Header = ()  # its entry in `headers.csv`
    # what is wrong, and what to do, if it is not as found
    changed: str = (
        "changed while it was being read; wait until the acquisition is complete and run again"
    )

    def open(self) -> io.FileIO:
        """Open the file for unbuffered reading; InputError if it has changed."""
        with reading(self.path):
            handle = io.FileIO(self.path)
        try:
            self.check_read(handle)
        except BaseException:
            handle.close()
            raise
        return handle

    def check_read(self, handle: io.FileIO) -> None:
        """Raise InputError if the file behind a handle has changed."""
        self._compare(os.fstat(handle.fileno()))

    def check_unchanged(self) -> None:
        """Raise InputError if the file is missing or has changed."""
        with reading(self.path):
            self._compare(self.path.stat())

    def _compare(self, now: os.stat_result) -> None:
        if (now.st_size, now.st_mtime_ns) != (self.size, self.mtime_ns):
            raise InputError(f"{self.path}: {self.changed}")


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Context in which errors of the system become an InputError, why the file cannot be read."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror or reason_of(error)}); restore the file or "
            "its permissions"
        ) from error


def fingerprint(sources: Sequence[SourceFile]) -> str:
    """Digest of the names, sizes, times of change and listed headers of a set of files."""
    return digest([(s.name, s.size, s.mtime_ns, *s.header) for s in sources])


def find_sources(frames: Frames, description: Path) -> dict[str, tuple[SourceFile, ...]]:
    """Files of each array of an acquisition, by the array's name (``fringes/<set>`` for a set).

    Raises InputError if a glob leaves the folder or matches nothing, or a file is empty, unreadable
    or listed twice.
    """
    files: dict[str, tuple[SourceFile, ...]] = {}
    seen: dict[tuple[int, int], tuple[str, str]] = {}
    for array, key, globs in _globs(frames):
        if not globs:
            continue
        names: set[str] = set()
        for number, pattern in enumerate(globs):
            names |= _matches(pattern, description, f"{description}: {key}[{number}]")
        files[array] = tuple(_source(description.parent, name, key, seen) for name in sorted(names))
    listed = {source.name for sources in files.values() for source in sources}
    headers = read_headers(description.parent, sorted(listed))
    return {
        array: tuple(replace(s, header=headers.get(s.name, ())) for s in sources)
        for array, sources in files.items()
    }


def _globs(frames: Frames) -> list[tuple[str, str, tuple[str, ...]]]:
    """Array name, key in the description, and globs of each kind."""
    kinds = [(kind, f"frames.{kind}", getattr(frames, kind)) for kind in ("bias", "dark", "flat")]
    sets = [
        (f"fringes/{s.name}", f"frames.fringes[{number}].files", s.files)
        for number, s in enumerate(frames.fringes)
    ]
    return kinds + sets


def _matches(pattern: str, description: Path, place: str) -> set[str]:
    if ".." in PurePosixPath(pattern).parts:
        raise InputError(
            f"{place}: {pattern!r:.80} leaves the folder of the acquisition; write it without '..' "
            "(a symbolic link may lead elsewhere)"
        )
    folder = description.parent
    parts = PurePosixPath(pattern).parts
    try:
        # Not glob.glob, whose '**' follows links to folders, even cyclic ones.
        paths = [path for path in folder.glob(pattern) if not path.is_dir()] if parts else []
    except (ValueError, OSError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise InputError(
            f"{place}: {pattern!r:.80} cannot be used ({reason!s:.80}); correct it"
        ) from error
    names = {path.relative_to(folder) for path in paths}
    if not any(part.startswith(".") for part in parts):
        # Hidden ones, such as the '._…' that some systems leave.
        names = {name for name in names if not any(part.startswith(".") for part in name.parts)}
    if not names:
        raise InputError(
            f"{place}: {pattern!r:.80} matches no file in {folder}; correct it, or remove it from "
            "the list"
        )
    return {name.as_posix() for name in names}


def _source(
    folder: Path, name: str, key: str, seen: dict[tuple[int, int], tuple[str, str]]
) -> SourceFile:
    path = folder / name
    with reading(path):
        facts = path.stat()
    if not stat.S_ISREG(facts.st_mode):
        raise InputError(f"{path}: not a regular file; remove it or narrow {key}")
    if facts.st_size == 0:
        raise InputError(f"{path}: empty (0 bytes); copy it again, or remove it")
    # By device and inode, so that links under another name count as the same frame.
    other = seen.setdefault((facts.st_dev, facts.st_ino), (name, key))
    if other != (name, key):
        raise InputError(
            f"{path}: the file is listed twice, by {key} and as {other[0]} by {other[1]}; "
            "remove one"
        )
    return SourceFile(path, name, facts.st_size, facts.st_mtime_ns)
