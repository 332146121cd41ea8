"""The arrays of ``RUN/ingest``: create, close, and reuse those of an earlier ingest.

The catalogue holds checksums and largest samples of every frame. Samples are copied only if they
cannot be read again from their files, or on request.
If no file of an array has changed, the files are not even opened: chunks are linked from the
earlier artefact, and header values are taken from its tables.
"""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.errors import DamagedError
from pixcal.storage.artefact import Build
from pixcal.storage.cube import ArrayWriter, create_array, create_group
from pixcal.storage.cube_place import cubes_of
from pixcal.storage.folder import DISK_FULL
from pixcal.storage.frame_decoding import BAND, FACTS
from pixcal.storage.frame_file import FrameFile, SampleFormat
from pixcal.storage.frame_reader import Columns, described
from pixcal.storage.frames import tabulate
from pixcal.storage.manifest import Manifest, damaged_files, digest, file_digest, read_json
from pixcal.storage.place import Place
from pixcal.storage.sources import SourceFile

FRAMES_A_PIECE = 16  # frames catalogued by one task: a chunk of the catalogue


def _create_groups(store: Place, array: str) -> None:
    create_group(store)
    if "/" in array:
        create_group(store / array.split("/")[0])


def _finish(writer: ArrayWriter) -> str:
    """Close an array and return its digest; DamagedError if a chunk is missing or cut."""
    index = writer.finish()
    content = hashlib.sha256(repr((writer.shape, writer.dtype.str)).encode())
    content.update(index.tobytes())
    return content.hexdigest()[:32]


@dataclass(frozen=True)
class Writers:
    """Writers of an array of frames."""

    # (time, band, fact): what `pixcal.storage.frame_decoding.read_rows` returns
    catalogue: ArrayWriter
    samples: ArrayWriter | None  # (time, y, x) in ADU, if they are copied
    shape: tuple[int, ...]  # shape, dtype: of the frames
    dtype: str

    @classmethod
    def create(
        cls, made: Build, array: str, shape: Sequence[int], dtype: Any, *, copied: bool
    ) -> "Writers":
        """Create the arrays, or reopen them."""
        store = made.folder / "catalogue.zarr"
        _create_groups(store, array)
        facts = (-(-shape[1] // BAND), len(FACTS))
        catalogue = create_array(
            store / array,
            (shape[0], *facts),
            "f8",
            dims=("time", "band", "fact"),
            chunks=(FRAMES_A_PIECE, *facts),
            attrs={"fact": list(FACTS.values())},
        )
        samples = None
        if copied:
            cubes = made.cubes / "raw.zarr"
            _create_groups(cubes, array)
            samples = create_array(cubes / array, shape, dtype, attrs={"units": "adu"})
        return cls(catalogue, samples, tuple(shape), str(dtype))

    def finish(self) -> dict[str, Any]:
        """Close them: shape, type, whether samples were copied, and the digest of the content."""
        parts = [writer for writer in (self.catalogue, self.samples) if writer is not None]
        return {
            "shape": list(self.shape),
            "dtype": self.dtype,
            "copied": self.samples is not None,
            "digest": digest([_finish(writer) for writer in parts]),
        }


@dataclass(frozen=True)
class Kept:
    """An array of an earlier ingest whose files are unchanged."""

    array: str  # its name now
    name: str  # its name then
    folder: Path  # the earlier artefact
    facts: Mapping[str, Any]  # what `Writers.finish` returned then
    # the files as described by their headers then; without positions of the samples if these were
    # copied
    files: list[FrameFile]


def find_kept(
    folder: Path,
    earlier: Manifest,
    same: Mapping[str, str],
    sources: Mapping[str, Sequence[SourceFile]],
    *,
    copy: bool,
) -> list[Kept]:
    """Arrays of an earlier ingest that can be reused if their chunks are whole.

    Arrays that its tables do not describe, or that are damaged, must be read again. ``same``:
    present name to earlier name, of arrays made from the same files. ``sources``: files of each
    array now. ``copy``: only arrays whose samples were copied.
    """
    try:
        tables, places = (_intact(folder, earlier, name) for name in ("frames.json", "files.json"))
    except DamagedError:
        return []
    damaged = tuple(damaged_files(folder))
    kept = []
    for array, name in same.items():
        parts = (f"raw.zarr/{name}/", f"catalogue.zarr/{name}/")
        if any(file.startswith(parts) for file in damaged):
            continue
        try:
            facts = earlier.summary["arrays"][name]
            files = _described(sources[array], facts["shape"], tables[name], places[name])
        except (LookupError, TypeError):
            continue
        as_listed = list(zip(tables[name]["file"], tables[name]["plane"], strict=True))
        if _order(files) == as_listed and (facts["copied"] or not copy):
            kept.append(Kept(array, name, folder, facts, files))
    return kept


def _intact(folder: Path, earlier: Manifest, name: str) -> Any:
    """Content of a file of an earlier artefact, verified by its digest."""
    content = read_json(folder / name)
    if file_digest(folder / name) != earlier.files.get(name):
        raise DamagedError(folder / name, "altered since it was written")
    return content


def _described(
    sources: Sequence[SourceFile],
    shape: Sequence[int],
    table: Mapping[str, Sequence[Any]],
    places: Columns | None,
) -> list[FrameFile]:
    """The files of an array from its columns in ``frames.json`` and ``files.json``."""
    planes = Counter(table["file"])
    first = {table["file"][n]: n for n, plane in enumerate(table["plane"]) if plane == 0}
    rows = {} if places is None else {name: n for n, name in enumerate(places["file"])}
    files = []
    for source in sources:
        n = first[source.name]
        frame = (planes[source.name], shape[1], shape[2])
        file = FrameFile(source, "plain", -1, -1, frame, SampleFormat(8))
        if places is not None:
            file = described(places, rows[source.name], source.path.parent, frame[1:])
        headers = {name: table[name][n] for name in ("mjd", "exptime_s", "temperature_c")}
        files.append(replace(file, source=source, **headers))
    return files


def _order(files: Sequence[FrameFile]) -> list[tuple[str, int]]:
    """File and plane of each frame, which depend on headers but not on the frame period."""
    frames, _ = tabulate("", files, None)
    return [(frame.file.source.name, frame.plane) for frame in frames]


def take_over(made: Build, kept: Sequence[Kept], runtime: Runtime) -> dict[str, dict[str, Any]]:
    """Link the chunks of earlier arrays into a build, and verify their digests.

    Between different places they are copied. Returns the result of `Writers.finish` by array, for
    whole arrays only; the others must be read again.
    """
    # Created here in turn: they share groups, which two tasks must not create at once.
    writers = [
        Writers.create(made, k.array, k.facts["shape"], k.facts["dtype"], copied=k.facts["copied"])
        for k in kept
    ]
    tasks = list(zip(kept, writers, strict=True))
    results = run_tasks(_take_over, tasks, runtime, label="reused frames")
    return {k.array: facts for k, facts in zip(kept, results, strict=True) if facts is not None}


def _take_over(task: tuple[Kept, Writers]) -> dict[str, Any] | None:
    kept, writers = task
    try:
        writers.catalogue.take(kept.folder / "catalogue.zarr" / kept.name)
        if writers.samples is not None:
            writers.samples.take(cubes_of(kept.folder) / "raw.zarr" / kept.name)
        facts = writers.finish()
    except DamagedError:
        return None
    except OSError as error:
        if error.errno in DISK_FULL:
            raise
        return None
    # Compare sizes and checksums of the present chunks with those of the earlier index.
    return facts if facts["digest"] == kept.facts["digest"] else None
