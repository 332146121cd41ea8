"""Read every frame once: facts of its bands for the catalogue, and a copy where one is needed."""

import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import Plan, make_plan
from pixcal.engine.run import Runtime
from pixcal.model.arrays import F64
from pixcal.stages.ingest.arrays import FRAMES_A_PIECE, Writers
from pixcal.stages.ingest.headers import common_dtype
from pixcal.stages.steps import run_steps
from pixcal.storage import frame_decoding
from pixcal.storage.artefact import Build
from pixcal.storage.cube import CHUNK
from pixcal.storage.folder import transit_bytes
from pixcal.storage.frame_decoding import BAND
from pixcal.storage.frame_file import FrameFile
from pixcal.storage.frames import Frame

# heights of a band, of which the first that fits in memory is used: whole chunks, and long reads
_BAND_ROWS = (512, 384, 256, 128)
_BYTES_A_FRAME = 4096


def _task_bytes(array: str, frames: Sequence[Frame], rows: int, copied: bool) -> int:
    """Peak memory of one task: its rows, samples in conversion, chunks in compression."""
    files = files_of(frames)
    _, ny, nx = files[0].shape
    dtype = common_dtype(array, files)
    held = min(max(map(frame_decoding.rows_at_once, files)), ny)
    conversion = held * nx * (np.dtype("f8").itemsize + 3 * dtype.itemsize)
    if not copied:
        return conversion
    chunk = CHUNK[0] * CHUNK[1] * CHUNK[2] * dtype.itemsize
    reading = max(conversion, *(frame_decoding.unpack_bytes(f) for f in files), 4 * chunk)
    return min(CHUNK[0], len(frames)) * min(rows, ny) * nx * dtype.itemsize + reading


def files_of(frames: Sequence[Frame]) -> list[FrameFile]:
    """Files of frames, in their order."""
    return [file for file, _ in groupby(frame.file for frame in frames)]


@dataclass(frozen=True)
class _Piece:
    """A task: frames from a chunk border on; samples are copied in strips of rows."""

    writers: Writers
    start: int
    frames: Sequence[Frame]
    rows: int
    scratch: Path


def _pieces(
    array: str, frames: Sequence[Frame], writers: Writers, rows: int, scratch: Path
) -> Iterator[tuple[str, _Piece]]:
    """Steps of an array and their tasks: a block of frames each."""
    # Compressed files can only be read whole: blocks that share a file form one task.
    borders = [0]
    for t in range(0, len(frames), CHUNK[0] if writers.samples else FRAMES_A_PIECE):
        if t and (frames[t].plane == 0 or frames[t].file.container == "plain"):
            borders.append(t)
    for start, stop in zip(borders, [*borders[1:], len(frames)], strict=True):
        yield f"{array} {start}:{stop}", _Piece(writers, start, frames[start:stop], rows, scratch)


def read_frames(
    made: Build, tables: Mapping[str, Sequence[Frame]], copied: Mapping[str, bool], runtime: Runtime
) -> None:
    """Read and write all blocks that an earlier run has not written."""
    shared = _BYTES_A_FRAME * sum(map(len, tables.values()))
    rows, need = 0, 0
    # Fewer rows first, then fewer workers.
    for rows in _BAND_ROWS:
        tasks = (_task_bytes(array, some, rows, copied[array]) for array, some in tables.items())
        need = max(tasks, default=0) + transit_bytes(made.cubes)
        if Plan(need, shared, runtime.n_workers).total <= runtime.memory:
            break
    plan = make_plan("ingest", need, shared, runtime)
    scratch = made.scratch
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    steps: dict[str, _Piece] = {}
    for array, frames in tables.items():
        writers = writers_of(made, array, frames, copied[array])
        steps.update(_pieces(array, frames, writers, rows, scratch))
    run_steps(made, _write_piece, steps, runtime.with_workers(plan.workers), label="ingest")
    shutil.rmtree(scratch, ignore_errors=True)


def writers_of(made: Build, array: str, frames: Sequence[Frame], copied: bool) -> Writers:
    """Writers of an array's catalogue and, if it is copied, of its samples."""
    shape = (len(frames), *frames[0].file.shape[1:])
    return Writers.create(made, array, shape, common_dtype(array, files_of(frames)), copied=copied)


def _write_piece(piece: _Piece) -> None:
    """Read the frames of a task, block by block, and write their part of the catalogue."""
    samples, (_, ny, nx) = piece.writers.samples, piece.frames[0].file.shape
    strips = [(0, ny)]
    if samples is not None:
        strips = [(y, min(y + piece.rows, ny)) for y in range(0, ny, piece.rows)]
        count = min(CHUNK[0], len(piece.frames))
        buffer = np.empty((count, min(piece.rows, ny), nx), samples.dtype)
    facts = np.empty((len(piece.frames), *piece.writers.catalogue.shape[1:]))
    with TemporaryDirectory(dir=piece.scratch) as scratch:
        unpacked: dict[str, FrameFile] = {}
        for t in range(0, len(piece.frames), CHUNK[0]):
            block = piece.frames[t : t + CHUNK[0]]
            unpacked = _unpack_block(block, unpacked, Path(scratch, str(t)))
            for y0, y1 in strips:
                out = None if samples is None else buffer[: len(block), : y1 - y0]
                bands = slice(y0 // BAND, -(-y1 // BAND))
                facts[t : t + len(block), bands] = _read_block(block, unpacked, (y0, y1), out)
                if samples is not None and out is not None:
                    samples.write((piece.start + t, y0, 0), out)
    piece.writers.catalogue.write((piece.start, 0, 0), facts)


def _unpack_block(
    block: Sequence[Frame], unpacked: Mapping[str, FrameFile], scratch: Path
) -> dict[str, FrameFile]:
    """Unpack the compressed files of a block, and delete those of earlier blocks only."""
    scratch.mkdir()
    wanted = {f.source.name: f for f in files_of(block) if f.container != "plain"}
    for name in unpacked.keys() - wanted.keys():
        unpacked[name].source.path.unlink()
    return {
        name: unpacked.get(name) or frame_decoding.unpack(file, scratch / str(number))
        for number, (name, file) in enumerate(wanted.items())
    }


def _read_block(
    block: Sequence[Frame],
    unpacked: Mapping[str, FrameFile],
    rows: tuple[int, int],
    out: NDArray[Any] | None,
) -> F64:
    facts, at = [], 0
    for file, group in groupby(block, key=lambda frame: frame.file):
        planes = [frame.plane for frame in group]
        target = None if out is None else out[at : at + len(planes)]
        facts.append(
            frame_decoding.read_rows(unpacked.get(file.source.name, file), planes, rows, target)
        )
        at += len(planes)
    return np.concatenate(facts)
