"""Runs whose cubes lie in an object store: the same results, resumed, refused when damaged."""

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import yaml
import zarr
from astropy.io import fits

from pixcal.engine import run as local_engine
from pixcal.engine.run import Runtime
from pixcal.model.errors import InputError, RemoteError
from pixcal.stages import fit, ingest, reduce
from pixcal.storage.cube import ArrayWriter
from pixcal.storage.cube_place import POINTER, base_of, cubes_of
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.sources import SourceFile
from pixcal_cli.main import invoke

SYNC = Runtime(cluster="sync")
PIXCAL = Path(sys.executable).with_name("pixcal")


@pytest.fixture(scope="module")
def night(make_bench: Callable[..., Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An acquisition of one fringe set: two columns of three chunks."""
    bench = make_bench(shape=(61, 135), frames=140, n_bias=9, seed=5)
    bench.sets = {"vertical": bench.sets["vertical"]}
    written: Path = bench.write(tmp_path_factory.mktemp("night"))
    return written


@pytest.fixture(scope="module")
def local(night: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The run with its cubes at home."""
    run = tmp_path_factory.mktemp("local") / "run"
    ingest.run(night, run, ingest.Config(copy=True), SYNC)
    reduce.run(run, reduce.Config(), SYNC)
    fit.run(run, fit.Config(), SYNC)
    return run


def at(bucket: Any, run: Path, stage: str) -> str:
    """Key of the folder with the cubes of a stage."""
    return str(cubes_of(run / stage)).removeprefix(f"{bucket.url}/") + "/"


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def same_but_for_the_cubes(bucket: Any, run: Path, local: Path, stage: str) -> None:
    """All that an artefact holds is what it holds at home, here or at the URL."""
    here, there = tree(run / stage), bucket.tree(at(bucket, run, stage))
    home = tree(local / stage)
    del here[POINTER], there["pixcal.json"]
    assert not here.keys() & there.keys()
    ours, theirs = (json.loads(files.pop("manifest.json")) for files in (here, home))
    for manifest in (ours, theirs):
        # It lists the files beside it, and where the frames are from the run.
        del manifest["files"], manifest["seal"]
        manifest["summary"].pop("acquisition", None)
    assert ours == theirs
    assert here | there == home
    assert any("/c/" in name for name in there)


@pytest.fixture(
    params=["threads", *(pytest.param(p, marks=pytest.mark.long) for p in ("processes", "cluster"))]
)
def runtime(request: pytest.FixtureRequest) -> Runtime:
    if request.param == "cluster":
        found: Runtime = request.getfixturevalue("dask_cluster")
        return found
    # Those kept from earlier tests began without the credentials of the bucket.
    local_engine._process_pool.cache_clear()
    return Runtime(request.param, workers=2)


@pytest.mark.long
def test_results_are_those_of_a_run_at_home(
    night: Path, local: Path, bucket: Any, tmp_path: Path, runtime: Runtime
) -> None:
    run = tmp_path / "run"
    ingest.run(night, run, ingest.Config(copy=True, cubes=f"{bucket.url}/a/b"), runtime)
    reduce.run(run, reduce.Config(), runtime)
    fit.run(run, fit.Config(), runtime)
    for stage in ("ingest", "reduce"):
        assert str(cubes_of(run / stage)).startswith(f"{bucket.url}/a/b/{stage}-")
        same_but_for_the_cubes(bucket, run, local, stage)
    ours, theirs = (json.loads((r / "products/fit.json").read_text()) for r in (run, local))
    for found in (ours, theirs):
        for key in ("chunks_read", "passes"):
            # Other processes do not share what one of them keeps.
            found["sets"]["vertical"].pop(key)
    assert ours == theirs
    with (
        fits.open(run / "products/delta_fringe.fits") as a,
        fits.open(local / "products/delta_fringe.fits") as b,
    ):
        for ours, theirs in zip(a, b, strict=True):
            assert ours.data.tobytes() == theirs.data.tobytes()


@pytest.fixture(scope="module")
def store(make_bucket: Callable[[], Any]) -> Any:
    """The bucket of `far`."""
    return make_bucket()


@pytest.fixture(scope="module")
def far(night: Path, store: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run, ingested and reduced, with its cubes in `store`."""
    run = tmp_path_factory.mktemp("far") / "run"
    ingest.run(night, run, ingest.Config(copy=True, cubes=f"{store.url}/x"), SYNC)
    reduce.run(run, reduce.Config(), SYNC)
    return run


@pytest.fixture
def ingested(far: Path, tmp_path: Path) -> Path:
    """A copy of `far` that is to be reduced."""
    shutil.copytree(far / "ingest", tmp_path / "run" / "ingest")
    return tmp_path / "run"


@pytest.mark.long
def test_others_open_the_url(far: Path, local: Path) -> None:
    raw = zarr.open_array(store=f"{cubes_of(far / 'ingest')}/raw.zarr/fringes/vertical", mode="r")
    home = ArrayReader(local / "ingest/raw.zarr/fringes/vertical").read()
    np.testing.assert_array_equal(raw[:], home)
    url = f"{cubes_of(far / 'reduce')}/reduced.zarr/vertical"
    there = xarray.open_zarr(url, consolidated=False)
    here = xarray.open_zarr(local / "reduce/reduced.zarr/vertical", consolidated=False)
    xarray.testing.assert_identical(there.load(), here.load())


RAW, SIGNAL = "raw.zarr/fringes/vertical", "reduced.zarr/vertical/signal"


@pytest.mark.quick(1)
@pytest.mark.parametrize("damage", ["missing", "altered"])
@pytest.mark.parametrize("file", ["c/1/0/1", "zarr.json"])
@pytest.mark.parametrize(("stage", "array"), [("ingest", RAW), ("reduce", SIGNAL)])
def test_damage_is_refused(
    far: Path,
    store: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    damage: str,
    file: str,
    stage: str,
    array: str,
) -> None:
    shutil.copytree(far, tmp_path / "run")
    key = f"{at(store, far, stage)}{array}/{file}"
    body = store.get(key)
    if damage == "missing":
        store.delete(key)
    else:
        store.put(key, body[:50] + bytes([body[50] ^ 1]) + body[51:])
    url = f"{store.url}/{at(store, far, stage)}{array}"
    if stage == "ingest":
        shutil.rmtree(tmp_path / "run/reduce")
    code = invoke(["reduce" if stage == "ingest" else "fit", str(tmp_path / "run"), "--quiet"])
    store.put(key, body)
    assert code == 2
    told = capsys.readouterr().err
    assert told.startswith(f"pixcal: {url}")
    assert told.count("\n") == 1


class Cut:
    """Lets a number of blocks be written, then fails."""

    def __init__(self, blocks: int, error: type[BaseException]) -> None:
        self.blocks, self.error, self.write = blocks, error, ArrayWriter.write

    def __call__(self, writer: ArrayWriter, start: Any, data: Any) -> None:
        if not self.blocks:
            raise self.error("cut")
        self.blocks -= 1
        self.write(writer, start, data)


@pytest.mark.parametrize("error", [KeyboardInterrupt, RemoteError])
def test_an_ingest_cut_short_goes_on(
    night: Path,
    local: Path,
    bucket: Any,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: type[BaseException],
) -> None:
    run, config = tmp_path / "run", ingest.Config(copy=True, cubes=f"{bucket.url}/x")
    with monkeypatch.context() as patch:
        cut = Cut(2 * 3, error)  # each block, and what the catalogue holds of it
        patch.setattr(ArrayWriter, "write", lambda *args: cut(*args))
        with pytest.raises(error):
            ingest.run(night, run, config, SYNC)
    assert not (run / "ingest").exists()
    written = [key for key in bucket.keys() if "/c/" in key]  # noqa: SIM118
    assert written
    count = Cut(10**6, error)
    monkeypatch.setattr(ArrayWriter, "write", lambda *args: count(*args))
    ingest.run(night, run, config, SYNC)
    assert 10**6 - count.blocks == 2 * 1, "one of four blocks is left"
    assert set(written) < set(bucket.keys())
    assert at(bucket, run, "ingest") == written[0].partition("raw.zarr")[0]
    same_but_for_the_cubes(bucket, run, local, "ingest")


def test_an_end_that_is_cut_short_loses_no_work(
    night: Path, local: Path, bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The store fails when all is written: nothing is read again."""
    run, config = tmp_path / "run", ingest.Config(copy=True, cubes=f"{bucket.url}/x")

    def fails(_: ArrayWriter) -> None:
        raise RemoteError("cut")

    with monkeypatch.context() as patch:
        patch.setattr(ArrayWriter, "finish", fails)
        with pytest.raises(RemoteError):
            ingest.run(night, run, config, SYNC)
    monkeypatch.setattr(ArrayWriter, "write", None)
    ingest.run(night, run, config, SYNC)
    same_but_for_the_cubes(bucket, run, local, "ingest")


@pytest.mark.long
def test_a_reduction_cut_short_goes_on(
    ingested: Path, local: Path, store: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = set(store.keys())
    with monkeypatch.context() as patch:
        cut = Cut(3 + 5 + 3 + 2, KeyboardInterrupt)  # in the second column of the signal
        patch.setattr(ArrayWriter, "write", lambda *args: cut(*args))
        with pytest.raises(KeyboardInterrupt):
            reduce.run(ingested, reduce.Config(), SYNC)
    written = [key for key in store.keys() if key not in before and "/signal/c/" in key]  # noqa: SIM118
    assert written
    reduce.run(ingested, reduce.Config(), SYNC)
    assert at(store, ingested, "reduce") == written[0].partition("reduced.zarr")[0]
    same_but_for_the_cubes(store, ingested, local, "reduce")


# Where cubes are put


@pytest.mark.long
def test_where_cubes_are_is_remembered(
    night: Path,
    far: Path,
    store: Any,
    ingested: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr("pixcal.storage.stage.build", None)
        for cubes in (None, f"{store.url}/x", f"{store.url}/x/"):
            ingest.run(night, far, ingest.Config(copy=True, cubes=cubes), SYNC)
            reduce.run(far, reduce.Config(cubes=cubes), SYNC)
    run = ingested
    reduce.run(run, reduce.Config(), SYNC)
    assert base_of(run / "reduce") == base_of(far / "ingest")
    first = at(store, run, "reduce")
    reduce.run(run, reduce.Config(cubes=str(tmp_path / "y")), SYNC)
    assert base_of(run / "reduce") == tmp_path / "y"
    reduce.run(run, reduce.Config(), SYNC)
    assert base_of(run / "reduce") == tmp_path / "y", "it is up to date"
    assert not [key for key in store.keys() if key.startswith(first)]  # noqa: SIM118


@pytest.mark.long
def test_cubes_are_moved_without_the_frames(
    night: Path, local: Path, bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    shutil.copytree(local, run)
    monkeypatch.setattr(SourceFile, "open", None)
    for place in (f"{bucket.url}/x", f"{bucket.url}/y", str(tmp_path / "z"), str(run)):
        ingest.run(night, run, ingest.Config(copy=True, cubes=place), SYNC)
        assert str(cubes_of(run / "ingest")).startswith(place)
        if place.startswith("s3"):
            same_but_for_the_cubes(bucket, run, local, "ingest")
    assert tree(run / "ingest") == tree(local / "ingest")
    assert not bucket.keys()
    assert not list((tmp_path / "z").rglob("*"))


@pytest.mark.quick(1)
@pytest.mark.parametrize("damaged", [False, True])
def test_arrays_of_unchanged_files_are_copied_in_the_store(
    night: Path, bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damaged: bool
) -> None:
    acquisition, run, fresh = tmp_path / "acq", tmp_path / "run", tmp_path / "fresh"
    shutil.copytree(night, acquisition)
    ingest.run(acquisition, run, ingest.Config(copy=True, cubes=f"{bucket.url}/x"), SYNC)
    earlier = at(bucket, run, "ingest")
    if damaged:
        bucket.delete(f"{earlier}raw.zarr/fringes/vertical/c/1/0/1")
    described = yaml.safe_load((acquisition / "acquisition.yaml").read_text())
    described["detector"]["gain_e_per_adu"] = 0.5
    (acquisition / "acquisition.yaml").write_text(yaml.safe_dump(described))
    opened: list[str] = []
    look = SourceFile.open
    with monkeypatch.context() as patch:
        patch.setattr(SourceFile, "open", lambda self: opened.append(self.name) or look(self))
        ingest.run(acquisition, run, ingest.Config(copy=True), SYNC)
    assert set(opened) == ({"vertical.fits"} if damaged else set())
    ingest.run(acquisition, fresh, ingest.Config(copy=True), SYNC)
    same_but_for_the_cubes(bucket, run, fresh, "ingest")
    assert not [key for key in bucket.keys() if key.startswith(earlier)]  # noqa: SIM118


# What goes wrong


def test_frames_that_changed_meanwhile_leave_nothing_behind(
    night: Path, bucket: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def changed(source: SourceFile) -> None:
        raise InputError(f"{source.path}: changed")

    monkeypatch.setattr(SourceFile, "check_unchanged", changed)
    with pytest.raises(InputError, match="changed"):
        ingest.run(night, tmp_path / "run", ingest.Config(copy=True, cubes=f"{bucket.url}/x"), SYNC)
    assert not bucket.keys()
    assert not list((tmp_path / "run/.partial").iterdir())


def shell(*args: str, **env: str | None) -> subprocess.CompletedProcess[str]:
    """A command of the user's, told to try once only; a variable that is None is taken away."""
    # A setting of fsspec and one of AWS, both from the environment.
    patient = {"AWS_MAX_ATTEMPTS": "1", "FSSPEC_S3": '{"config_kwargs": {"connect_timeout": 1}}'}
    wanted = {**os.environ, **patient, **env}
    return subprocess.run(
        args,
        env={k: v for k, v in wanted.items() if v is not None},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


NO_CREDENTIALS = {"AWS_ACCESS_KEY_ID": None, "AWS_SECRET_ACCESS_KEY": None}


@pytest.mark.long
@pytest.mark.parametrize(
    ("place", "env", "says"),
    [
        ("s3://no-such-bucket/x", {}, "bucket does not exist"),
        ("{bucket}/x", {"AWS_ENDPOINT_URL": "http://127.0.0.1:9"}, "http://127.0.0.1:9/"),
        ("{bucket}/x", {"AWS_ENDPOINT_URL": "nonsense"}, "nonsense"),
        ("{bucket}/x", NO_CREDENTIALS, "credentials"),
        ("s3:/bucket", {}, "s3://bucket/prefix"),
        ("gs://bucket/x", {}, "gcsfs"),
    ],
)
def test_a_place_that_does_not_work_is_told_in_one_line(
    night: Path, tmp_path: Path, bucket: Any, place: str, env: dict[str, str | None], says: str
) -> None:
    place = place.format(bucket=bucket.url)
    env = {"AWS_EC2_METADATA_DISABLED": "true", "HOME": str(tmp_path)} | env
    args = [str(PIXCAL), "ingest", str(night), "--out", str(tmp_path / "run"), "--quiet"]
    found = shell(*args, "--cubes", place, **env)
    assert found.returncode == 2, found.stderr
    assert found.stderr.startswith("pixcal: --cubes ")
    assert found.stderr.count("\n") == 1
    assert says in found.stderr
    assert not bucket.keys()


def test_a_missing_package_is_told_with_what_installs_it(night: Path, tmp_path: Path) -> None:
    code = "import sys; sys.modules['s3fs'] = None; from pixcal_cli.main import main; main()"
    args = ["ingest", str(night), "--out", str(tmp_path / "run"), "--cubes", "s3://bucket/x"]
    found = shell(sys.executable, "-c", code, *args, "--quiet")
    assert found.returncode == 2
    assert found.stderr.count("\n") == 1
    assert "pip install 'pixcal[s3]'" in found.stderr


@pytest.mark.long
def test_a_store_that_vanishes_is_told_and_the_run_resumed(
    ingested: Path, local: Path, store: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    import s3fs

    reads = iter(range(10))
    original = s3fs.S3FileSystem._cat_file

    async def vanishing(self: Any, *args: Any, **options: Any) -> Any:
        if next(reads, None) is None:
            raise ConnectionError("Connection reset by peer")
        return await original(self, *args, **options)

    s3fs.S3FileSystem.clear_instance_cache()
    with monkeypatch.context() as patch:
        patch.setattr(s3fs.S3FileSystem, "_cat_file", vanishing)
        with pytest.raises(RemoteError, match=r"^s3://.*: Connection reset by peer; check"):
            reduce.run(ingested, reduce.Config(), SYNC)
        s3fs.S3FileSystem.clear_instance_cache()
    reduce.run(ingested, reduce.Config(), SYNC)
    same_but_for_the_cubes(store, ingested, local, "reduce")


def test_a_malformed_place_of_reduce_is_told(far: Path) -> None:
    with pytest.raises(InputError, match=r"--cubes s3://: no bucket"):
        reduce.run(far, reduce.Config(cubes="s3://"), SYNC)


def test_the_commands_hand_the_place_on(night: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    given = []
    for stage in ("ingest", "reduce", "fit", "allan", "report"):
        monkeypatch.setattr(f"pixcal.stages.{stage}.run", lambda *args: given.append(args[-2]))
        monkeypatch.setattr(f"pixcal_cli.results.show_{stage}", lambda run: None)
    monkeypatch.setattr("pixcal_cli.results.show_run", lambda run, fitted, diagnosed: None)
    for command in (["run", str(night), "--out"], ["ingest", str(night), "--out"], ["reduce"]):
        assert invoke([*command, "run", "--cubes", "s3://b/x"]) == 0
    told = [config.cubes for config in given if hasattr(config, "cubes")]
    assert told == ["s3://b/x"] * 4
    assert invoke(["reduce", "run"]) == 0
    assert given[-1].cubes is None


def test_a_command_says_where_the_cubes_are(
    night: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run, places = tmp_path / "run", {}
    for command in (["ingest", str(night), "--out"], ["reduce"]):
        assert invoke([*command, str(run), "--cubes", f"{tmp_path}/big", "--quiet"]) == 0
        places[command[0]] = cubes_of(run / command[0])
    shown = capsys.readouterr().out
    for stage, place in places.items():
        assert f"{stage}: {run / stage} (written)\n  cubes: {place}\n" in shown
        assert place.parent == tmp_path / "big"
