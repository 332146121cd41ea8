"""Files of frames in any format, and the table of the frames of an array."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

from pixcal.model.errors import InputError
from pixcal.storage import fits_in
from pixcal.storage.frame_file import FrameFile
from pixcal.storage.header_values import DAY_S
from pixcal.storage.sources import HEADERS, SourceFile
from pixcal.storage.tiff_png import inspect_picture, is_picture

_NAMED = 3  # frames that a warning names


def inspect(source: SourceFile) -> FrameFile:
    """Read the description of a file's frames, and check it against the file's length."""
    with source.open() as handle:
        start = handle.read(8)
    if is_picture(start):
        return inspect_picture(source)
    if source.header:
        raise InputError(
            f"{source.path}: {HEADERS} names it, but FITS files have headers of their own; "
            f"remove it from {HEADERS}"
        )
    return fits_in.inspect(source)


TimeSource = Literal["header", "frame_period_s", "exptime_s", "number"]


@dataclass(frozen=True)
class Frame:
    """One frame of an array."""

    file: FrameFile  # where it is
    plane: int  # its number in a cube, else 0
    mjd: float | None  # modified Julian date (days), None when unknown
    time_s: float  # seconds since the array's first frame (its number where no time is known)
    # `header`; `frame_period_s` or `exptime_s`: added up from there; `number`
    time_source: TimeSource

    @property
    def name(self) -> str:
        """Its file, with its plane in a cube."""
        return f"{self.file.source.name}{f' [{self.plane}]' * (self.file.shape[0] > 1)}"


def first_few(names: Sequence[str]) -> str:
    """The first names of some frames, and how many more there are."""
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def natural_key(name: str) -> tuple[list[tuple[int, str]], str]:
    """Key that sorts ``frame2`` before ``frame10``."""
    parts = [
        (int(part), "") if part.isdecimal() else (-1, part.casefold())
        for part in re.split(r"(\d+)", name)
        if part
    ]
    return parts, name


def tabulate(
    array: str, files: Sequence[FrameFile], frame_period_s: float | None
) -> tuple[list[Frame], list[str]]:
    """The frames of an array in order of time, and warnings on irregular times.

    By time stamp if every file has one, else by natural file name. Later planes of a cube follow at
    ``frame_period_s``, else at their exposure time. ``array``: its name, for the warnings.
    """
    ordered, stamped, warnings = _order(files)
    # A frame takes at least its exposure: darks may be longer than the period of the fringes.
    steps = [max(frame_period_s or 0.0, file.exptime_s or 0.0) for file in ordered]
    if stamped and any(f.shape[0] > 1 and not s for f, s in zip(ordered, steps, strict=True)):
        stamped = False
        if array.startswith("fringes"):
            warnings.append(
                "a cube has no EXPTIME, or zero, and optics.frame_period_s is not given: its "
                "frames are numbered, without times"
            )
    if stamped:
        frames = _stamped_frames(ordered, steps, frame_period_s)
        late = next((a for a, b in pairwise(frames) if b.time_s < a.time_s), None)
        if late is not None:
            warnings.append(
                f"a cube overlaps the next file in time, judging by its {late.time_source}"
            )
        overlaps = [
            (a.file.exptime_s, b.time_s - a.time_s)
            for a, b in pairwise(frames)
            if 0 < 2 * (b.time_s - a.time_s) < (a.file.exptime_s or 0.0)
        ]
        if 2 * len(overlaps) >= len(frames):
            exptime, gap = overlaps[0]
            warnings.append(
                f"EXPTIME {exptime:g} is longer than the {gap:.3g} s to the next time stamp; "
                "write it in seconds"
            )
    else:
        frames = _counted_frames(ordered, frame_period_s)
    return frames, [f"{array}: {sentence}" for sentence in warnings]


def columns(frames: Sequence[Frame]) -> dict[str, list[Any]]:
    """The table in the format of ``frames.json``: columns of equal length."""
    return {
        "file": [f.file.source.name for f in frames],
        "plane": [f.plane for f in frames],
        "mjd": [f.mjd for f in frames],
        "exptime_s": [f.file.exptime_s for f in frames],
        "temperature_c": [f.file.temperature_c for f in frames],
        "time_s": [f.time_s for f in frames],
        "time_source": [f.time_source for f in frames],
    }


def _order(files: Sequence[FrameFile]) -> tuple[list[FrameFile], bool, list[str]]:
    """Files in order, whether by time stamps, and warnings on these."""
    named = sorted(files, key=lambda file: natural_key(file.source.name))
    stamps = [file.mjd for file in named if file.mjd is not None]
    if not stamps:
        return named, False, []
    if len(stamps) < len(named):
        without = next(file.source.name for file in named if file.mjd is None)
        missing = f"{len(named) - len(stamps)} of {len(named)} files ({without})"
        return named, False, [f"no readable time stamp in {missing}; ordered by file name"]
    if len(named) > 1 and len(set(stamps)) == 1:
        return named, False, ["all files have the same time stamp; ordered by file name"]
    warnings = []
    ordered = sorted(named, key=lambda file: file.mjd or 0.0)
    late = next((b for a, b in pairwise(named) if (b.mjd or 0.0) < (a.mjd or 0.0)), None)
    # Names such as 0.25 and 0.5 are in alphabetical order, not in that of whole numbers.
    if late is not None and ordered != sorted(ordered, key=lambda file: file.source.name):
        warnings.append(
            f"time stamps do not follow the file names ({late.source.name}); ordered by time"
        )
    twins = [(a, b) for a, b in pairwise(ordered) if a.mjd == b.mjd]
    if twins:
        a, b = (file.source.name for file in twins[0])
        warnings.append(
            f"{len(twins)} time stamps are the same as the one before ({a} and {b}); these frames "
            "are ordered by file name"
        )
    return ordered, True, warnings


def _stamped_frames(
    files: Sequence[FrameFile], steps: Sequence[float], frame_period_s: float | None
) -> list[Frame]:
    first = files[0].mjd or 0.0
    frames = []
    for file, step in zip(files, steps, strict=True):
        start = file.mjd or 0.0
        source: TimeSource = "frame_period_s" if step == frame_period_s else "exptime_s"
        for plane in range(file.shape[0]):
            mjd = start + plane * step / DAY_S
            time_s = (start - first) * DAY_S + plane * step
            frames.append(Frame(file, plane, mjd, time_s, source if plane else "header"))
    return frames


def _counted_frames(files: Sequence[FrameFile], frame_period_s: float | None) -> list[Frame]:
    planes = [(file, plane) for file in files for plane in range(file.shape[0])]
    source: TimeSource = "frame_period_s" if frame_period_s else "number"
    return [
        Frame(file, plane, None if plane else file.mjd, n * (frame_period_s or 1.0), source)
        for n, (file, plane) in enumerate(planes)
    ]
