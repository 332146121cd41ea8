"""Reduce from FITS files, strip by strip: the bits of a reduction from a cube of raw samples."""

import os
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import yaml
from astropy.io import fits

from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError
from pixcal.stages import ingest, reduce, simulate
from pixcal.stages.ingest import stage as ingest_stage
from pixcal.stages.reduce import columns
from pixcal.stages.tiles import indices, strips
from pixcal.storage.manifest import list_files, read_manifest, write_manifest

SYNC = Runtime(cluster="sync")
SHAPE = (140, 300)


@pytest.fixture(scope="module")
def acquisition(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two bands of three columns; a ladder of flats whose exposure times take turns."""
    folder = tmp_path_factory.mktemp("strips")
    config = yaml.safe_load((Path(__file__).parents[1] / "bench.yaml").read_text())
    config["detector"]["shape"] = list(SHAPE)
    (folder / "bench.yaml").write_text(yaml.safe_dump(config))
    simulate.run(folder / "bench.yaml", folder / "acq", simulate.Config(), SYNC)
    return folder / "acq"


def contents(run: Path) -> dict[str, bytes]:
    files = (file for file in (run / "reduce").rglob("*") if file.is_file())
    return {
        file.relative_to(run).as_posix(): file.read_bytes()
        for file in files
        if file.name != "manifest.json"
    }


@pytest.fixture(scope="module")
def copied(acquisition: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """What is reduced from cubes of raw samples, column by column."""
    run = tmp_path_factory.mktemp("copied")
    ingest.run(acquisition, run, ingest.Config(copy=True), SYNC)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns, "SHARE", 0.0)
        reduce.run(run, reduce.Config(), SYNC)
    return contents(run)


@pytest.mark.quick(1)
@pytest.mark.parametrize("share", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("cluster", ["threads", "processes"])
def test_neither_source_nor_width_matters(
    acquisition: Path,
    copied: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    share: float,
    cluster: str,
) -> None:
    ingest.run(acquisition, tmp_path, ingest.Config(), SYNC)
    assert not (tmp_path / "ingest/raw.zarr").exists()
    monkeypatch.setattr(columns, "SHARE", share)
    reduce.run(tmp_path, reduce.Config(), Runtime(cluster=cluster, workers=2))
    assert contents(tmp_path) == copied


def test_strips_are_neighbours_within_a_row() -> None:
    every = indices(SHAPE)
    assert strips(every, 2) == [((0, 0), (0, 1)), ((0, 2),), ((1, 0), (1, 1)), ((1, 2),)]
    assert strips([(0, 0), (0, 2), (1, 0)], 9) == [((0, 0),), ((0, 2),), ((1, 0),)]


@pytest.mark.parametrize("kind", ["bias", "vertical"])
def test_file_that_changed_since_is_named(acquisition: Path, tmp_path: Path, kind: str) -> None:
    """Be it by one bit, with its own size and time; with the file restored it goes on."""
    folder, run = tmp_path / "acq", tmp_path / "run"
    shutil.copytree(acquisition, folder)
    ingest.run(folder, run, ingest.Config(), SYNC)
    file = sorted((folder / kind).iterdir())[-1]
    whole, facts = file.read_bytes(), file.stat()
    with fits.open(file) as hdus:
        assert hdus[0].data is not None
        at = hdus[0]._data_offset + hdus[0].data.nbytes - 1
    body = bytearray(whole)
    body[at] ^= 1
    file.write_bytes(body)
    with pytest.raises(InputError, match=f"{file}: changed since it was ingested"):
        reduce.run(run, reduce.Config(), SYNC)
    restore(file, body, facts.st_mtime_ns)
    with pytest.raises(InputError, match=f"{file}: its contents differ from those ingested"):
        reduce.run(run, reduce.Config(), SYNC)
    assert not (run / "reduce").exists()
    restore(file, whole, facts.st_mtime_ns)
    reduce.run(run, reduce.Config(), SYNC)


def restore(file: Path, body: bytes, mtime_ns: int) -> None:
    file.write_bytes(body)
    os.utime(file, ns=(mtime_ns, mtime_ns))


def test_run_of_the_first_format_is_read(
    acquisition: Path, copied: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A cube of raw samples, and neither catalogue nor list of files."""
    with monkeypatch.context() as patch:
        patch.setattr(ingest_stage, "STAGE", replace(ingest_stage.STAGE, format=1))
        ingest.run(acquisition, tmp_path, ingest.Config(copy=True), SYNC)
    ingested = tmp_path / "ingest"
    shutil.rmtree(ingested / "catalogue.zarr")
    (ingested / "files.json").unlink()
    manifest = read_manifest(ingested)
    assert manifest is not None
    write_manifest(ingested, replace(manifest, files=list_files(ingested)))
    reduce.run(tmp_path, reduce.Config(), SYNC)
    assert contents(tmp_path) == copied
