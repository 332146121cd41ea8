"""Full disk: at the n-th write of a command, and on a real file system that is too small."""

import builtins
import errno
import io
import math
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

from faults import Outcome
from faults.bench import Bench
from faults.forks import pixcal

RESUMED = "one line, exit 1; resumed"
_LINE = "disk full; complete results are kept: free some space and run the same command again"


def at_writes(bench: Bench, stage: str, times: int) -> Outcome:
    """Let ``times`` of the writes of a command fail half-way, and all that follow."""
    outcome = Outcome("disk full at the n-th write")
    for number in sorted(bench.rng(stage).sample(range(_count(bench, stage)), times)):
        run = bench.before(stage, f"{stage}-full")
        pixcal(*bench.command(stage, run), before=partial(_fill_up, run, number)).refused(1, _LINE)
        bench.assert_resumed(run, stage)
        outcome.ends[RESUMED] += 1
    return outcome


def _count(bench: Bench, stage: str) -> int:
    run, told = bench.before(stage, f"{stage}-full"), bench.folder / "writes"
    pixcal(*bench.command(stage, run), before=partial(_count_writes, run, told)).succeeded()
    return int(told.read_text())


class _Disk:
    """Counts what is written to files below a folder; from the n-th write on there is no room."""

    def __init__(self, folder: Path, room: float) -> None:
        self.folder, self.room, self.writes = f"{folder}/", room, 0
        self._open = io.open

    def open(self, file: Any, mode: str = "r", *args: Any, **options: Any) -> Any:
        """As the built-in function."""
        inside = isinstance(file, str | os.PathLike) and os.fspath(file).startswith(self.folder)
        if not inside or not set(mode) & set("wax+"):
            return self._open(file, mode, *args, **options)
        raw = _File(self, file, mode.replace("b", "").replace("t", ""))
        buffered = io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        return io.TextIOWrapper(buffered, encoding=options.get("encoding"), write_through=True)


class _File(io.FileIO):
    def __init__(self, disk: _Disk, file: Any, mode: str) -> None:
        super().__init__(file, mode)
        self._disk = disk

    def write(self, content: Any) -> int:
        disk = self._disk
        disk.writes += 1
        if disk.writes > disk.room:
            super().write(memoryview(content)[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(self.name))
        return super().write(content)


def _install(disk: _Disk) -> None:
    io.open = builtins.open = disk.open


def _fill_up(run: Path, number: int) -> None:
    _install(_Disk(run, number))


def _count_writes(run: Path, told: Path) -> None:
    disk = _Disk(run, math.inf)
    # At the end of the process: those of multiprocessing do without atexit.
    Finalize(None, lambda: told.write_text(str(disk.writes)), exitpriority=1)
    _install(disk)


def on_small_disks(bench: Bench, stage: str, times: int) -> Outcome:
    """Run a command on tmpfs of random sizes that are too small; then with room."""
    outcome = Outcome("file system too small (tmpfs)")
    rng = bench.rng(stage)
    while outcome.tried < times:
        with _tmpfs(bench.folder / "small") as (disk, resize):
            source = bench.before(stage, "source")
            run = disk / "run"
            subprocess.run(["cp", "-a", source, run], check=True)
            used = _used(disk)
            needed = sum(_size(bench.reference / part) for part in (stage, "sweep", "products"))
            room = rng.uniform(0, 1.2) * needed
            resize(used + int(room))
            ended = pixcal(*bench.command(stage, run))
            if ended.code == 0:
                continue  # it was large enough
            ended.refused(1, _LINE)
            resize(1 << 30)
            bench.assert_resumed(run, stage)
            outcome.ends[RESUMED] += 1
    return outcome


@contextmanager
def _tmpfs(place: Path) -> Iterator[tuple[Path, Callable[[int], None]]]:
    """A file system in memory, and what changes its size (bytes)."""
    place.mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1g", "tmpfs", place], check=True)

    def resize(size: int) -> None:
        option = f"remount,size={-(-size // 4096) * 4096}"
        subprocess.run(["mount", "-o", option, place], check=True)

    try:
        yield place, resize
    finally:
        subprocess.run(["umount", place], check=True)


def can_mount(folder: Path) -> bool:
    """Whether this process may mount a tmpfs."""
    try:
        with _tmpfs(folder / "try"):
            return True
    except (OSError, subprocess.CalledProcessError):
        return False


def _used(disk: Path) -> int:
    facts = os.statvfs(disk)
    return (facts.f_blocks - facts.f_bfree) * facts.f_frsize


def _size(folder: Path) -> int:
    return sum(-(-f.stat().st_size // 4096) * 4096 for f in folder.rglob("*") if f.is_file())
