"""Artefacts: whole or not there, resumed after a kill, one process at a time."""

import json
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from typing import Any

import pytest

from pixcal import __version__
from pixcal.model.errors import DamagedError, InputError
from pixcal.storage import artefact
from pixcal.storage.artefact import artefact_key, build, up_to_date
from pixcal.storage.lock import lock
from pixcal.storage.manifest import MANIFEST, Manifest, digest, read_json, read_manifest, write_json
from pixcal.storage.stage import require

CONFIG = {"model": "paraxial", "limit": 1.5}
INPUTS = {"reduce": "abc"}


def complete(run: Path, config: dict[str, Any] = CONFIG, text: str = "first") -> Manifest:
    with build(run, "fit", 1, config, INPUTS) as made:
        (made.folder / "data").write_text(text)
        made.summary = {"pixels": 7}
    return require(run, "fit")


def test_a_complete_artefact(tmp_path: Path) -> None:
    with build(tmp_path, "fit", 1, CONFIG, INPUTS) as made:
        (made.folder / "data").write_text("x")
        made.note("one")
        assert not (tmp_path / "fit").exists()
        assert not made.resumed
    assert sorted(f.name for f in (tmp_path / "fit").iterdir()) == ["data", MANIFEST]
    key = artefact_key("fit", 1, CONFIG, INPUTS)
    files = {"data": sha256(b"x").hexdigest()[:32]}
    expected = Manifest("fit", 1, key, CONFIG, INPUTS, __version__, {}, files)
    assert require(tmp_path, "fit") == expected
    assert not list((tmp_path / ".partial").iterdir())


def test_the_key_depends_on_everything_and_on_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    key = artefact_key("fit", 1, CONFIG, INPUTS)
    with monkeypatch.context() as patch:
        patch.setattr(artefact, "__version__", "0.0.7")
        later = artefact_key("fit", 1, CONFIG, INPUTS)
    assert key == artefact_key("fit", 1, dict(reversed(CONFIG.items())), INPUTS)
    others = [
        artefact_key("fit2", 1, CONFIG, INPUTS),
        artefact_key("fit", 2, CONFIG, INPUTS),
        artefact_key("fit", 1, CONFIG | {"limit": 1.6}, INPUTS),
        artefact_key("fit", 1, CONFIG | {"more": None}, INPUTS),
        artefact_key("fit", 1, CONFIG, INPUTS | {"reduce": "abd"}),
        later,
    ]
    assert len({key, *others}) == 7
    assert digest((1, 2)) == digest([1, 2]), "a tuple is read back as a list"
    complete(tmp_path)
    assert up_to_date(tmp_path, "fit", key) is not None
    assert all(up_to_date(tmp_path, "fit", other) is None for other in others)
    assert up_to_date(tmp_path, "allan", key) is None


def test_another_key_replaces_only_when_complete(tmp_path: Path) -> None:
    first = complete(tmp_path)
    other = CONFIG | {"limit": 2.0}
    with suppress(RuntimeError), build(tmp_path, "fit", 1, other, INPUTS) as made:
        (made.folder / "data").write_text("half")
        raise RuntimeError
    assert require(tmp_path, "fit") == first
    assert (tmp_path / "fit" / "data").read_text() == "first"
    second = complete(tmp_path, other, "second")
    assert second.key != first.key
    assert require(tmp_path, "fit") == second
    assert (tmp_path / "fit" / "data").read_text() == "second"


def test_a_build_is_resumed_by_its_own_key_only(tmp_path: Path) -> None:
    with suppress(RuntimeError), build(tmp_path, "fit", 1, CONFIG, INPUTS) as made:
        made.note("vertical:0,0")
        made.note('odd "name"\n')
        (made.folder / "data").write_text("kept")
        raise RuntimeError
    with suppress(RuntimeError), build(tmp_path, "fit", 1, CONFIG | {"limit": 9}, INPUTS) as other:
        assert not other.resumed
        assert other.journal() == set()
        raise RuntimeError
    with build(tmp_path, "fit", 1, CONFIG, INPUTS) as again:
        assert again.resumed
        assert again.journal() == {"vertical:0,0", 'odd "name"\n'}
        assert (again.folder / "data").read_text() == "kept"


def test_a_journal_cut_at_any_byte_holds_only_what_was_done(tmp_path: Path) -> None:
    steps = ["a:0,0", "a:0,12", "b:1,3"]
    with suppress(RuntimeError), build(tmp_path, "fit", 1, CONFIG, INPUTS) as made:
        for step in steps:
            made.note(step)
        raise RuntimeError
    file = made.folder / "journal.jsonl"
    body = file.read_bytes()
    for size in range(len(body) + 1):
        file.write_bytes(body[:size])
        done = made.journal()
        assert done == set(steps[: len(done)])
        made.note("after the cut")
        assert made.journal() == done | {"after the cut"}
    for line in (b"7\n", b'{"other": 1}\n', b"[]\n", b"null\n"):
        file.write_bytes(body + line)
        assert made.journal() == set(steps)


WORK = """
import sys, time
from pathlib import Path
from pixcal.storage.artefact import build
from pixcal.storage.lock import lock
run = Path(sys.argv[1])
with lock(run), build(run, "fit", 1, {"model": "paraxial", "limit": 1.5}, {"reduce": "abc"}) as b:
    (b.folder / "data").write_text("by the other")
    b.note("one")
    print("ready", flush=True)
    time.sleep(60)
"""


def start_and_wait(run: Path) -> subprocess.Popen[str]:
    other = subprocess.Popen(
        [sys.executable, "-c", WORK, str(run)], stdout=subprocess.PIPE, text=True
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "ready\n"
    return other


def test_a_second_process_is_refused_and_a_killed_one_resumed(tmp_path: Path) -> None:
    other = start_and_wait(tmp_path)
    try:
        with pytest.raises(InputError, match="another pixcal is working there"), lock(tmp_path):
            pass
    finally:
        os.kill(other.pid, signal.SIGKILL)
        other.communicate()
    assert not (tmp_path / "fit").exists()
    with lock(tmp_path), build(tmp_path, "fit", 1, CONFIG, INPUTS) as made:
        assert made.resumed
        assert made.journal() == {"one"}
        assert (made.folder / "data").read_text() == "by the other"
    assert require(tmp_path, "fit").config == CONFIG


def test_the_lock_is_free_again(tmp_path: Path) -> None:
    with suppress(RuntimeError), lock(tmp_path / "run"):
        with pytest.raises(InputError), lock(tmp_path / "run"):
            pass
        raise RuntimeError
    with lock(tmp_path / "run"), lock(tmp_path / "other"):
        pass


def test_a_run_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        pytest.raises(InputError, match="file: not a directory; choose another RUN"),
        lock(tmp_path / "file"),
    ):
        pass


def test_an_exception_comes_through(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="broken"), build(tmp_path, "fit", 1, {}, {}):
        raise RuntimeError("broken")
    assert not (tmp_path / "fit").exists()


def test_what_must_have_been_run(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere: no such run directory.*pixcal ingest"):
        require(tmp_path / "nowhere", "fit")
    with pytest.raises(InputError, match=r"fit: not there yet; run 'pixcal fit"):
        require(tmp_path, "fit")
    with build(tmp_path, "fit", 2, CONFIG, INPUTS):
        pass
    with pytest.raises(InputError, match=r"format fit/2; this version of pixcal reads fit/1"):
        require(tmp_path, "fit")
    complete(tmp_path)
    (tmp_path / "fit").rename(tmp_path / "allan")
    with pytest.raises(InputError, match=r"format fit/1; this version of pixcal reads allan/1"):
        require(tmp_path, "allan")


@pytest.mark.parametrize("stage", ["fit", "allan", "corrected"])
def test_without_fringes_no_command_is_advised_that_needs_them(tmp_path: Path, stage: str) -> None:
    with build(tmp_path, "ingest", 1, {}, {}) as made:
        write_json(made.folder / "acquisition.json", {"frames": {"fringes": []}})
    with pytest.raises(
        InputError, match=f"no {stage}: its acquisition.yaml lists no frames.fringes$"
    ):
        require(tmp_path, stage)


def test_a_damaged_manifest_is_named(tmp_path: Path) -> None:
    complete(tmp_path)
    file = tmp_path / "fit" / MANIFEST
    body = file.read_text()
    broken = [body[: len(body) // 2], "", "[]", "7", "null", '{"stage": "fit"}', "\xff\x00"]
    broken.append(json.dumps(json.loads(body) | {"unknown": 1}))
    for text in broken:
        file.write_text(text, encoding="latin-1")
        with pytest.raises(DamagedError, match=MANIFEST) as caught:
            read_manifest(tmp_path / "fit")
        assert "\n" not in str(caught.value)
    file.unlink()
    assert read_manifest(tmp_path / "fit") is None


def test_json_is_replaced_whole_or_not_at_all(tmp_path: Path) -> None:
    file = tmp_path / "a.json"
    write_json(file, {"x": [1, None, "é"]})
    for bad in ({"x": float("nan")}, {"x": object()}):
        with pytest.raises((ValueError, TypeError)):
            write_json(file, bad)
        assert read_json(file) == {"x": [1, None, "é"]}
    write_json(file, {"y": 2})
    assert read_json(file) == {"y": 2}
    with pytest.raises(DamagedError, match=r"missing\.json: cannot be read"):
        read_json(tmp_path / "missing.json")


def test_killed_at_any_time_the_artefact_is_whole(tmp_path: Path) -> None:
    """Versions are built one after the other by a process that is killed at odd moments."""
    loop = """
import sys, itertools
from pathlib import Path
from pixcal.storage.artefact import build, read_manifest
from pixcal.storage.lock import lock
run = Path(sys.argv[1])
found = read_manifest(run / "fit")
for n in itertools.count(found.config["n"] + 1 if found else 0):
    with lock(run), build(run, "fit", 1, {"n": n}, {}) as made:
        for part in "ab":
            (made.folder / part).write_text(str(n))
    print(n, flush=True)
"""
    seen = -1
    for delay in (0.0, 0.004, 0.011, 0.02):
        other = subprocess.Popen(
            [sys.executable, "-c", loop, str(tmp_path)], stdout=subprocess.PIPE, text=True
        )
        assert other.stdout is not None
        other.stdout.readline()
        time.sleep(delay)
        os.kill(other.pid, signal.SIGKILL)
        other.communicate()
        with lock(tmp_path):
            manifest = require(tmp_path, "fit")
        number = manifest.config["n"]
        assert number > seen
        assert [(tmp_path / "fit" / part).read_text() for part in "ab"] == [str(number)] * 2
        seen = number
