"""Ingest: check and catalogue the frames of an acquisition, reading each frame once.

Headers and file lengths are checked before any data are read. Every frame is then read for its
checksums. Plain files are not copied, since `reduce` reads them in place. Samples of compressed
files, which cannot be read in bands of rows, are copied into cubes, as are all samples with
``copy``. An interrupted run resumes with the missing blocks of frames. Arrays whose files have not
changed since an earlier ingest are reused without reading.
"""

import os
import shutil
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pixcal.engine.plan import Plan, make_plan
from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.acquisition import Acquisition, load_acquisition
from pixcal.model.arrays import F64
from pixcal.model.config import to_plain
from pixcal.model.errors import DamagedError, InputError, RemoteError
from pixcal.model.options import Ingest as Config
from pixcal.stages.ingest.arrays import FRAMES_A_PIECE, Writers, find_kept, take_over
from pixcal.stages.ingest.frames_to_leave_out import (
    cut_from,
    cut_warning,
    repeat_warning,
    repeats_of,
)
from pixcal.stages.steps import run_steps
from pixcal.storage import frame_decoding
from pixcal.storage.artefact import Build, discard
from pixcal.storage.cube import CHUNK, ArrayReader
from pixcal.storage.cube_place import base_of, chosen_base, cubes_of
from pixcal.storage.folder import transit_bytes
from pixcal.storage.formats import STAGES
from pixcal.storage.frame_decoding import BAND
from pixcal.storage.frame_file import FrameFile
from pixcal.storage.frame_reader import describe
from pixcal.storage.frames import Frame, columns, inspect, tabulate
from pixcal.storage.lock import lock
from pixcal.storage.manifest import Manifest, read_manifest, write_json, write_manifest
from pixcal.storage.sources import SourceFile, find_sources, fingerprint
from pixcal.storage.stage import make

STAGE = STAGES["ingest"]

# heights of a band, of which the first that fits in memory is used: whole chunks, and long reads
_BAND_ROWS = (512, 384, 256, 128)

_DTYPES = tuple(map(np.dtype, ("u1", "i1", "u2", "i2", "u4", "i4", "f4")))
_FILES_A_TASK = 32
_BYTES_A_FRAME = 4096


def run(acquisition: Path, out: Path, config: Config, runtime: Runtime) -> Manifest:
    """Make ``RUN/ingest`` from an acquisition (directory or its YAML file), unless up to date.

    Arrays of an earlier ingest that were made from the same files are reused; if there are none, it
    was of another acquisition and is only replaced with `Config.overwrite`. In the manifest,
    ``inputs`` holds the fingerprint of the files of each array; ``summary`` holds the shape, type
    and content digest of each array, and ``warnings``.
    """
    described = load_acquisition(acquisition)
    description = acquisition / "acquisition.yaml" if acquisition.is_dir() else acquisition
    sources = find_sources(described.frames, description)
    plain = {"acquisition": to_plain(described)}
    inputs = {array: fingerprint(files) for array, files in sources.items()}
    with lock(out):
        base = chosen_base(config.cubes, out, out / STAGE.name)
        earlier = _earlier(out)
        names = {files: array for array, files in (earlier.inputs if earlier else {}).items()}
        # Arrays made from the same files as an earlier array, with its name as value.
        same = {array: names[files] for array, files in inputs.items() if files in names}
        if earlier is not None and not same and not config.overwrite:
            _refuse_other(out, earlier, plain, inputs)

        def keep(ready: Manifest) -> bool:
            arrays = ready.summary["arrays"].values()
            copied = not config.copy or all(facts["copied"] for facts in arrays)
            return base_of(out / STAGE.name) == base and copied

        def body(made: Build) -> None:
            kept = []
            if earlier is not None and earlier.format == STAGE.format:
                kept = find_kept(out / STAGE.name, earlier, same, sources, copy=config.copy)
            facts = take_over(made, kept, runtime)
            known = {k.array: k.files for k in kept if k.array in facts}
            tables, warnings = _check(described, sources, known, runtime)
            copied = {
                array: facts[array]["copied"]
                if array in facts
                else config.copy or any(frame.file.container != "plain" for frame in frames)
                for array, frames in tables.items()
            }
            _fill(made, {a: f for a, f in tables.items() if a not in known}, copied, runtime)
            cut = _close(made, described, sources, tables, copied, facts)
            made.summary["warnings"] = warnings + cut

        make(out, STAGE, plain, inputs, body, cubes=base, keep=keep)
        return _place(out, description.parent)


def _place(out: Path, folder: Path) -> Manifest:
    """Note the present paths of the files in the manifest, since they may have been moved."""
    manifest = read_manifest(out / STAGE.name)
    assert manifest is not None
    where = {
        "folder": str(folder.absolute()),
        "from_run": os.path.relpath(folder.absolute(), out.absolute()),
    }
    if manifest.summary.get("acquisition") != where:
        manifest.summary["acquisition"] = where
        write_manifest(out / STAGE.name, manifest)
    return manifest


def _earlier(out: Path) -> Manifest | None:
    """Manifest of an earlier ingest; None if it is unreadable."""
    try:
        cubes_of(out / STAGE.name)
        return read_manifest(out / STAGE.name)
    except DamagedError:
        return None


def _refuse_other(
    out: Path, earlier: Manifest, plain: Mapping[str, Any], inputs: Mapping[str, str]
) -> None:
    """Refuse to replace an ingest of another acquisition, and name the differences."""
    arrays = sorted(inputs.keys() | earlier.inputs.keys())
    other = [a for a in arrays if inputs.get(a) != earlier.inputs.get(a)]
    if earlier.config != plain:
        other.append("acquisition.yaml")
    raise InputError(
        f"{out / STAGE.name}: made from another acquisition (changed: "
        f"{', '.join(other) or 'format'}); choose another --out, or replace it with --overwrite"
    )


# Headers


def _check(
    described: Acquisition,
    sources: Mapping[str, Sequence[SourceFile]],
    known: Mapping[str, list[FrameFile]],
    runtime: Runtime,
) -> tuple[dict[str, list[Frame]], list[str]]:
    """Headers of the files of arrays not ``known``: table of frames of each array, warnings."""
    unknown = {array: files for array, files in sources.items() if array not in known}
    listed = [source for files in unknown.values() for source in files]
    batches = [listed[n : n + _FILES_A_TASK] for n in range(0, len(listed), _FILES_A_TASK)]
    results = run_tasks(_inspect_batch, batches, runtime, label="headers")
    answers = [answer for batch in results for answer in batch]
    problems = [answer for answer in answers if isinstance(answer, str)]
    if problems:
        more = f" ({len(problems) - 1} more bad files)" if len(problems) > 1 else ""
        raise InputError(problems[0] + more)
    files = iter(answer for answer in answers if isinstance(answer, FrameFile))
    read = {array: [next(files) for _ in its_files] for array, its_files in unknown.items()}
    by_array = {array: known[array] if array in known else read[array] for array in sources}
    _check_shapes(by_array)
    for array, its_files in read.items():
        _common_dtype(array, its_files)
    tables, warnings = {}, []
    for array, its_files in by_array.items():
        frames, odd = tabulate(array, its_files, described.fibres.frame_period_s)
        tables[array] = frames
        warnings += odd
    return tables, warnings


def _inspect_batch(batch: Sequence[SourceFile]) -> list[FrameFile | str]:
    """Description of each file, or its error."""
    answers: list[FrameFile | str] = []
    for source in batch:
        try:
            answers.append(inspect(source))
        except InputError as error:
            answers.append(str(error))
    return answers


def _check_shapes(by_array: Mapping[str, Sequence[FrameFile]]) -> None:
    """Refuse frames whose size differs from that of most files."""
    files = [file for its_files in by_array.values() for file in its_files]
    usual = Counter(file.shape[1:] for file in files).most_common(1)[0][0]
    odd = next((file for file in files if file.shape[1:] != usual), None)
    if odd is not None:
        other = next(file for file in files if file.shape[1:] == usual)
        sizes = [f"{nx} × {ny}" for ny, nx in (odd.shape[1:], usual)]
        raise InputError(
            f"{odd.source.path}: frames of {sizes[0]} pixels (x × y), where those of "
            f"{other.source.name} and of most files have {sizes[1]}; all frames of an acquisition "
            "must have the same size"
        )


def _common_dtype(array: str, files: Sequence[FrameFile]) -> np.dtype[Any]:
    """Smallest type that holds the samples of all files of an array."""
    first: dict[np.dtype[Any], FrameFile] = {}
    for file in files:
        first.setdefault(file.coding.dtype, file)
    dtype = np.result_type(*first)
    if dtype not in _DTYPES:
        a, *_, b = first.items()
        raise InputError(
            f"{b[1].source.path}: {b[0]} samples, where {a[1].source.name} of the same array "
            f"{array} has {a[0]}; no 32-bit type holds both, convert one"
        )
    return dtype


# Memory and tasks


def _task_bytes(array: str, frames: Sequence[Frame], rows: int, copied: bool) -> int:
    """Peak memory of one task: its rows, samples in conversion, chunks in compression."""
    files = _files(frames)
    _, ny, nx = files[0].shape
    dtype = _common_dtype(array, files)
    held = min(max(map(frame_decoding.rows_at_once, files)), ny)
    conversion = held * nx * (np.dtype("f8").itemsize + 3 * dtype.itemsize)
    if not copied:
        return conversion
    chunk = CHUNK[0] * CHUNK[1] * CHUNK[2] * dtype.itemsize
    reading = max(conversion, *(frame_decoding.unpack_bytes(f) for f in files), 4 * chunk)
    return min(CHUNK[0], len(frames)) * min(rows, ny) * nx * dtype.itemsize + reading


def _files(frames: Sequence[Frame]) -> list[FrameFile]:
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


def _fill(
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
        writers = _writers(made, array, frames, copied[array])
        steps.update(_pieces(array, frames, writers, rows, scratch))
    run_steps(made, _write_piece, steps, runtime.with_workers(plan.workers), label="ingest")
    shutil.rmtree(scratch, ignore_errors=True)


def _writers(made: Build, array: str, frames: Sequence[Frame], copied: bool) -> Writers:
    shape = (len(frames), *frames[0].file.shape[1:])
    return Writers.create(made, array, shape, _common_dtype(array, _files(frames)), copied=copied)


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
    wanted = {f.source.name: f for f in _files(block) if f.container != "plain"}
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


# The end


def _close(
    made: Build,
    described: Acquisition,
    sources: Mapping[str, Sequence[SourceFile]],
    tables: Mapping[str, Sequence[Frame]],
    copied: Mapping[str, bool],
    facts: Mapping[str, dict[str, Any]],
) -> list[str]:
    """Check that no data are missing or were changed meanwhile, and write the tables."""
    # ``facts``: of reused arrays. Returns warnings on frames with interrupted transfer.
    try:
        for files in sources.values():
            for source in files:
                source.check_unchanged()
        arrays = {
            array: (facts.get(array) or _writers(made, array, frames, copied[array]).finish())
            | {"files": len(_files(frames))}
            for array, frames in tables.items()
        }
    except RemoteError:
        raise
    except InputError:
        # The data that were read are unreliable.
        discard(made.folder, made.folder.parents[1])
        raise
    write_json(made.folder / "acquisition.json", to_plain(described))
    listed, places, warnings = {}, {}, []
    for array, frames in tables.items():
        bands = frame_decoding.by_fact(ArrayReader(made.folder / "catalogue.zarr" / array).read())
        largest = np.fmax.reduce(bands["largest"], axis=1)
        cut = cut_from(array, bands, frames[0].file.shape[1])
        repeats = repeats_of(bands)
        warnings += cut_warning(array, frames, cut, bands)
        warnings += repeat_warning(array, frames, repeats)
        listed[array] = columns(frames) | {
            "largest_adu": [float(v) if np.isfinite(v) else None for v in largest],
            "cut_from_row": cut,
            "repeat_of": repeats,
        }
        places[array] = None if copied[array] else describe(_files(frames))
    write_json(made.folder / "frames.json", listed)
    write_json(made.folder / "files.json", places)
    made.summary["arrays"] = arrays
    return warnings
