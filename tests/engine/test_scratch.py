"""Scratch folders: removed at the end, in memory if there is room, and not left by the killed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pixcal.engine import scratch as module
from pixcal.engine.scratch import scratch_folder


@pytest.fixture
def memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    place = tmp_path / "memory"
    place.mkdir()
    monkeypatch.setattr(module, "MEMORY", place)
    return place


def test_it_is_in_memory_and_gone_at_the_end(memory: Path, tmp_path: Path) -> None:
    with scratch_folder(1000, tmp_path) as folder:
        assert folder.parent == memory
        (folder / "deep").mkdir()
        (folder / "deep" / "file").write_bytes(b"x")
    assert not list(memory.iterdir())
    with pytest.raises(ZeroDivisionError), scratch_folder(1000, tmp_path):
        _ = 1 / 0
    assert not list(memory.iterdir())


@pytest.mark.parametrize("need", [1 << 60, 1000])
def test_without_room_or_place_it_is_where_it_was_told(
    memory: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, need: int
) -> None:
    other = tmp_path / "other"
    other.mkdir()
    if need == 1000:
        monkeypatch.setattr(module, "MEMORY", tmp_path / "no such place")
    with scratch_folder(need, other) as folder:
        assert folder.parent == other
    assert not list(other.iterdir())
    assert not list(memory.iterdir())


KILLED = """
import os, sys, pathlib
from pixcal.engine import scratch
scratch.MEMORY = pathlib.Path(sys.argv[1])
with scratch.scratch_folder(10, scratch.MEMORY) as folder:
    (folder / "file").write_bytes(b"x")
    os.kill(os.getpid(), 9)
"""


def test_a_folder_that_nobody_got_to_hold_is_removed_too(memory: Path, tmp_path: Path) -> None:
    left = memory / "pixcal-scratch-abc"
    left.mkdir()
    os.utime(left, (1, 1))
    with scratch_folder(10, tmp_path):
        assert not left.exists()


def test_what_a_killed_process_left_is_removed_and_what_is_in_use_is_not(
    memory: Path, tmp_path: Path
) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(memory)], check=False)
    (left,) = memory.iterdir()
    with scratch_folder(10, tmp_path) as used:
        assert left.exists(), "too young to be taken for abandoned"
        for folder in (left, used):
            os.utime(folder, (1, 1))
        with scratch_folder(10, tmp_path):
            assert not left.exists()
            assert used.exists()
