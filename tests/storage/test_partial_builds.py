"""Unfinished builds: resumed or removed, and an artefact in place at every moment."""

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from pixcal.storage.artefact import build, lock, read_manifest


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
        with (
            pytest.raises(KeyboardInterrupt),
            build(tmp_path, "fit", 1, {"number": 2}, {}) as made,
        ):
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
