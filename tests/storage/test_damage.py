"""Damaged artefacts: seen before they are used, and made again by their own command."""

import errno
import math
import os
import shutil
import signal
import time
import tracemalloc
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pixcal.model.errors import DamagedError
from pixcal.storage import writeback
from pixcal.storage.artefact import build, unflushed, up_to_date
from pixcal.storage.cube import create_array, create_group, write_array
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.formats import STAGES
from pixcal.storage.lock import damage_noted, flushed_last, lock
from pixcal.storage.manifest import (
    DAMAGE,
    JOURNAL,
    MANIFEST,
    SCRATCH,
    UNFLUSHED,
    read_json,
    read_manifest,
    write_json,
)
from pixcal.storage.products import is_whole, read_map, write_map
from pixcal.storage.stage import require


def complete(run: Path, stage: str = "fit") -> str:
    """An artefact with a file, an array in a group, and a list of numbers in its manifest."""
    format = STAGES[stage].format if stage == "sweep" else 1
    with lock(run), build(run, stage, format, {"limits": (1.5, 1e-7)}, {"reduce": "key"}) as made:
        write_json(made.folder / "facts.json", {"name": "Übung"})
        create_group(made.folder / "maps.zarr")
        write_array(made.folder / "maps.zarr" / "delta", np.arange(6.0).reshape(2, 3), dims="yx")
        create_group(made.scratch)
        made.note("a step")
    return made.key


def flip(file: Path, bit: int) -> None:
    body = bytearray(file.read_bytes())
    body[bit >> 3] ^= 1 << (bit & 7)
    file.unlink()
    file.write_bytes(body)


@pytest.mark.long
def test_every_flipped_bit_of_a_manifest_is_seen(tmp_path: Path) -> None:
    complete(tmp_path)
    file = tmp_path / "fit" / MANIFEST
    body = file.read_bytes()
    for bit in range(8 * len(body)):
        flip(file, bit)
        with pytest.raises(DamagedError, match=MANIFEST):
            read_manifest(tmp_path / "fit")
        file.write_bytes(body)
    assert read_manifest(tmp_path / "fit") is not None


def test_a_manifest_of_an_earlier_version_has_no_seal(tmp_path: Path) -> None:
    key = complete(tmp_path)
    file = tmp_path / "fit" / MANIFEST
    data = read_json(file)
    del data["seal"], data["files"]
    write_json(file, data)
    assert require(tmp_path, "fit").key == key
    assert up_to_date(tmp_path, "fit", key) is not None


FILES = (
    MANIFEST,
    "facts.json",
    "maps.zarr/zarr.json",
    "maps.zarr/delta/zarr.json",
    "maps.zarr/delta/chunks.npy",
)


@pytest.mark.parametrize("damage", ["flipped", "missing", "cut", "empty"])
@pytest.mark.parametrize("name", FILES)
def test_what_is_no_chunk_is_named_with_the_command_that_mends_it(
    tmp_path: Path, name: str, damage: str
) -> None:
    key = complete(tmp_path)
    assert up_to_date(tmp_path, "fit", key) is not None
    file = tmp_path / "fit" / name
    if damage == "flipped":
        flip(file, 8 * (file.stat().st_size // 2))
    elif damage == "missing":
        file.unlink()
    else:
        file.write_bytes(file.read_bytes()[: 9 * (damage == "cut")])
    assert up_to_date(tmp_path, "fit", key) is None
    if name != MANIFEST or damage != "missing":  # without a manifest there is no artefact
        with pytest.raises(DamagedError, match=rf"{name}: .*; make it again with 'pixcal fit "):
            require(tmp_path, "fit")
    assert complete(tmp_path) == key
    assert up_to_date(tmp_path, "fit", key) is not None


@pytest.mark.parametrize(
    ("stage", "command"),
    [
        ("ingest", "pixcal ingest ACQ --out {}"),
        ("reduce", "pixcal reduce {}"),
        ("sweep", "pixcal fit {}"),
    ],
)
@pytest.mark.parametrize("holds_the_lock", [True, False])
def test_a_damaged_chunk_is_noted_and_its_command_told(
    tmp_path: Path, stage: str, command: str, holds_the_lock: bool
) -> None:
    key = complete(tmp_path, stage)
    chunk = tmp_path / stage / "maps.zarr/delta/c/0/0"
    flip(chunk, 40)
    assert up_to_date(tmp_path, stage, key) is not None, "nobody has read it"
    with (
        pytest.raises(DamagedError) as caught,
        lock(tmp_path) if holds_the_lock else damage_noted(tmp_path),
    ):
        ArrayReader(chunk.parents[2]).read()
    assert str(caught.value) == (
        f"{chunk}: checksum does not match, the chunk was altered; "
        f"make it again with '{command.format(tmp_path)}'"
    )
    assert up_to_date(tmp_path, stage, key) is None
    with pytest.raises(DamagedError, match=r"c/0/0: damaged; make it again with"):
        require(tmp_path, stage)
    complete(tmp_path, stage)
    assert require(tmp_path, stage).key == key
    ArrayReader(chunk.parents[2]).read()


def test_a_note_that_is_damaged_itself_still_counts(tmp_path: Path) -> None:
    key = complete(tmp_path)
    (tmp_path / "fit" / DAMAGE).write_text("{")
    assert up_to_date(tmp_path, "fit", key) is None
    with pytest.raises(DamagedError, match=DAMAGE):
        require(tmp_path, "fit")


def test_an_unfinished_build_that_is_damaged_is_begun_again(tmp_path: Path) -> None:
    with suppress(KeyboardInterrupt), build(tmp_path, "fit", 1, {}, {}) as made:
        write_array(made.folder / "delta", np.zeros(3), dims=("x",))
        raise KeyboardInterrupt
    flip(made.folder / "delta/c/0", 30)
    with pytest.raises(DamagedError, match=r"c/0: .*; run the same command again"), lock(tmp_path):
        ArrayReader(made.folder / "delta").read()
    assert not made.folder.exists()


def test_damage_elsewhere_is_not_noted(tmp_path: Path) -> None:
    key = complete(tmp_path / "run")
    complete(tmp_path / "run", "fitter")
    with pytest.raises(DamagedError), lock(tmp_path / "run"):
        raise DamagedError(tmp_path / "run" / "fitter" / "facts.json", "x")
    assert up_to_date(tmp_path / "run", "fit", key) is not None


def test_a_kill_before_the_last_steps_leaves_nothing_behind(tmp_path: Path) -> None:
    complete(tmp_path)
    final, old = tmp_path / "fit", tmp_path / ".partial" / "fit-replaced"
    assert sorted(f.name for f in final.iterdir()) == ["facts.json", MANIFEST, "maps.zarr"]
    shutil.copytree(final, old)
    (final / JOURNAL).touch()
    (final / SCRATCH).mkdir()
    with lock(tmp_path):
        assert sorted(f.name for f in final.iterdir()) == ["facts.json", MANIFEST, "maps.zarr"]
        assert not old.exists()


# On the way to the disk


def test_artefacts_are_marked_until_they_are_on_the_disk(tmp_path: Path) -> None:
    mark = tmp_path / "fit" / UNFLUSHED
    with flushed_last(tmp_path):
        key = complete(tmp_path)
        assert mark.exists()
        assert up_to_date(tmp_path, "fit", key) is not None
        with lock(tmp_path):
            assert mark.exists()
    assert not mark.exists()
    assert up_to_date(tmp_path, "fit", key) is not None


def test_where_nothing_was_made_no_run_directory_is_left(tmp_path: Path) -> None:
    with flushed_last(tmp_path / "run"):
        pass
    assert not (tmp_path / "run").exists()


def test_a_kill_leaves_the_flush_to_the_next_command(tmp_path: Path) -> None:
    with unflushed():
        complete(tmp_path)
    with lock(tmp_path):
        assert not (tmp_path / "fit" / UNFLUSHED).exists()


@pytest.mark.parametrize("left", ["of another boot", ""])
def test_after_a_power_failure_what_was_not_on_the_disk_is_made_again(
    tmp_path: Path, left: str
) -> None:
    with unflushed():
        key = complete(tmp_path, "sweep")
    (tmp_path / "sweep" / UNFLUSHED).write_text(left)
    with lock(tmp_path):
        assert up_to_date(tmp_path, "sweep", key) is None
    with pytest.raises(DamagedError, match="machine stopped"):
        require(tmp_path, "sweep")
    complete(tmp_path, "sweep")
    assert up_to_date(tmp_path, "sweep", key) is not None


def test_what_the_disk_refuses_is_no_complete_artefact(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_handle: int) -> None:
        raise OSError(errno.EIO, "input/output error")

    def fail() -> None:
        with build(tmp_path, "fit", 1, {}, {}) as made:
            # The thread that flushes it meets the error first.
            write_array(made.folder / "delta", large, dims=("x",), chunks=large.shape)

    large = np.random.default_rng(1).integers(0, 2**32, 2 * writeback.LARGE, np.uint32)
    monkeypatch.setattr(os, "fsync", refuse)
    with lock(tmp_path), pytest.raises(OSError, match="input/output"):
        fail()
    assert not (tmp_path / "fit").exists()


def test_a_forked_process_flushes_by_itself(tmp_path: Path) -> None:
    file = tmp_path / "file"
    file.touch()
    writeback.begin(file)
    writeback.wait()
    child = os.fork()
    if not child:
        writeback.begin(file)
        writeback.wait()
        os._exit(0)
    deadline = time.monotonic() + 20
    while not (ended := os.waitpid(child, os.WNOHANG))[0] and time.monotonic() < deadline:
        time.sleep(0.01)
    if not ended[0]:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    assert ended == (child, 0)


# Products


@pytest.fixture
def product(tmp_path: Path) -> Path:
    path = tmp_path / "delta_x.fits"
    delta = np.arange(63, dtype=np.float32).reshape(7, 9)
    mask = np.zeros((7, 9), np.uint8)
    write_map(path, delta, delta / 9, mask, [("MODEL", "paraxial", "shape")], ["a line"])
    return path


def test_equal_maps_are_equal_files(product: Path) -> None:
    data, sigma, mask, _ = read_map(product)
    again = product.with_name("again.fits")
    write_map(again, data, sigma, mask, [("MODEL", "paraxial", "shape")], ["a line"])
    assert again.read_bytes() == product.read_bytes()


class Ramp:
    """A map that is nowhere in memory; its values are the numbers of their rows."""

    shape = (6007, 501)

    def read(self, rows: tuple[int, int]) -> NDArray[Any]:
        return np.repeat(np.arange(*rows, dtype=np.float32)[:, None], self.shape[1], axis=1)


def test_products_are_written_a_band_of_rows_at_a_time(tmp_path: Path) -> None:
    ramp, path = Ramp(), tmp_path / "delta_x.fits"
    tracemalloc.start()
    write_map(path, ramp, ramp, np.zeros(ramp.shape, np.uint8), [])
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    whole = 4 * math.prod(ramp.shape)
    assert peak - math.prod(ramp.shape) < whole / 5
    data, sigma, _, _ = read_map(path)
    for found in (data, sigma):
        np.testing.assert_array_equal(found, ramp.read((0, ramp.shape[0])))


def test_altered_and_cut_products_are_seen(product: Path) -> None:
    body = product.read_bytes()
    assert is_whole(product)
    rng = np.random.default_rng(5)
    for bit in rng.choice(8 * len(body), 300, replace=False):
        flip(product, int(bit))
        assert not is_whole(product)
        with pytest.raises(DamagedError, match=r"delta_x\.fits"):
            read_map(product)
        product.write_bytes(body)
    for size in range(0, len(body), 288):
        product.write_bytes(body[:size])
        assert not is_whole(product)
    product.unlink()
    assert not is_whole(product)


# Arrays in the making


def test_metadata_of_an_unfinished_array_are_not_trusted(tmp_path: Path) -> None:
    attrs = {"scale_factor": 1.25}
    for name in ("whole", "altered"):
        made = create_array(tmp_path / name, (4,), "u2", dims=["t"], chunks=(2,), attrs=attrs)
        made.write((0,), np.array([1, 2], "u2"))
    file = tmp_path / "altered" / "zarr.json"
    file.write_text(file.read_text().replace("1.25", "1.35"))
    for name in ("whole", "altered"):
        made = create_array(tmp_path / name, (4,), "u2", dims=["t"], chunks=(2,), attrs=attrs)
        made.write((2,), np.array([3, 4], "u2"))
        made.finish()
        reader = ArrayReader(tmp_path / name)
        assert reader.attrs == attrs
        np.testing.assert_array_equal(reader.read(), [1, 2, 3, 4])


def test_metadata_altered_while_chunks_are_written_are_not_sealed(tmp_path: Path) -> None:
    made = create_array(tmp_path / "a", (2,), "u2", dims=["t"], chunks=(2,), attrs={"gain": 1.5})
    made.write((0,), np.array([1, 2], "u2"))
    file = tmp_path / "a" / "zarr.json"
    file.write_text(file.read_text().replace("1.5", "1.7"))
    made.finish()
    with pytest.raises(DamagedError, match="altered"):
        ArrayReader(tmp_path / "a")
