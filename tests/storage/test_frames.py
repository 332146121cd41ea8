"""Order and times of frames: time stamps where every file has one, else natural names."""

import random
from pathlib import Path

import pytest

from pixcal.storage.frame_file import FrameFile, SampleFormat
from pixcal.storage.frames import columns, natural_key, tabulate
from pixcal.storage.sources import SourceFile

SECOND = 1 / 86400


def frame_file(
    name: str, mjd: float | None = None, planes: int = 1, exptime_s: float | None = None
) -> FrameFile:
    source = SourceFile(Path("/acq", name), name, 1, 1)
    shape = (planes, 7, 5)
    return FrameFile(
        source, "plain", 0, 2880, shape, SampleFormat(16), mjd=mjd, exptime_s=exptime_s
    )


def table(
    files: list[FrameFile], period: float | None = None, array: str = "fringes/a"
) -> tuple[dict, list[str]]:
    random.Random(3).shuffle(files)
    frames, warnings = tabulate(array, files, period)
    return columns(frames), warnings


def test_natural_names() -> None:
    names = ["a/frame2", "a/frame10", "a/frame010b", "a/Frame11", "b/1", "b/1.5", "b/٣", "b/x²"]
    shuffled = random.Random(1).sample(names, len(names))
    assert sorted(shuffled, key=natural_key) == names


def test_without_time_stamps_by_name() -> None:
    found, warnings = table([frame_file(f"f{n}") for n in (1, 2, 9, 10, 11, 100)])
    assert found["file"] == ["f1", "f2", "f9", "f10", "f11", "f100"]
    assert found["time_s"] == [0, 1, 2, 3, 4, 5]
    assert set(found["time_source"]) == {"number"}
    assert found["mjd"] == [None] * 6
    assert warnings == []


def test_frame_period_without_time_stamps() -> None:
    found, _ = table([frame_file("a", planes=2), frame_file("b", planes=3)], 0.14)
    assert found["plane"] == [0, 1, 0, 1, 2]
    assert found["time_s"] == pytest.approx([0, 0.14, 0.28, 0.42, 0.56])
    assert set(found["time_source"]) == {"frame_period_s"}


def test_time_stamps_win_over_names_and_period() -> None:
    files = [frame_file(f"f{n}", 60000 + (10 - n) * SECOND) for n in range(4)]
    found, warnings = table(files, 0.14)
    assert found["file"] == ["f3", "f2", "f1", "f0"]
    assert found["time_s"] == pytest.approx([0, 1, 2, 3], abs=1e-5)
    assert set(found["time_source"]) == {"header"}
    assert len(warnings) == 1
    assert "fringes/a: time stamps do not follow the file names (f1)" in warnings[0]


def test_names_with_decimals_follow_the_time() -> None:
    names = ["flat_0.25", "flat_0.5", "flat_1.0", "flat_10.0"]
    found, warnings = table([frame_file(f, 60000 + n * SECOND) for n, f in enumerate(names)])
    assert found["file"] == names
    assert warnings == []


def test_one_file_without_stamp_means_names() -> None:
    found, warnings = table([frame_file("a", 60001.0), frame_file("b"), frame_file("c", 60000.0)])
    assert found["file"] == ["a", "b", "c"]
    assert found["mjd"] == [60001.0, None, 60000.0]
    assert "no readable time stamp in 1 of 3 files (b)" in warnings[0]


def test_same_stamps_are_ordered_by_name() -> None:
    files = [frame_file(n, 60000 + t) for n, t in (("f10", 0), ("f2", 0), ("f3", 1), ("f1", 1))]
    found, warnings = table(files)
    assert found["file"] == ["f2", "f10", "f1", "f3"]
    assert "2 time stamps are the same as the one before (f2 and f10)" in " ".join(warnings)


@pytest.mark.parametrize(("exptime", "count"), [(0.9, 0), (1.5, 0), (900.0, 1)])
def test_exposures_longer_than_the_steps_of_time_are_not_in_seconds(
    exptime: float, count: int
) -> None:
    files = [frame_file(f"f{n}", 60000 + n * SECOND, 1, exptime) for n in range(4)]
    assert sum("EXPTIME 900 is longer" in one for one in table(files)[1]) == count


def test_one_stamp_for_all_is_none() -> None:
    found, warnings = table([frame_file("f2", 0.0), frame_file("f10", 0.0)], 0.5)
    assert found["time_s"] == [0, 0.5]
    assert "all files have the same time stamp" in warnings[0]


@pytest.mark.parametrize(
    ("period", "exptime", "source"),
    [(0.5, 0.02, "frame_period_s"), (0.14, 0.5, "exptime_s"), (None, 0.5, "exptime_s")],
)
def test_planes_of_stamped_cubes(period: float | None, exptime: float, source: str) -> None:
    files = [frame_file(n, 60000 + t * SECOND, 3, exptime) for n, t in (("a", 0), ("b", 10))]
    found, warnings = table(files, period)
    assert found["time_s"] == pytest.approx([0, 0.5, 1, 10, 10.5, 11], abs=1e-5)
    assert found["mjd"] == pytest.approx([60000 + t * SECOND for t in found["time_s"]], abs=1e-9)
    assert found["time_source"] == ["header", source, source] * 2
    assert warnings == []


def test_stamped_cube_of_unknown_rhythm_is_numbered() -> None:
    found, warnings = table([frame_file("a", 60001.0, 2), frame_file("b", 60000.0, 2)])
    assert found["file"] == ["b", "b", "a", "a"]
    assert found["time_s"] == [0, 1, 2, 3]
    assert found["mjd"] == [60000.0, None, 60001.0, None]
    assert "frames are numbered, without times" in " ".join(warnings)
    # The pace of bias frames is nothing that their owner need give.
    _, warnings = table([frame_file("a", 60000.0, 2), frame_file("b", 60001.0, 2)], array="bias")
    assert warnings == []


def test_cube_that_lasts_too_long_is_told() -> None:
    files = [frame_file("a", 60000.0, 3), frame_file("b", 60000 + SECOND, 3)]
    _, warnings = table(files, 0.9)
    assert "a cube overlaps the next file in time, judging by its frame_period_s" in warnings[0]
