"""Cubes away from their artefact: a folder for each, found again, and removed when not needed."""

import json
import shutil
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pixcal.model.errors import DamagedError, InputError
from pixcal.storage.artefact import Build, build
from pixcal.storage.cube import create_group, write_array
from pixcal.storage.cube_place import POINTER, base_of, chosen_base, cubes_of
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.folder import open_folder
from pixcal.storage.place import Place, UrlPath, parse_place

DATA = np.arange(12.0).reshape(3, 4)


@pytest.fixture(params=["folder", "s3"])
def base(request: pytest.FixtureRequest, tmp_path: Path) -> Place:
    if request.param == "folder":
        return tmp_path / "cubes"
    return parse_place(f"{request.getfixturevalue('bucket').url}/cubes")


def files(base: Place, bucket: Any = None) -> list[str]:
    if isinstance(base, Path):
        return sorted(str(p.relative_to(base)) for p in base.rglob("*") if p.is_file())
    return sorted(key.removeprefix("cubes/") for key in bucket.keys())  # noqa: SIM118


@pytest.fixture
def there(base: Place, request: pytest.FixtureRequest) -> Any:
    """What lies at the base now."""
    bucket = None if isinstance(base, Path) else request.getfixturevalue("bucket")
    return lambda: files(base, bucket)


def make(run: Path, config: int, base: Place | None, stage: str = "reduce") -> Place:
    run.mkdir(exist_ok=True)
    with build(run, stage, 1, {"config": config}, {}, cubes=base) as made:
        fill(made, config)
    return cubes_of(run / stage)


def fill(made: Build, config: int) -> None:
    create_group(made.cubes / "reduced.zarr")
    write_array(made.cubes / "reduced.zarr" / "a", DATA + config, dims=("y", "x"))
    made.note("filled")


def cut_short(run: Path, config: int, base: Place | None) -> tuple[Build, set[str]]:
    """A build that was killed when nearly complete, and the steps that it had not to do."""
    run.mkdir(exist_ok=True)
    with (
        suppress(KeyboardInterrupt),
        build(run, "reduce", 1, {"config": config}, {}, cubes=base) as made,
    ):
        steps = made.journal()
        fill(made, config)
        raise KeyboardInterrupt
    return made, steps


def content(run: Path) -> Any:
    return ArrayReader(cubes_of(run / "reduce") / "reduced.zarr" / "a").read()


def test_without_a_base_nothing_is_noted(tmp_path: Path) -> None:
    assert make(tmp_path / "run", 1, None) == tmp_path / "run/reduce"
    assert base_of(tmp_path / "run/reduce") is None
    assert not (tmp_path / "run/reduce" / POINTER).exists()


def test_cubes_lie_in_a_folder_of_their_own_that_says_whose_they_are(
    tmp_path: Path, base: Place, there: Any
) -> None:
    run = tmp_path / "run"
    place = make(run, 1, base)
    assert place.parent == base
    assert base_of(run / "reduce") == base
    assert {name.partition("/")[0] for name in there()} == {place.name}
    note = json.loads((place / "pixcal.json").read_bytes())
    assert note["run"] == str(run)
    assert place.name.startswith(note["artefact"])
    np.testing.assert_array_equal(content(run), DATA + 1)
    assert sorted(p.name for p in (run / "reduce").iterdir()) == [POINTER, "manifest.json"]


def test_the_earlier_cubes_go_when_the_new_are_complete(
    tmp_path: Path, base: Place, there: Any
) -> None:
    run = tmp_path / "run"
    first = make(run, 1, base)
    cut_short(run, 2, base)
    np.testing.assert_array_equal(content(run), DATA + 1)
    second = make(run, 3, base)
    assert second != first
    assert {name.partition("/")[0] for name in there()} == {second.name}
    make(run, 4, None)
    assert there() == []


def test_an_interrupted_build_goes_on_where_its_cubes_are(tmp_path: Path, base: Place) -> None:
    run = tmp_path / "run"
    first, _ = cut_short(run, 1, base)
    second, steps = cut_short(run, 1, base)
    assert steps == {"filled"}
    assert second.cubes == first.cubes
    assert make(run, 1, base) == first.cubes


def test_a_build_with_another_base_begins_again(tmp_path: Path, base: Place, there: Any) -> None:
    run = tmp_path / "run"
    for wanted in (base, base / "other", None, base):
        made, steps = cut_short(run, 1, wanted)
        assert not steps
        assert (made.cubes.parent if made.cubes != made.folder else None) == wanted
    assert {name.partition("/")[0] for name in there()} == {made.cubes.name}


def test_what_others_put_there_stays(tmp_path: Path, base: Place, there: Any) -> None:
    run = tmp_path / "run"
    place = make(run, 1, base)
    names = [f"{place.name}/mine", f"{place.name}/reduced.zarr/a/mine", "mine"]
    open_folder(base).write((name, [b"mine"]) for name in names)
    make(run, 2, None)
    assert there() == sorted(names)


def test_a_copy_of_a_run_reads_its_cubes_and_leaves_them(
    tmp_path: Path, base: Place, caplog: pytest.LogCaptureFixture
) -> None:
    run, copy = tmp_path / "run", tmp_path / "copy"
    first = make(run, 1, base)
    unfinished, _ = cut_short(run, 2, base)
    shutil.copytree(run, copy)
    np.testing.assert_array_equal(content(copy), DATA + 1)
    made, steps = cut_short(copy, 2, base)
    assert not steps, "nor does it write there"
    assert make(copy, 2, base) == made.cubes
    for left, plus in ((first, 1), (unfinished.cubes, 2)):
        assert f"{left}: not removed" in caplog.text
        np.testing.assert_array_equal(ArrayReader(left / "reduced.zarr" / "a").read(), DATA + plus)
    np.testing.assert_array_equal(content(run), DATA + 1)


def test_a_run_that_was_moved_still_owns_its_cubes(tmp_path: Path, base: Place, there: Any) -> None:
    make(tmp_path / "run", 1, base)
    (tmp_path / "run").rename(tmp_path / "moved")
    make(tmp_path / "moved", 2, None)
    assert there() == []


def test_cubes_that_cannot_be_removed_are_named_and_no_error(
    tmp_path: Path, bucket: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    import s3fs

    run = tmp_path / "run"
    place = make(run, 1, parse_place(f"{bucket.url}/x"))

    def refused(*_args: Any, **_options: Any) -> None:
        raise PermissionError("Access Denied")

    monkeypatch.setattr(s3fs.S3FileSystem, "rm", refused)
    s3fs.S3FileSystem.clear_instance_cache()
    make(run, 2, None)
    s3fs.S3FileSystem.clear_instance_cache()
    assert str(place) in caplog.text
    assert "Access Denied" in caplog.text
    (told,) = [r.getMessage() for r in caplog.records if r.name.startswith("pixcal")]
    assert "\n" not in told


def test_which_base_the_user_means(tmp_path: Path) -> None:
    run = tmp_path / "run"
    make(run, 1, tmp_path / "a", "ingest")
    assert chosen_base(None, run, run / "ingest") == tmp_path / "a"
    assert chosen_base(None, run, run / "reduce") is None
    assert chosen_base("s3://bucket/x/", run, run / "ingest") == UrlPath("s3://bucket/x")
    assert chosen_base(str(run), run, run / "ingest") is None
    assert chosen_base(f"file://{run}", run, run / "ingest") is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"base": "s3://b"}'])
def test_a_damaged_pointer_is_refused(tmp_path: Path, text: str) -> None:
    make(tmp_path / "run", 1, tmp_path / "a")
    (tmp_path / "run/reduce" / POINTER).write_text(text)
    with pytest.raises(DamagedError, match=POINTER):
        cubes_of(tmp_path / "run/reduce")


@pytest.mark.long
def test_a_place_that_cannot_be_written_leaves_nothing_behind(
    tmp_path: Path, s3_endpoint: str
) -> None:
    (tmp_path / "file").touch()
    for base in (tmp_path / "file", parse_place("s3://no-such-bucket/x")):
        with pytest.raises(InputError, match=r"--cubes .*cannot be written") as caught:
            make(tmp_path / "run", 1, base)
        assert "\n" not in str(caught.value)
    make(tmp_path / "run", 1, None)
    assert sorted(p.name for p in (tmp_path / "run/.partial").iterdir()) == []
