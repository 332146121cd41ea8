"""Unfinished builds: resumed or removed, and an artefact in place at every moment."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixcal.storage import artefact
from pixcal.storage.artefact import build
from pixcal.storage.cube import create_array, create_group
from pixcal.storage.lock import lock
from pixcal.storage.manifest import read_manifest


def complete(run: Path, stage: str, number: int) -> None:
    with build(run, stage, 1, {"number": number}, {}) as made:
        (made.folder / "data").write_text(str(number))


def cut_short(run: Path, stage: str, number: int) -> Path:
    with suppress(KeyboardInterrupt), build(run, stage, 1, {"number": number}, {}) as made:
        made.note("one step")
        raise KeyboardInterrupt
    return made.folder


def test_a_complete_build_removes_unfinished_ones_of_its_stage_only(tmp_path: Path) -> None:
    left = [cut_short(tmp_path, "fit", number) for number in (1, 2)]
    others = [cut_short(tmp_path, stage, 1) for stage in ("fit-scan", "allan", "refit")]
    complete(tmp_path, "fit", 3)
    assert [folder.exists() for folder in left] == [False, False]
    assert sorted((tmp_path / ".partial").iterdir()) == sorted(others)
    assert (tmp_path / "fit/data").read_text() == "3"


def test_an_unfinished_build_removes_nothing(tmp_path: Path) -> None:
    first, second = (cut_short(tmp_path, "fit", number) for number in (1, 2))
    assert first.is_dir()
    assert second.is_dir()
    with build(tmp_path, "fit", 1, {"number": 1}, {}) as made:
        assert made.resumed
        assert made.journal() == {"one step"}


def test_a_build_is_not_resumed_by_other_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or one artefact would hold tiles of two versions."""
    left = cut_short(tmp_path, "fit", 1)
    monkeypatch.setattr(artefact, "code_digest", lambda: "edited")
    with build(tmp_path, "fit", 1, {"number": 1}, {}) as made:
        assert not made.resumed
        assert made.journal() == set()
    assert not left.exists()


@pytest.mark.parametrize("array", ["signal", "c"])
@pytest.mark.parametrize("damage", ["none", "bit", "empty"])
def test_what_is_resumed_is_as_it_was_written(tmp_path: Path, array: str, damage: str) -> None:
    """A group may be named as the folder of the chunks is."""
    with suppress(KeyboardInterrupt), build(tmp_path, "fit", 1, {}, {}) as made:
        create_group(made.folder / "c")
        writer = create_array(made.folder / "c" / array, (70, 130, 5), "u2")
        writer.write((0, 0, 0), np.arange(64 * 128 * 5, dtype="u2").reshape(64, 128, 5))
        made.note("the first block")
        raise KeyboardInterrupt
    chunk = made.folder / "c" / array / "c/0/0/0"
    body = bytearray(chunk.read_bytes())
    body[len(body) // 3] ^= damage == "bit"
    chunk.write_bytes(b"" if damage == "empty" else bytes(body))
    with suppress(KeyboardInterrupt), build(tmp_path, "fit", 1, {}, {}) as again:
        assert again.resumed == (damage == "none")
        assert again.journal() == ({"the first block"} if damage == "none" else set())
        raise KeyboardInterrupt


@pytest.mark.parametrize("move", [1, 2])
def test_killed_between_the_moves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, move: int
) -> None:
    """The old artefact is back for the next command, and the new one is not built again."""
    complete(tmp_path, "fit", 1)
    rename, moves = Path.rename, []

    def killed(self: Path, target: Any) -> Path:
        moves.append(target)
        if len(moves) == move:
            raise KeyboardInterrupt
        return rename(self, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed)
        with pytest.raises(KeyboardInterrupt), build(tmp_path, "fit", 1, {"number": 2}, {}) as made:
            made.note("one step")
    with lock(tmp_path):
        manifest = read_manifest(tmp_path / "fit")
        assert manifest is not None
        assert manifest.config == {"number": 1}
        assert (tmp_path / "fit/data").read_text() == "1"
        with build(tmp_path, "fit", 1, {"number": 2}, {}) as made:
            assert made.journal() == {"one step"}
    assert sorted(p.name for p in (tmp_path / "fit").iterdir()) == ["manifest.json"]
    assert not list((tmp_path / ".partial").iterdir())
