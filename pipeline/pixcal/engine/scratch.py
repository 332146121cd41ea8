"""A folder for what is written to be read once: in memory where the system has a place for that."""

import fcntl
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MEMORY = Path("/dev/shm")  # files in memory, on Linux; other systems have none
ROOM = 2  # times what is needed that must be free for every core: as many may write there at once
_PREFIX = "pixcal-scratch-"
_HELD = "held"
_YOUNG_S = 60.0


@contextmanager
def scratch_folder(need: int, otherwise: Path) -> Iterator[Path]:
    """A new folder, removed at the end.

    Parameters
    ----------
    need : int
        Bytes that will be written; part of the memory that was planned.
    otherwise : Path
        Folder for it where there is no place in memory, or not enough.
    """
    if not _has_room(need):
        with tempfile.TemporaryDirectory(dir=otherwise) as folder:
            yield Path(folder)
        return
    _remove_abandoned()
    with (
        tempfile.TemporaryDirectory(prefix=_PREFIX, dir=MEMORY) as folder,
        Path(folder, _HELD).open("wb") as held,
    ):
        fcntl.flock(held, fcntl.LOCK_EX)
        yield Path(folder)


def _has_room(need: int) -> bool:
    try:
        free = shutil.disk_usage(MEMORY).free
        return os.access(MEMORY, os.W_OK) and free > ROOM * (os.cpu_count() or 1) * need
    except OSError:
        return False


def _remove_abandoned() -> None:
    """Remove what processes have left that were killed: nobody holds it any more."""
    for folder in MEMORY.glob(f"{_PREFIX}*"):
        try:
            if time.time() - folder.stat().st_mtime < _YOUNG_S:
                continue
            if (folder / _HELD).exists():
                with (folder / _HELD).open("rb") as held:
                    fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            shutil.rmtree(folder, ignore_errors=True)
        except OSError:
            continue  # held, or another user's, or gone
