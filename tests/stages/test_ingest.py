"""Ingest: exact values, whatever the files, the tiling, the workers or the interruptions."""

import errno
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
import pytest
import zarr
from astropy.io import fits
from numpy.typing import NDArray

from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError, PlanError
from pixcal.stages.ingest import headers, reading
from pixcal.stages.ingest import stage as ingest
from pixcal.stages.reduce.ingested import Ingested
from pixcal.storage import frame_decoding, frames
from pixcal.storage.cube import ArrayWriter
from pixcal.storage.sources import SourceFile

YAML = """\
schema: pixcal/acquisition/1
detector: {{pitch_um: 4.4, gain_e_per_adu: 1.0, read_noise_e: 16.0}}
optics: {{wavelength_nm: 632.8, distance_mm: 400.0, frame_period_s: {period}}}
frames:
  bias: {bias}
  flat: {flat}
  fringes:
    - {{name: vertical, files: {vertical}, baseline_mm: [6.0, 0.0]}}
"""
SYNC = Runtime(cluster="sync")


def describe(folder: Path, period: float | None = 0.14, **globs: list[str]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    text = YAML.format(
        period="null" if period is None else period,
        bias=json.dumps(globs.get("bias", []), ensure_ascii=False),
        flat=json.dumps(globs.get("flat", []), ensure_ascii=False),
        vertical=json.dumps(globs.get("vertical", ["v/*"]), ensure_ascii=False),
    )
    (folder / "acquisition.yaml").write_text(text, encoding="utf-8")
    return folder


def noise(shape: tuple[int, ...], seed: int = 0) -> NDArray[np.uint16]:
    return np.random.default_rng(seed).integers(0, 65536, shape, "u2")


def save(path: Path, data: NDArray[Any], **cards: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    hdu = fits.CompImageHDU(data) if path.suffix == ".fz" else fits.PrimaryHDU(data)
    for key, value in cards.items():
        hdu.header[key.replace("_", "-")] = value
    hdu.writeto(path, overwrite=True)


def save_frames(folder: Path, data: NDArray[Any], name: str = "f{}.fits") -> None:
    for number, frame in enumerate(data):
        save(folder / name.format(number), frame, EXPTIME=0.1)


def read(out: Path, array: str = "fringes/vertical") -> NDArray[Any]:
    return Ingested(out / "ingest").arrays[array].read()


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture(scope="module")
def frames_70(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Written once, copied for each test."""
    folder = tmp_path_factory.mktemp("frames")
    save_frames(folder, noise((70, 67, 131)))
    return folder


@pytest.fixture
def acquisition(tmp_path: Path, frames_70: Path) -> Path:
    """70 frames of 67 × 131, in a folder with a space and a letter beyond ASCII."""
    folder = describe(tmp_path / "Aufnahme für März", bias=["bias 1/*.fits"])
    shutil.copytree(frames_70, folder / "v")
    save_frames(folder / "bias 1", noise((3, 67, 131), 1), "é{}.fits")
    return folder


@pytest.mark.parametrize("copy", [False, True])
def test_artefact(acquisition: Path, tmp_path: Path, copy: bool) -> None:
    manifest = ingest.run(acquisition, tmp_path / "run", ingest.Config(copy=copy), SYNC)
    np.testing.assert_array_equal(read(tmp_path / "run"), noise((70, 67, 131)))
    np.testing.assert_array_equal(read(tmp_path / "run", "bias"), noise((3, 67, 131), 1))
    folder = tmp_path / "run/ingest"
    assert sorted(p.name for p in folder.iterdir()) == [
        "acquisition.json",
        "catalogue.zarr",
        "files.json",
        "frames.json",
        "manifest.json",
        *(["raw.zarr"] if copy else []),
    ]
    tables = json.loads((folder / "frames.json").read_text())
    assert set(tables) == {"bias", "fringes/vertical"}
    table = tables["fringes/vertical"]
    assert table["file"] == [f"v/f{n}.fits" for n in range(70)]
    assert table["time_s"] == pytest.approx(np.arange(70) * 0.14)
    assert table["exptime_s"] == [0.1] * 70
    assert table["largest_adu"] == noise((70, 67, 131)).max(axis=(1, 2)).tolist()
    assert {len(column) for column in table.values()} == {70}
    assert set(manifest.inputs) == {"bias", "fringes/vertical"}
    arrays = manifest.summary["arrays"]
    assert arrays["fringes/vertical"]["shape"] == [70, 67, 131]
    assert arrays["fringes/vertical"]["dtype"] == "uint16"
    assert arrays["fringes/vertical"]["digest"] != arrays["bias"]["digest"]
    assert manifest.summary["warnings"] == []
    catalogue = zarr.open_group(folder / "catalogue.zarr", mode="r")
    of_frame = [
        google_crc32c.value((f ^ 0x8000).astype(">u2").tobytes()) for f in noise((70, 67, 131))
    ]
    np.testing.assert_array_equal(catalogue["fringes"]["vertical"][:, 0, 0], of_frame)
    if copy:
        group = zarr.open_group(folder / "raw.zarr", mode="r")
        np.testing.assert_array_equal(group["fringes"]["vertical"][65:], noise((70, 67, 131))[65:])


@pytest.mark.parametrize("shape", [(1, 7, 5), (64, 128, 128), (65, 129, 127), (3, 600, 40)])
def test_sizes(tmp_path: Path, shape: tuple[int, int, int]) -> None:
    folder = describe(tmp_path / "acq")
    save_frames(folder / "v", noise(shape))
    ingest.run(folder, tmp_path / "run", ingest.Config(), SYNC)
    np.testing.assert_array_equal(read(tmp_path / "run"), noise(shape))


@pytest.mark.parametrize(("cluster", "copy"), [("threads", True), ("processes", False)])
def test_workers_and_bands_do_not_matter(
    tmp_path: Path, cluster: str, copy: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = describe(tmp_path / "acq")
    save_frames(folder / "v", noise((5, 700, 1000)))
    ingest.run(folder, tmp_path / "one", ingest.Config(copy=copy), SYNC)
    monkeypatch.setattr(reading, "_BAND_ROWS", (256,))
    two = Runtime(cluster=cluster, workers=2)
    ingest.run(folder, tmp_path / "two", ingest.Config(copy=copy), two)
    assert tree(tmp_path / "one/ingest") == tree(tmp_path / "two/ingest")


def test_memory_too_small_is_refused_with_both_numbers(acquisition: Path, tmp_path: Path) -> None:
    with pytest.raises(PlanError, match=r"needs \d+ MiB, but the limit is 100 MiB"):
        ingest.run(acquisition, tmp_path / "r", ingest.Config(), Runtime(memory=100 << 20))


@pytest.mark.parametrize("name", ["c{}.fits", "c{}.fits.gz", "c{}.fz"])
def test_cubes_that_straddle_blocks(tmp_path: Path, name: str) -> None:
    """Cubes of 10, 50, 70 and 40 planes, ordered by time stamp against their names."""
    data = noise((170, 11, 13))
    folder = describe(tmp_path / "acq", period=None)
    for n, (a, b) in enumerate(pairwise([0, 10, 60, 130, 170])):
        stamp = 60000 + a / 86400
        save(folder / "v" / name.format(9 - n), data[a:b], MJD_OBS=stamp, EXPTIME=1.0)
    manifest = ingest.run(folder, tmp_path / "run", ingest.Config(), Runtime(workers=2))
    np.testing.assert_array_equal(read(tmp_path / "run"), data)
    table = json.loads((tmp_path / "run/ingest/frames.json").read_text())["fringes/vertical"]
    assert table["time_s"] == pytest.approx(np.arange(170), abs=1e-5)
    assert table["plane"][58:62] == [48, 49, 0, 1]
    assert table["time_source"][9:12] == ["exptime_s", "header", "exptime_s"]
    assert "do not follow the file names" in manifest.summary["warnings"][0]


def test_mixed_containers_and_types(tmp_path: Path) -> None:
    folder = describe(tmp_path / "acq")
    data = noise((66, 67, 31))
    for n, frame in enumerate(data):
        frame = frame if n % 2 else (frame // 2).astype("i2")
        save(folder / f"v/f{n}{('.fits', '.fits.gz', '.fz')[n % 3]}", frame)
    ingest.run(folder, tmp_path / "run", ingest.Config(), Runtime(workers=2))
    found = read(tmp_path / "run")
    assert found.dtype == np.int32
    np.testing.assert_array_equal(found[1::2], data[1::2])
    np.testing.assert_array_equal(found[::2], data[::2] // 2)


def test_types_without_a_common_one(tmp_path: Path) -> None:
    folder = describe(tmp_path / "acq")
    save(folder / "v/a.fits", np.zeros((7, 5), "i4"))
    save(folder / "v/b.fits", np.zeros((7, 5), "f4"))
    with pytest.raises(InputError, match=r"b\.fits: float32 .*a\.fits .*int32"):
        ingest.run(folder, tmp_path / "run", ingest.Config(), SYNC)


def test_not_a_number_stays(tmp_path: Path) -> None:
    data = noise((3, 7, 5)).astype("f4")
    data[1, 2, 3], data[2, 0, 0] = np.nan, np.inf
    folder = describe(tmp_path / "acq")
    save_frames(folder / "v", data)
    ingest.run(folder, tmp_path / "run", ingest.Config(), SYNC)
    np.testing.assert_array_equal(read(tmp_path / "run"), data)


@pytest.mark.parametrize("name", ["f{}.fits", "f{}.fits.gz"])
def test_every_frame_is_read_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    folder = describe(tmp_path / "acq")
    save_frames(folder / "v", noise((70, 300, 20)), name)
    read_bytes, unpacked = [], []
    monkeypatch.setattr(
        frame_decoding, "_read_exactly", counted(frame_decoding._read_exactly, read_bytes)
    )
    monkeypatch.setattr(frame_decoding, "unpack", counted(frame_decoding.unpack, unpacked))
    ingest.run(folder, tmp_path / "run", ingest.Config(), SYNC)
    assert sum(call[2].nbytes for call in read_bytes) == 70 * 300 * 20 * 2
    assert len(unpacked) == (70 if name.endswith("gz") else 0)
    assert not list(tmp_path.rglob("scratch*"))


def counted(function: Callable[..., Any], calls: list[Any]) -> Callable[..., Any]:
    def call(*args: Any) -> Any:
        calls.append(args)
        return function(*args)

    return call


# Skipped, resumed, refused


def test_up_to_date_is_skipped(
    acquisition: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    monkeypatch.setattr(headers, "run_tasks", None)
    moved = acquisition.rename(tmp_path / "moved")
    with pytest.raises(InputError, match=r"the frames of .* are gone; run 'pixcal"):
        read(tmp_path / "run")
    second = ingest.run(moved, tmp_path / "run", ingest.Config(overwrite=True), SYNC)
    assert second.key == first.key
    np.testing.assert_array_equal(read(tmp_path / "run"), noise((70, 67, 131)))


@pytest.mark.quick(1)
@pytest.mark.parametrize("name", ["f{}.fits", "f{}.fits.gz"])
@pytest.mark.parametrize("copy", [False, True])
def test_resumed_after_a_kill(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, copy: bool
) -> None:
    folder, config = describe(tmp_path / "acq"), ingest.Config(copy=copy)
    save_frames(folder / "v", noise((150, 20, 140)), name)
    ingest.run(folder, tmp_path / "whole", config, SYNC)
    write = ArrayWriter.write
    written: list[tuple[str, int]] = []

    def killed(self: ArrayWriter, start: tuple[int, ...], data: NDArray[Any]) -> None:
        if len(written) == 2:
            # In the middle of the block: a chunk may be there, and another is half written.
            if self.shape[1:] == (20, 140):
                write(self, start, data[:, :, :128])
            half = self.path / f"c/{start[0] // self.chunks[0]}/0/.0.aside"
            half.parent.mkdir(parents=True, exist_ok=True)
            half.write_bytes(b"half")
            raise KeyboardInterrupt
        resumed(self, start, data)

    def resumed(self: ArrayWriter, start: tuple[int, ...], data: NDArray[Any]) -> None:
        written.append(("raw" if self.shape[1:] == (20, 140) else "facts", start[0]))
        write(self, start, data)

    monkeypatch.setattr(ArrayWriter, "write", killed)
    with pytest.raises(KeyboardInterrupt):
        ingest.run(folder, tmp_path / "run", config, SYNC)
    assert not (tmp_path / "run/ingest").exists()
    monkeypatch.setattr(ArrayWriter, "write", resumed)
    ingest.run(folder, tmp_path / "run", config, SYNC)
    if copy or name.endswith("gz"):
        assert written == [(of, t) for t in (0, 64, 128) for of in ("raw", "facts")]
    else:
        assert written == [("facts", t) for t in range(0, 150, 16)]
    assert tree(tmp_path / "whole/ingest") == tree(tmp_path / "run/ingest")
    assert not list((tmp_path / "run/.partial").iterdir())


def test_another_acquisition_is_refused(tmp_path: Path) -> None:
    run, folder = tmp_path / "run", describe(tmp_path / "acq")
    save_frames(folder / "v", noise((3, 7, 5)))
    first = ingest.run(folder, run, ingest.Config(), SYNC)
    other = noise((1, 7, 5))[0] + np.uint16(9)
    save(folder / "v/f2.fits", other)
    with pytest.raises(InputError) as caught:
        ingest.run(folder, run, ingest.Config(), SYNC)
    for word in (str(run / "ingest"), "changed: fringes/vertical", "--out", "--overwrite"):
        assert word in str(caught.value)
    assert "acquisition.yaml" not in str(caught.value)
    describe(folder, period=0.15)
    with pytest.raises(InputError, match=r"\(changed: fringes/vertical, acquisition\.yaml\)"):
        ingest.run(folder, run, ingest.Config(), SYNC)
    second = ingest.run(folder, run, ingest.Config(overwrite=True), SYNC)
    assert (read(run)[2] == other).all()
    digests = [m.summary["arrays"]["fringes/vertical"]["digest"] for m in (first, second)]
    assert digests[0] != digests[1]


def test_another_format_is_made_anew(
    acquisition: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ingest, "STAGE", replace(ingest.STAGE, format=1))
        ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    ingest.run(acquisition, tmp_path / "fresh", ingest.Config(), SYNC)
    assert tree(tmp_path / "run/ingest") == tree(tmp_path / "fresh/ingest")


@pytest.mark.parametrize("name", ["f{}.fits", "f{}.fits.gz"])
def test_copied_when_asked_for_later(tmp_path: Path, name: str) -> None:
    """And then nothing needs the files any more; what is a copy stays one."""
    folder, run = describe(tmp_path / "acq"), tmp_path / "run"
    save_frames(folder / "v", noise((5, 67, 131)), name)
    first = ingest.run(folder, run, ingest.Config(), SYNC)
    assert (run / "ingest/raw.zarr").exists() is name.endswith("gz")
    second = ingest.run(folder, run, ingest.Config(copy=True), SYNC)
    assert second.key == first.key
    assert ingest.run(folder, run, ingest.Config(), SYNC) == second
    shutil.rmtree(folder)
    np.testing.assert_array_equal(read(run), noise((5, 67, 131)))


def test_run_and_frames_moved_together(acquisition: Path, tmp_path: Path) -> None:
    ingest.run(acquisition, acquisition / "run", ingest.Config(), SYNC)
    moved = acquisition.rename(tmp_path / "moved")
    np.testing.assert_array_equal(read(moved / "run"), noise((70, 67, 131)))


@pytest.mark.parametrize(
    ("rows", "columns"), [((0, 67), (0, 131)), ((3, 20), (128, 131)), ((66, 67), (0, 1))]
)
def test_any_block_is_read(
    acquisition: Path, tmp_path: Path, rows: tuple[int, int], columns: tuple[int, int]
) -> None:
    ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    block = Ingested(tmp_path / "run/ingest").arrays["fringes/vertical"].read((3, 9), rows, columns)
    np.testing.assert_array_equal(block, noise((70, 67, 131))[3:9, slice(*rows), slice(*columns)])


def test_frame_that_changed_since_is_named(acquisition: Path, tmp_path: Path) -> None:
    """By its time, its size, or its bytes alone; only where it is read."""
    ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    array = Ingested(tmp_path / "run/ingest").arrays["fringes/vertical"]
    file = acquisition / "v/f3.fits"
    body, facts = bytearray(file.read_bytes()), file.stat()
    body[2880 + 777] ^= 4
    file.write_bytes(body)
    with pytest.raises(InputError, match=r"v/f3\.fits: changed since it was ingested"):
        array.read()
    os.utime(file, ns=(facts.st_atime_ns, facts.st_mtime_ns))
    with pytest.raises(InputError, match=r"v/f3\.fits: its contents differ"):
        array.read()
    array.read((4, 70))
    file.unlink()
    with pytest.raises(InputError, match=r"v/f3\.fits: cannot be read"):
        array.read()


def test_file_changed_while_read(
    acquisition: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = ArrayWriter.write

    def disturbed(self: ArrayWriter, start: tuple[int, ...], data: NDArray[Any]) -> None:
        write(self, start, data)
        os.utime(acquisition / "v/f3.fits", (1, 1))

    monkeypatch.setattr(ArrayWriter, "write", disturbed)
    with pytest.raises(InputError, match=r"v/f3\.fits: changed while it was being read"):
        ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    assert not (tmp_path / "run/ingest").exists()


def test_file_written_to_while_read_is_not_noted_as_done(
    acquisition: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Put back with its own time, the file looks as ever: what was read of it must be forgotten."""
    file, read_exactly = acquisition / "v/f3.fits", frame_decoding._read_exactly
    body, facts = file.read_bytes(), file.stat()

    def disturbed(handle: Any, start: int, raw: NDArray[Any], path: Path) -> None:
        if path == file:
            file.write_bytes(body[::-1])
        read_exactly(handle, start, raw, path)

    with monkeypatch.context() as patch:
        patch.setattr(frame_decoding, "_read_exactly", disturbed)
        with pytest.raises(InputError, match=r"v/f3\.fits: changed while it was being read"):
            ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    (journal,) = (tmp_path / "run").glob(".partial/*/journal.jsonl")
    assert "vertical 0:64" not in journal.read_text()
    file.write_bytes(body)
    os.utime(file, ns=(facts.st_atime_ns, facts.st_mtime_ns))
    ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    np.testing.assert_array_equal(read(tmp_path / "run"), noise((70, 67, 131)))


def test_chunk_that_vanished_does_not_block_the_next_run(
    acquisition: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish = ArrayWriter.finish

    def vanished(self: ArrayWriter) -> None:
        (self.path / "c/0/0/0").unlink()
        finish(self)

    monkeypatch.setattr(ArrayWriter, "finish", vanished)
    with pytest.raises(InputError, match="chunk missing"):
        ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    monkeypatch.setattr(ArrayWriter, "finish", finish)
    ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)
    np.testing.assert_array_equal(read(tmp_path / "run"), noise((70, 67, 131)))


def test_full_disk_is_told(
    acquisition: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(ArrayWriter, "write", full)
    with pytest.raises(OSError, match="No space left"):
        ingest.run(acquisition, tmp_path / "run", ingest.Config(), SYNC)


# Something changed since: only that is read


@pytest.fixture
def bench(tmp_path: Path, frames_70: Path) -> Path:
    """Numbered biases, flats in cubes with time stamps and temperatures, 70 fringe frames."""
    folder = describe(tmp_path / "acq", **GLOBS)
    save_frames(folder / "bias", noise((3, 67, 131), 1))
    for n, name in enumerate(["c.fits", "b.fits.gz", "a.fz"]):
        cards = {"MJD_OBS": 60000 + n / 7e3, "EXPTIME": 0.1 + n / 3, "CCD_TEMP": -10 - n / 7}
        save(folder / "flat" / name, noise((3 + n, 67, 131), 2 + n), **cards)
    shutil.copytree(frames_70, folder / "v")
    return folder


GLOBS = {"bias": ["bias/*"], "flat": ["flat/*"], "vertical": ["v/*"]}


def a_gain(folder: Path) -> None:
    text = (folder / "acquisition.yaml").read_text()
    (folder / "acquisition.yaml").write_text(
        text.replace("gain_e_per_adu: 1.0", "gain_e_per_adu: 2")
    )


def a_period(folder: Path) -> None:
    describe(folder, period=0.31, **GLOBS)


def no_period(folder: Path) -> None:
    describe(folder, period=None, **GLOBS)


def a_name(folder: Path) -> None:
    text = (folder / "acquisition.yaml").read_text()
    (folder / "acquisition.yaml").write_text(text.replace("name: vertical", "name: across"))


def a_glob(folder: Path) -> None:
    describe(folder, **GLOBS | {"vertical": ["v/f?.fits", "v/f??.fits"]})


def one_bias_more(folder: Path) -> None:
    save(folder / "bias/g.fits", noise((67, 131), 9).astype("f4"))


def a_flat(folder: Path) -> None:
    save(folder / "flat/c.fits", noise((67, 131), 9), EXPTIME=7.0)


def no_bias(folder: Path) -> None:
    describe(folder, **GLOBS | {"bias": []})


def a_touched_frame(folder: Path) -> None:
    os.utime(folder / "v/f69.fits", (1, 1))


CHANGES: list[tuple[Callable[[Path], None], str]] = [
    (a_gain, ""),
    (a_period, ""),
    (no_period, ""),
    (a_name, ""),
    (a_glob, ""),
    (no_bias, ""),
    (one_bias_more, "bias"),
    (a_flat, "flat"),
    (a_touched_frame, "v"),
]


@pytest.mark.quick(3)
@pytest.mark.parametrize(("change", "folder_read"), CHANGES)
def test_only_what_changed_is_read(
    bench: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    change: Callable[[Path], None],
    folder_read: str,
) -> None:
    """And the result is that of a fresh ingest, to the bit."""
    run, fresh = tmp_path / "run", tmp_path / "fresh"
    before = ingest.run(bench, run, ingest.Config(), SYNC)
    change(bench)
    opened: list[Any] = []
    with monkeypatch.context() as patch:
        patch.setattr(SourceFile, "open", counted(SourceFile.open, opened))
        after = ingest.run(bench, run, ingest.Config(), SYNC)
    assert {call[0].name for call in opened} == set(changed_files(bench, folder_read))
    assert ingest.run(bench, fresh, ingest.Config(), SYNC) == after
    assert tree(run / "ingest") == tree(fresh / "ingest")
    assert after.key != before.key
    assert not list((run / ".partial").iterdir())
    monkeypatch.setattr("pixcal.storage.stage.build", None)
    assert ingest.run(bench, run, ingest.Config(), SYNC) == after


def changed_files(bench: Path, folder: str) -> list[str]:
    return [f"{folder}/{p.name}" for p in (bench / folder).iterdir()] if folder else []


@pytest.mark.parametrize(
    ("links", "cluster"), [(True, "threads"), (True, "processes"), (False, "threads")]
)
def test_chunks_are_linked_or_else_copied(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool, cluster: str
) -> None:
    run = tmp_path / "run"
    ingest.run(bench, run, ingest.Config(copy=True), SYNC)
    chunk = run / "ingest/raw.zarr/fringes/vertical/c/1/0/1"
    inode, content = chunk.stat().st_ino, tree(run / "ingest/raw.zarr")
    a_gain(bench)
    if not links:
        monkeypatch.setattr(Path, "hardlink_to", without_links)
    ingest.run(bench, run, ingest.Config(copy=True), Runtime(cluster=cluster, workers=2))
    assert (chunk.stat().st_ino == inode) is links
    assert chunk.stat().st_nlink == 1
    assert tree(run / "ingest/raw.zarr") == content


def without_links(*_: Any) -> None:
    raise OSError(errno.EPERM, "Operation not permitted")


def test_copies_that_fill_the_disk_are_told(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ingest.run(bench, tmp_path / "run", ingest.Config(), SYNC)
    a_gain(bench)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "hardlink_to", without_links)
    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space left"):
        ingest.run(bench, tmp_path / "run", ingest.Config(), SYNC)


@pytest.mark.quick(2)
@pytest.mark.parametrize(
    "damage", ["missing", "cut", "altered", "facts", "tables", "planes", "files"]
)
def test_damaged_arrays_are_read_again(bench: Path, tmp_path: Path, damage: str) -> None:
    run, fresh = tmp_path / "run", tmp_path / "fresh"
    config = ingest.Config(copy=damage in ("missing", "cut", "altered"))
    ingest.run(bench, run, config, SYNC)
    chunk = run / "ingest/raw.zarr/fringes/vertical/c/1/0/1"
    tables = run / "ingest/frames.json"
    if damage == "missing":
        chunk.unlink()
    elif damage == "cut":
        os.truncate(chunk, chunk.stat().st_size - 5)
    elif damage == "altered":
        chunk.write_bytes(chunk.read_bytes()[:-1] + b"?")
    elif damage == "facts":
        facts = run / "ingest/catalogue.zarr/fringes/vertical/c/1/0/0"
        facts.write_bytes(facts.read_bytes()[:-1] + b"?")
    elif damage == "files":
        os.truncate(run / "ingest/files.json", 1000)
    elif damage == "tables":
        os.truncate(tables, 1000)
    else:
        tables.write_text(tables.read_text().replace("v/f69.fits", "v/f68.fits"))
    a_gain(bench)
    ingest.run(bench, run, config, SYNC)
    ingest.run(bench, fresh, config, SYNC)
    assert tree(run / "ingest") == tree(fresh / "ingest")


def test_array_in_another_order_is_read_again(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As an older pixcal might have left it: f10 before f2."""
    with monkeypatch.context() as patch:
        patch.setattr(frames, "natural_key", str)
        ingest.run(bench, tmp_path / "run", ingest.Config(), SYNC)
    a_gain(bench)
    ingest.run(bench, tmp_path / "run", ingest.Config(), SYNC)
    np.testing.assert_array_equal(read(tmp_path / "run"), noise((70, 67, 131)))


@pytest.mark.parametrize("moment", ["linking", "reading"])
def test_taking_over_resumed_after_a_kill(
    bench: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    run, fresh = tmp_path / "run", tmp_path / "fresh"
    config = ingest.Config(copy=True)
    ingest.run(bench, run, config, SYNC)
    before = tree(run / "ingest")
    save_frames(bench / "bias", noise((130, 67, 131), 5))
    link, write = Path.hardlink_to, ArrayWriter.write
    linked: list[Any] = []
    written: list[Any] = []

    def killed_after(calls: list[Any], count: int, call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapped(*args: Any) -> None:
            if len(calls) == count:
                raise KeyboardInterrupt
            calls.append(args)
            call(*args)

        return wrapped

    with monkeypatch.context() as patch:
        patch.setattr(
            Path, "hardlink_to", killed_after(linked, 4 if moment == "linking" else -1, link)
        )
        patch.setattr(ArrayWriter, "write", killed_after(written, 2, write))
        with pytest.raises(KeyboardInterrupt):
            ingest.run(bench, run, config, SYNC)
    assert tree(run / "ingest") == before
    monkeypatch.setattr(Path, "hardlink_to", counted(link, linked))
    monkeypatch.setattr(ArrayWriter, "write", counted(write, written))
    ingest.run(bench, run, config, SYNC)
    # The chunks of 12 flats and 70 fringe frames, each once, and of their catalogues.
    assert len(linked) == (2 + 4) + (1 + 5)
    raw = [call[1][0] for call in written if call[0].dtype == np.uint16]
    assert raw == [0, 64, 128]
    monkeypatch.undo()
    ingest.run(bench, fresh, config, SYNC)
    assert tree(run / "ingest") == tree(fresh / "ingest")
    assert not list((run / ".partial").iterdir())


def test_new_frames_of_another_size_leave_the_old_artefact(bench: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    ingest.run(bench, run, ingest.Config(), SYNC)
    before = tree(run / "ingest")
    save(bench / "bias/g.fits", noise((67, 130)))
    with pytest.raises(InputError, match=r"bias/g\.fits: frames of 130 × 67"):
        ingest.run(bench, run, ingest.Config(), SYNC)
    assert tree(run / "ingest") == before


# Bad files, found before anything is read


@pytest.fixture
def nothing_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("data were read")

    monkeypatch.setattr(reading, "_write_piece", refuse)


def refused(acquisition: Path, out: Path) -> str:
    with pytest.raises(InputError) as caught:
        ingest.run(acquisition, out, ingest.Config(), Runtime(workers=2))
    assert "\n" not in str(caught.value)
    return str(caught.value)


@pytest.mark.usefixtures("nothing_is_read")
def test_bad_files_are_named_first(acquisition: Path, tmp_path: Path) -> None:
    path = acquisition / "v/f69.fits"
    path.write_bytes(path.read_bytes()[:9000])
    assert f"{path}: cut short: 9000 bytes" in refused(acquisition, tmp_path / "run")
    other = acquisition / "v/f8.fits"
    other.write_text("not an image")
    message = refused(acquisition, tmp_path / "run")
    assert "(1 more bad files)" in message


@pytest.mark.usefixtures("nothing_is_read")
def test_frames_of_another_size(acquisition: Path, tmp_path: Path) -> None:
    save(acquisition / "bias 1/é1.fits", noise((67, 130)))
    message = refused(acquisition, tmp_path / "run")
    for word in ("bias 1/é1.fits", "130 × 67", "131 × 67"):
        assert word in message


@pytest.mark.usefixtures("nothing_is_read")
def test_missing_acquisition(tmp_path: Path) -> None:
    assert "acquisition.yaml" in refused(tmp_path / "none", tmp_path / "run")
    assert not (tmp_path / "run").exists()


PEAK = """
import re, sys
from pathlib import Path
from pixcal.engine.run import Runtime
from pixcal.stages.ingest import stage as ingest
ingest.run(Path(sys.argv[1]), Path(sys.argv[2]), ingest.Config(), Runtime(workers=2, memory=MEMORY))
# VmHWM, not ru_maxrss, which begins at the peak of the process that started this one.
print(int(re.search(r"VmHWM:\\s+(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024)
"""


@pytest.mark.long
def test_peak_memory_keeps_to_what_is_allowed(tmp_path: Path) -> None:
    """A set larger than the memory allowed goes through it, frame by frame and as a cube."""
    memory = 440 << 20
    folder = describe(tmp_path / "acq")
    cube = folder / "v/a.fits"
    cube.parent.mkdir(parents=True)
    header = fits.Header({"SIMPLE": True, "BITPIX": 16, "NAXIS": 3})
    header.update({"NAXIS1": 1024, "NAXIS2": 1024, "NAXIS3": 224})
    with cube.open("wb") as file:
        file.write(header.tostring().encode())
        file.truncate(file.tell() + 224 * 1024 * 1024 * 2)
    save(folder / "v/b.fits", noise((1024, 1024)).astype("i2"))
    code = PEAK.replace("MEMORY", str(memory))
    result = subprocess.run(
        [sys.executable, "-c", code, str(folder), str(tmp_path / "run")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert int(result.stdout) < memory < cube.stat().st_size
