"""Cubes at URLs: the same objects as files of a local cube, and no damage that goes unseen."""

import itertools
import pickle
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import fsspec
import numpy as np
import pytest
import xarray
import zarr
from numpy.typing import NDArray

from pixcal.model.errors import DamagedError, InputError, RemoteError
from pixcal.storage import cube_reader, folder
from pixcal.storage.cube import INDEX, create_array, create_group, remove_arrays, write_array
from pixcal.storage.cube_reader import ArrayReader, CachedReader
from pixcal.storage.place import Place, UrlPath, parse_place

SHAPE, CHUNKS = (11, 7, 13), (4, 3, 7)
_numbers = itertools.count()


@pytest.fixture(params=["memory", "s3"])
def place(request: pytest.FixtureRequest) -> Iterator[UrlPath]:
    """A folder in an object store, and one in fsspec's memory: of either kind of file system."""
    if request.param == "s3":
        yield UrlPath(f"{request.getfixturevalue('bucket').url}/some/prefix")
        return
    yield UrlPath(f"memory://test-{next(_numbers)}")
    fsspec.filesystem("memory").store.clear()


def cube(dtype: Any = np.uint16, seed: int = 0) -> NDArray[Any]:
    return np.random.default_rng(seed).integers(0, 200, SHAPE).astype(dtype)


def write(path: Place, data: NDArray[Any], chunks: Any = CHUNKS, **options: Any) -> Place:
    writer = create_array(path, data.shape, data.dtype, chunks=chunks, **options)
    for start in range(0, len(data), chunks[0]):
        writer.write((start, 0, 0), data[start : start + chunks[0]])
    writer.finish()
    return path


def tree(path: Place) -> dict[str, bytes]:
    """Contents of the files below a folder, by a way that shares no code with the project's."""
    if isinstance(path, Path):
        return {str(p.relative_to(path)): p.read_bytes() for p in path.rglob("*") if p.is_file()}
    system, root = fsspec.core.url_to_fs(path.url)
    system.invalidate_cache()
    return {p.removeprefix(f"{root}/"): system.cat_file(p) for p in system.find(root)}


def put(path: UrlPath, content: bytes | None) -> None:
    """Replace a file, or remove it."""
    system, name = fsspec.core.url_to_fs(path.url)
    if content is None:
        system.rm_file(name)
    else:
        system.pipe_file(name, content)


@pytest.mark.quick(1)
@pytest.mark.parametrize("batch", [1, 10**9])
def test_the_objects_are_the_files_of_a_local_cube(
    place: UrlPath, tmp_path: Path, batch: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(folder, "BATCH_BYTES", batch)
    for at in (place, tmp_path / "here"):
        create_group(at / "g", {"title": "window"})
        write(at / "g" / "signal", cube(), attrs={"units": "adu"}, fill_value=7)
        write_array(at / "g" / "time", np.arange(11.0), dims=("time",), chunks=(4,))
        write_array(at / "g" / "map", cube(np.float32)[0], dims=("y", "x"), chunks=(3, 5))
    assert tree(place) == tree(tmp_path / "here")
    np.testing.assert_array_equal(ArrayReader(place / "g" / "signal").read(), cube())
    np.testing.assert_array_equal(ArrayReader(place / "g" / "time").read(), np.arange(11.0))


def test_zarr_and_xarray_open_the_url(place: UrlPath) -> None:
    create_group(place / "g")
    write(place / "g" / "signal", cube())
    write_array(place / "g" / "time", np.arange(11.0), dims=("time",))
    theirs = zarr.open_array(store=str(place / "g" / "signal"), mode="r")
    np.testing.assert_array_equal(theirs[:], cube())
    data = xarray.open_zarr(str(place / "g"), consolidated=False)
    np.testing.assert_array_equal(data["signal"], cube())
    np.testing.assert_array_equal(data["time"], np.arange(11.0))


def in_order(reader: ArrayReader) -> None:
    for n in range(3):
        reader.read_chunk((n, 1, 1))


WAYS: dict[str, Callable[[ArrayReader], Any]] = {
    "whole": ArrayReader.read,
    "one chunk": lambda reader: reader.read_chunk((2, 1, 1)),
    "read ahead": in_order,
}


@pytest.mark.quick(15)
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("damage", ["missing", "cut", "altered", "exchanged"])
def test_a_damaged_chunk_is_refused_by_its_url(place: UrlPath, damage: str, way: str) -> None:
    path = place / "a"
    write(path, cube())
    chunk = path / "c/2/1/1"
    body = chunk.read_bytes()
    instead = {
        "missing": None,
        "cut": body[:-9],
        "altered": body[:20] + bytes([body[20] ^ 4]) + body[21:],
        "exchanged": (path / "c/1/1/1").read_bytes(),
    }
    put(chunk, instead[damage])
    with pytest.raises(DamagedError) as caught:
        WAYS[way](ArrayReader(path))
    assert str(caught.value).startswith(f"{chunk}: ")
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(ArrayReader(path).read((0, 8)), cube()[:8])


@pytest.mark.parametrize("name", ["zarr.json", INDEX])
def test_damaged_metadata_are_refused_by_their_url(place: UrlPath, name: str) -> None:
    path = place / "a"
    write(path, cube())
    body = (path / name).read_bytes()
    altered = body[:-1] + bytes([body[-1] ^ 1]) if name == INDEX else body.replace(b"1", b"2")
    for content in (body[:-3], altered, None):
        put(path / name, content)
        with pytest.raises(DamagedError, match=f"{path}: not a complete array"):
            ArrayReader(path)


def test_an_array_left_unfinished_is_taken_up_again(place: UrlPath) -> None:
    writer = create_array(place / "a", SHAPE, "u2", chunks=CHUNKS)
    writer.write((0, 0, 0), cube()[:8])
    with pytest.raises(DamagedError, match=f"{place}/a: not a complete array"):
        ArrayReader(place / "a")
    with pytest.raises(DamagedError, match=f"{place}/a/c/2/0/0: chunk missing"):
        writer.finish()
    again = create_array(place / "a", SHAPE, "u2", chunks=CHUNKS)
    again.write((8, 0, 0), cube()[8:])
    put(place / "a/c/1/2/1", b"12")
    with pytest.raises(DamagedError, match=f"{place}/a/c/1/2/1: truncated chunk"):
        again.finish()
    again.write((4, 0, 0), cube()[4:8])
    again.finish()
    np.testing.assert_array_equal(ArrayReader(place / "a").read(), cube())


@pytest.mark.long
def test_writers_and_readers_travel_to_other_processes(bucket: Any) -> None:
    place = UrlPath(f"{bucket.url}/prefix")
    writer = create_array(place / "a", SHAPE, "u2", chunks=CHUNKS)
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        jobs = [pool.submit(writer.write, (n, 0, 0), cube()[n : n + 4]) for n in (0, 4, 8)]
        for job in jobs:
            job.result()
        writer.finish()
        for reader in (ArrayReader(place / "a"), CachedReader(place / "a")):
            reader.read()  # its connections stay here
            np.testing.assert_array_equal(pool.submit(reader.read).result(), cube())


# Reading ahead


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> Iterator[Counter[str]]:
    """How often each object of the store is asked for."""
    import s3fs

    asked: Counter[str] = Counter()
    original = s3fs.S3FileSystem._cat_file

    async def counted(self: Any, path: str, *args: Any, **options: Any) -> bytes:
        asked[path.partition("/c/")[2]] += 1
        content: bytes = await original(self, path, *args, **options)
        return content

    monkeypatch.setattr(s3fs.S3FileSystem, "_cat_file", counted)
    s3fs.S3FileSystem.clear_instance_cache()  # those made before do not count
    yield asked
    s3fs.S3FileSystem.clear_instance_cache()


@pytest.fixture
def long_cube(bucket: Any, fetched: Counter[str]) -> tuple[ArrayReader, NDArray[Any]]:
    """Twelve chunks in time, two side by side, of which none has been asked for."""
    data = np.random.default_rng(1).integers(0, 99, (23, 4, 6), "u2")
    reader = ArrayReader(write(UrlPath(f"{bucket.url}/a"), data, (2, 4, 3)))
    fetched.clear()
    return reader, data


def test_each_chunk_is_fetched_once_by_threads_in_order(
    long_cube: tuple[ArrayReader, NDArray[Any]], fetched: Counter[str]
) -> None:
    reader, data = long_cube
    read = np.zeros((24, 4, 6), np.uint16)

    def column(j: int) -> None:
        for n in range(12):
            read[2 * n : 2 * n + 2, :, 3 * j : 3 * j + 3] = reader.read_chunk((n, 0, j))

    threads = [threading.Thread(target=column, args=(j,)) for j in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    np.testing.assert_array_equal(read[:23], data)
    assert fetched == {f"{n}/0/{j}": 1 for n in range(12) for j in range(2)}


def test_what_follows_is_on_its_way_before_it_is_asked_for(
    long_cube: tuple[ArrayReader, NDArray[Any]], fetched: Counter[str]
) -> None:
    reader, _ = long_cube
    reader.read_chunk((3, 0, 0))
    assert set(fetched) == {"3/0/0"}, "one chunk may be all that is wanted"
    reader.read_chunk((4, 0, 0))
    assert reader._ahead is not None
    for waiting in reader._ahead.expected().values():
        assert waiting is not None
        waiting.result()
    assert fetched == {f"{n}/0/0": 1 for n in range(3, 5 + cube_reader.AHEAD)}


def test_chunks_here_and_there_are_not_read_ahead(
    long_cube: tuple[ArrayReader, NDArray[Any]], fetched: Counter[str]
) -> None:
    reader, _ = long_cube
    places = [(5, 0, 0), (5, 0, 1), (1, 0, 0), (3, 0, 0), (2, 0, 1)]
    for at in places:
        reader.read_chunk(at)
    assert fetched == {"/".join(map(str, at)): 1 for at in places}


def test_what_nobody_asks_for_is_let_go(long_cube: tuple[ArrayReader, NDArray[Any]]) -> None:
    reader, data = long_cube
    assert reader._ahead is not None
    for first in (0, 6, 3, 1, 7):
        for j in (0, 1):
            for n in (first, first + 1, first + 2):
                chunk = reader.read_chunk((n, 0, j))
                np.testing.assert_array_equal(chunk, data[2 * n : 2 * n + 2, :, 3 * j : 3 * j + 3])
                assert len(reader._ahead.expected()) <= 2 * cube_reader.AHEAD
    other = pickle.loads(pickle.dumps(reader))  # noqa: S301 (just made)
    assert not other._ahead.expected()
    np.testing.assert_array_equal(other.read(), data)


# Copies and removal


@pytest.mark.long
@pytest.mark.parametrize(("source", "target"), ["ss", "sm", "sl", "ls", "ms"])
def test_chunks_are_taken_from_any_place_to_any_other(
    bucket: Any, tmp_path: Path, source: str, target: str
) -> None:
    places: dict[str, Place] = {
        "s": UrlPath(f"{bucket.url}/x"),
        "m": UrlPath(f"memory://copies-{next(_numbers)}"),
        "l": tmp_path,
    }
    first = write(places[source] / "one", cube())
    writer = create_array(places[target] / "two", SHAPE, "u2", chunks=CHUNKS)
    writer.write((0, 0, 0), cube()[:4])  # as after a copy that was cut short
    writer.take(first)
    writer.finish()
    assert tree(writer.path) == tree(first)


def test_a_chunk_that_is_missing_at_the_source_is_told(bucket: Any) -> None:
    first = UrlPath(f"{bucket.url}/one")
    write(first, cube())
    bucket.delete("one/c/1/1/1")
    for target in (UrlPath(f"{bucket.url}/two"), UrlPath("memory://two")):
        writer = create_array(target, SHAPE, "u2", chunks=CHUNKS)
        with pytest.raises(OSError, match="No such file"):
            writer.take(first)


@pytest.mark.parametrize("where", ["url", "here"])
def test_only_arrays_are_removed(place: UrlPath, tmp_path: Path, where: str) -> None:
    root: Place = place if where == "url" else tmp_path
    foreign = ["mine.txt", "raw.zarr/notes.txt", "raw.zarr/a/c/0/0/mine", "raw.zarr/a/c/9/9/9"]
    create_group(root / "raw.zarr")
    create_group(root / "raw.zarr" / "fringes")
    write(root / "raw.zarr" / "a", cube())
    write(root / "raw.zarr" / "fringes" / "b", cube())
    create_array(root / "raw.zarr" / "unfinished", SHAPE, "u2", chunks=CHUNKS).write(
        (4, 0, 0), cube()[4:8]
    )
    for name in foreign:
        folder.open_folder(root).write([(name, [b"mine"])])
    remove_arrays(root)
    assert tree(root) == dict.fromkeys(foreign, b"mine")
    remove_arrays(root)
    if isinstance(root, Path):
        folders = {str(p.relative_to(root)) for p in root.rglob("*") if p.is_dir()}
        assert not {"raw.zarr/fringes", "raw.zarr/unfinished"} & folders, "no empty folders stay"


def test_nothing_is_removed_where_there_is_nothing(place: UrlPath, tmp_path: Path) -> None:
    remove_arrays(place / "nowhere")
    remove_arrays(tmp_path / "nowhere")


# What a user may give


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("/data/cubes", Path("/data/cubes")),
        ("/data/../cubes/", Path("/cubes")),
        ("cubes", Path.cwd() / "cubes"),
        ("./a:b", Path.cwd() / "a:b"),
        ("file:///data/cubes", Path("/data/cubes")),
        ("s3://bucket", UrlPath("s3://bucket")),
        ("s3://bucket/a/b/", UrlPath("s3://bucket/a/b")),
        ("memory://x", UrlPath("memory://x")),
        ("sftp://me@host/x", UrlPath("sftp://me@host/x")),
    ],
)
def test_places(text: str, place: Place) -> None:
    assert parse_place(text) == place
    assert parse_place(str(place)) == place


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "''"),
        ("s3:/bucket/x", "s3://bucket/prefix"),
        ("s3:bucket", "s3://bucket/prefix"),
        ("://bucket", "not a protocol"),
        ("simplecache::s3://bucket", "not a protocol"),
        ("s3://", "no bucket"),
        ("s3:///", "no bucket"),
        ("s3://bucket/a b", "spaces"),
        ("s3://bucket/*", "'*'"),
        ("file://data/x", "file:///"),
        ("sftp://me:secret@host/x", "password"),
    ],
)
def test_malformed_places(text: str, says: str) -> None:
    with pytest.raises(InputError, match=r"^--cubes ") as caught:
        parse_place(text)
    assert says in str(caught.value)
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("nonsense://x/y", "Protocol not known: nonsense"),
        ("gs://bucket/x", "pip install 'gcsfs'"),
        ("adl://store/x", "a package is missing"),
    ],
)
def test_a_file_system_that_is_not_there_is_told_in_one_line(url: str, says: str) -> None:
    for use in (
        lambda: ArrayReader(UrlPath(url)),
        lambda: create_array(UrlPath(url), SHAPE, "u2"),
        lambda: remove_arrays(UrlPath(url)),
    ):
        with pytest.raises(RemoteError) as caught:
            use()
        assert str(caught.value).startswith(url)
        assert says in str(caught.value)
        assert "\n" not in str(caught.value)


def test_a_missing_bucket_is_told(s3_endpoint: str) -> None:
    with pytest.raises(DamagedError, match=r"s3://no-such-bucket/a: .*bucket does not exist"):
        ArrayReader(UrlPath("s3://no-such-bucket/a"))
