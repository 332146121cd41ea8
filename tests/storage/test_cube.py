"""Cubes on disk: the same bytes as zarr-python's, and no damage that goes unseen."""

import pickle
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pixcal.model.errors import DamagedError
from pixcal.storage.cube import INDEX, create_array, create_group, write_array
from pixcal.storage.cube_reader import ArrayReader, CachedReader

SHAPE, CHUNKS = (11, 7, 13), (4, 3, 5)


def cube(dtype: Any = np.uint16, seed: int = 0) -> NDArray[Any]:
    rng = np.random.default_rng(seed)
    if np.issubdtype(dtype, np.floating):
        return rng.normal(size=SHAPE).astype(dtype)
    info = np.iinfo(dtype)
    return rng.integers(info.min, info.max, SHAPE, dtype=dtype, endpoint=True)


def write(path: Path, data: NDArray[Any], chunks: Any = CHUNKS, **options: Any) -> Path:
    """Write a cube block by block, the blocks one chunk deep in time."""
    writer = create_array(path, data.shape, data.dtype, chunks=chunks, **options)
    for start in range(0, len(data), chunks[0]):
        writer.write((start, 0, 0), data[start : start + chunks[0]])
    writer.finish()
    return path


@pytest.mark.parametrize("dtype", ["u1", "i2", "u2", "i4", "f4", "f8"])
@pytest.mark.parametrize("chunks", [CHUNKS, (1, 7, 13), (64, 128, 128), (3, 2, 4)])
def test_both_libraries_read_what_was_written(
    tmp_path: Path, dtype: str, chunks: tuple[int, int, int]
) -> None:
    data = cube(np.dtype(dtype))
    path = write(tmp_path / "a", data, chunks)
    np.testing.assert_array_equal(ArrayReader(path).read(), data)
    np.testing.assert_array_equal(zarr.open_array(store=path, mode="r")[:], data)


def test_what_zarr_writes_is_read(tmp_path: Path) -> None:
    data = cube(np.float32)
    writer = create_array(tmp_path / "a", SHAPE, "f4", chunks=CHUNKS, fill_value=np.nan)
    other = zarr.open_array(store=tmp_path / "a", mode="r+")
    other[:] = data
    writer.finish()
    np.testing.assert_array_equal(ArrayReader(tmp_path / "a").read(), data)


def test_the_chunks_are_those_of_zarr(tmp_path: Path) -> None:
    data = cube()
    ours, theirs = write(tmp_path / "ours", data), tmp_path / "theirs"
    create_array(theirs, SHAPE, "u2", chunks=CHUNKS)
    zarr.open_array(store=theirs, mode="r+")[:] = data
    names = sorted(str(f.relative_to(theirs)) for f in theirs.rglob("c/*/*/*"))
    assert len(names) == 3 * 3 * 3
    assert names == sorted(str(f.relative_to(ours)) for f in ours.rglob("c/*/*/*"))
    for name in ("zarr.json", *names):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes(), name


def test_xarray_opens_a_group(tmp_path: Path) -> None:
    data = cube(np.int16)
    create_group(tmp_path / "g", {"title": "window"})
    options: dict[str, Any] = {"attrs": {"units": "electron", "_FillValue": -1}, "fill_value": -1}
    write(tmp_path / "g" / "signal", data, **options)
    write_array(tmp_path / "g" / "time", np.arange(11) * 0.14, dims=("time",))
    found = xarray.open_zarr(tmp_path / "g", consolidated=False, mask_and_scale=False)
    assert found.signal.dims == ("time", "y", "x")
    assert found.signal.attrs["units"] == "electron"
    assert found.attrs["title"] == "window"
    np.testing.assert_array_equal(found.signal.values, data)
    np.testing.assert_array_equal(found.time.values, np.arange(11) * 0.14)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_block_is_the_same_as_numpy_s(tmp_path_factory: Any, data: Any) -> None:
    values = cube()
    path = tmp_path_factory.getbasetemp() / "blocks"
    if not (path / INDEX).exists():
        write(path, values)
    ranges = []
    for n in SHAPE[: data.draw(st.integers(0, 3))]:
        start = data.draw(st.integers(0, n - 1))
        ranges.append((start, data.draw(st.integers(start + 1, n + 3))))
    expected = values[tuple(slice(a, b) for a, b in ranges)]
    reader = ArrayReader(path)
    np.testing.assert_array_equal(reader.read(*ranges), expected)
    out = np.empty(expected.shape, values.dtype)
    assert reader.read(*ranges, out=out) is out
    np.testing.assert_array_equal(out, expected)


@pytest.mark.parametrize("data", [np.arange(7.0), np.array([[1, 2], [3, 4]], "u1"), np.zeros(0)])
def test_small_arrays(tmp_path: Path, data: NDArray[Any]) -> None:
    write_array(tmp_path / "a", data, dims=("t", "u")[: data.ndim])
    found = ArrayReader(tmp_path / "a")
    assert (found.shape, found.dtype) == (data.shape, data.dtype)
    np.testing.assert_array_equal(found.read(), data)
    np.testing.assert_array_equal(zarr.open_array(store=tmp_path / "a", mode="r")[:], data)


def test_edge_chunks_are_padded_with_the_fill_value(tmp_path: Path) -> None:
    path = write(tmp_path / "a", cube(np.float32), fill_value=np.nan)
    chunk = ArrayReader(path).read_chunk((2, 2, 2))
    assert chunk.shape == CHUNKS
    assert np.isfinite(chunk[:3, :1, :3]).all()
    assert np.isnan(chunk).sum() == 4 * 3 * 5 - 3 * 1 * 3


@pytest.mark.parametrize(
    ("start", "shape"), [((1, 0, 0), (4, 7, 13)), ((0, 0, 0), (4, 2, 13)), ((4, 0, 5), (4, 7, 4))]
)
def test_a_block_off_the_chunks_is_refused(
    tmp_path: Path, start: tuple[int, ...], shape: tuple[int, ...]
) -> None:
    writer = create_array(tmp_path / "a", SHAPE, "u2", chunks=CHUNKS)
    with pytest.raises(ValueError, match="not on chunks"):
        writer.write(start, np.zeros(shape, np.uint16))
    assert not (tmp_path / "a" / "c").exists()


def test_blocks_may_be_written_at_the_same_time_and_in_any_order(tmp_path: Path) -> None:
    data = cube()
    writer = create_array(tmp_path / "a", SHAPE, "u2", chunks=CHUNKS)
    corners = list(np.ndindex(3, 3, 3))[::-1]

    def one(at: tuple[int, ...]) -> None:
        start = tuple(i * c for i, c in zip(at, CHUNKS, strict=True))
        block = tuple(slice(s, s + c) for s, c in zip(start, CHUNKS, strict=True))
        writer.write(start, data[block])

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(one, corners))
    writer.finish()
    reader = ArrayReader(tmp_path / "a")
    np.testing.assert_array_equal(reader.read(), data)
    assert reader.chunks_read == reader.n_chunks == 27
    assert not list((tmp_path / "a").rglob("*.aside"))


def test_an_array_left_unfinished_is_taken_up_again(tmp_path: Path) -> None:
    data = cube()
    writer = create_array(tmp_path / "a", SHAPE, "u2", chunks=CHUNKS)
    writer.write((0, 0, 0), data[:8])
    with pytest.raises(DamagedError, match="not a complete array"):
        ArrayReader(tmp_path / "a")
    with pytest.raises(DamagedError, match="c/2/0/0: chunk missing"):
        writer.finish()
    again = create_array(tmp_path / "a", SHAPE, "u2", chunks=CHUNKS)
    again.write((8, 0, 0), data[8:])
    again.finish()
    np.testing.assert_array_equal(ArrayReader(tmp_path / "a").read(), data)


@pytest.fixture
def small(tmp_path: Path) -> tuple[Path, Path]:
    """An array of two chunks, and the file of the second."""
    data = np.arange(64, dtype=np.uint16).reshape(2, 4, 8)
    path = write(tmp_path / "small", data, (1, 4, 8))
    return path, path / "c" / "1" / "0" / "0"


def refused(path: Path, file: Path) -> None:
    """Every way of reading names the file."""
    for read in (ArrayReader.read, lambda r: r.read_chunk((1, 0, 0))):
        with pytest.raises(DamagedError) as caught:
            read(ArrayReader(path))
        assert str(file) in str(caught.value)
        assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(
        ArrayReader(path).read((0, 1))[0], np.arange(32).reshape(4, 8), "the other one is whole"
    )


def test_every_flipped_bit_is_seen(small: tuple[Path, Path]) -> None:
    path, file = small
    body = file.read_bytes()
    assert len(body) < 200
    reader = ArrayReader(path)
    for bit in range(8 * len(body)):
        broken = bytearray(body)
        broken[bit // 8] ^= 1 << bit % 8
        file.write_bytes(broken)
        with pytest.raises(DamagedError, match="c/1/0/0"):
            reader.read_chunk((1, 0, 0))
    refused(path, file)
    file.write_bytes(body)
    reader.read()


def test_every_cut_is_seen(small: tuple[Path, Path]) -> None:
    path, file = small
    body = file.read_bytes()
    reader = ArrayReader(path)
    for size in range(len(body)):
        file.write_bytes(body[:size])
        with pytest.raises(DamagedError, match=f"c/1/0/0: {size} bytes where {len(body)}"):
            reader.read_chunk((1, 0, 0))
    file.write_bytes(body + b"\0")
    refused(path, file)


@pytest.mark.parametrize("instead", ["nothing", "another chunk", "a folder"])
def test_other_damage_is_seen(small: tuple[Path, Path], instead: str) -> None:
    path, file = small
    file.unlink()
    if instead == "another chunk":
        file.write_bytes((path / "c" / "0" / "0" / "0").read_bytes())
    elif instead == "a folder":
        file.mkdir()
    refused(path, file)


def test_a_chunk_with_a_valid_checksum_of_its_own_is_not_taken(small: tuple[Path, Path]) -> None:
    """A chunk of the same size that another run wrote, whole in itself."""
    path, file = small
    write(path.with_name("other"), np.arange(100, 164, dtype=np.uint16).reshape(2, 4, 8), (1, 4, 8))
    other = path.with_name("other") / "c" / "1" / "0" / "0"
    assert other.stat().st_size == file.stat().st_size
    file.write_bytes(other.read_bytes())
    refused(path, file)


@pytest.mark.parametrize("name", ["zarr.json", INDEX])
def test_cut_metadata_is_seen(small: tuple[Path, Path], name: str) -> None:
    path, _ = small
    body = (path / name).read_bytes()
    for size in (*range(0, len(body) - 1, 7), len(body) - 2):
        (path / name).write_bytes(body[:size])
        with pytest.raises(DamagedError, match=str(path)):
            ArrayReader(path)
    (path / name).unlink()
    with pytest.raises(DamagedError, match=str(path)):
        ArrayReader(path)


@pytest.mark.parametrize("name", ["zarr.json", INDEX])
def test_a_flipped_bit_in_the_metadata_is_seen(small: tuple[Path, Path], name: str) -> None:
    path, _ = small
    body = (path / name).read_bytes()
    for bit in range(3, 8 * len(body), 13):
        broken = bytearray(body)
        broken[bit // 8] ^= 1 << bit % 8
        (path / name).write_bytes(broken)
        with pytest.raises(DamagedError, match=str(path)):
            ArrayReader(path)
    (path / name).write_bytes(body)
    ArrayReader(path).read()


def test_the_index_of_another_array_is_refused(small: tuple[Path, Path]) -> None:
    path, _ = small
    write(path.with_name("other"), cube())
    (path / INDEX).write_bytes((path.with_name("other") / INDEX).read_bytes())
    with pytest.raises(DamagedError, match=f"{path}.*{INDEX}"):
        ArrayReader(path)


def test_a_chunk_that_is_cut_before_the_end_is_not_indexed(small: tuple[Path, Path]) -> None:
    path, file = small
    file.write_bytes(b"\0\0")
    with pytest.raises(DamagedError, match="c/1/0/0: truncated chunk"):
        create_array(path, (2, 4, 8), "u2", chunks=(1, 4, 8)).finish()


def test_a_cached_reader_keeps_chunks_and_travels_light(tmp_path: Path) -> None:
    data = cube()
    reader = CachedReader(write(tmp_path / "a", data))
    kept = reader.keep((1, 0, 1))
    assert reader.keep((1, 0, 1)) is kept
    assert reader.holds((1, 0, 1))
    assert not reader.holds((0, 0, 1))
    assert reader.chunks_read == 1
    np.testing.assert_array_equal(reader.read(), data)
    assert reader.chunks_read == 27
    assert reader.read_chunk((1, 0, 1)) is kept
    other = pickle.loads(pickle.dumps(reader))  # noqa: S301 (just made)
    assert not other.holds((1, 0, 1))
    np.testing.assert_array_equal(other.read(), data)
