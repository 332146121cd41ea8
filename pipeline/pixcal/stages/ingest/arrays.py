"""The arrays of ``RUN/ingest``: made, closed, and taken over from an earlier ingest.

An array whose files are all as they were is not read again: its chunks are linked from the earlier
artefact, and what the headers said is taken from its tables. Its files are not even opened.
"""

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixcal.engine.run import Runtime, run_tasks
from pixcal.model.errors import DamagedError
from pixcal.storage.artefact import Manifest, damaged_files, file_digest, read_json
from pixcal.storage.cube import ArrayWriter, create_array, create_group
from pixcal.storage.cube_place import cubes_of
from pixcal.storage.fits_in import Coding, FrameFile
from pixcal.storage.folder import DISK_FULL
from pixcal.storage.frames import tabulate
from pixcal.storage.place import Place
from pixcal.storage.sources import SourceFile


def create(cubes: Place, array: str, shape: Sequence[int], dtype: Any) -> ArrayWriter:
    """Create an array (time, y, x) among the cubes of an artefact, in ADU, or reopen it."""
    create_group(cubes / "raw.zarr")
    if "/" in array:
        create_group(cubes / "raw.zarr" / array.split("/")[0])
    return create_array(
        cubes / "raw.zarr" / array, shape, dtype, attrs={"units": "adu"}, durable=True
    )


def finish(writer: ArrayWriter) -> dict[str, Any]:
    """Close an array: its shape, type, and the digest of its content.

    Raises
    ------
    DamagedError
        Naming a chunk that is missing or cut.
    """
    index = writer.finish()
    content = hashlib.sha256(repr((writer.shape, writer.dtype.str)).encode())
    content.update(index.tobytes())
    return {
        "shape": list(writer.shape),
        "dtype": writer.dtype.name,
        "digest": content.hexdigest()[:32],
    }


@dataclass(frozen=True)
class Kept:
    """An array of an earlier ingest whose files are still the same.

    Attributes
    ----------
    array : str
        Its name now; the earlier one may be another.
    path : Path or UrlPath
        Its folder among the cubes of the earlier artefact.
    facts : mapping
        What `finish` returned then.
    files : list of FrameFile
        The files as their headers described them then. Where their samples are is not known.
    """

    array: str
    path: Place
    facts: Mapping[str, Any]
    files: list[FrameFile]


def find_kept(
    folder: Path,
    earlier: Manifest,
    same: Mapping[str, str],
    sources: Mapping[str, Sequence[SourceFile]],
) -> list[Kept]:
    """Arrays of an earlier ingest that can be taken over, if their chunks are whole.

    Parameters
    ----------
    folder : Path
        The earlier artefact.
    earlier : Manifest
        Its manifest.
    same : mapping
        Name now to earlier name, of the arrays made from the same files.
    sources : mapping
        Files of each array now.

    Returns
    -------
    list of Kept
        Without those that its tables do not describe, or that are damaged: they must be read
        again.
    """
    tables_file = folder / "frames.json"
    try:
        tables = read_json(tables_file)
    except DamagedError:
        return []
    if earlier.files and file_digest(tables_file) != earlier.files.get(tables_file.name):
        return []
    damaged = damaged_files(folder)
    kept = []
    for array, name in same.items():
        if any(file.startswith(f"raw.zarr/{name}/") for file in damaged):
            continue
        try:
            facts = earlier.summary["arrays"][name]
            files = _described(sources[array], facts["shape"], tables[name])
        except (LookupError, TypeError):
            continue
        if _order(files) == list(zip(tables[name]["file"], tables[name]["plane"], strict=True)):
            kept.append(Kept(array, cubes_of(folder) / "raw.zarr" / name, facts, files))
    return kept


def _described(
    sources: Sequence[SourceFile], shape: Sequence[int], table: Mapping[str, Sequence[Any]]
) -> list[FrameFile]:
    """The files of an array from its columns in ``frames.json``."""
    planes = Counter(table["file"])
    first = {table["file"][n]: n for n, plane in enumerate(table["plane"]) if plane == 0}
    return [
        FrameFile(
            source,
            "plain",
            hdu=-1,
            offset=-1,
            shape=(planes[source.name], shape[1], shape[2]),
            coding=Coding(8),
            mjd=table["mjd"][first[source.name]],
            exptime_s=table["exptime_s"][first[source.name]],
            temperature_c=table["temperature_c"][first[source.name]],
        )
        for source in sources
    ]


def _order(files: Sequence[FrameFile]) -> list[tuple[str, int]]:
    """File and plane of each frame; they depend on the headers, not on the frame period."""
    frames, _ = tabulate("", files, None)
    return [(frame.file.source.name, frame.plane) for frame in frames]


def take_over(cubes: Place, kept: Sequence[Kept], runtime: Runtime) -> dict[str, dict[str, Any]]:
    """Link the chunks of earlier arrays into a build (from one place to another they are copied),
    and hold them against their digests.

    Returns
    -------
    dict
        What `finish` returns, by array, of those that are whole; the others must be read again.
    """
    # Made here, one by one: they share groups, which two tasks must not make at once.
    writers = [create(cubes, k.array, k.facts["shape"], k.facts["dtype"]) for k in kept]
    tasks = list(zip(kept, writers, strict=True))
    found = run_tasks(_take_over, tasks, runtime, label="unchanged")
    return {k.array: facts for k, facts in zip(kept, found, strict=True) if facts is not None}


def _take_over(task: tuple[Kept, ArrayWriter]) -> dict[str, Any] | None:
    kept, writer = task
    try:
        writer.take(kept.path)
        facts = finish(writer)
    except DamagedError:
        return None
    except OSError as error:
        if error.errno in DISK_FULL:
            raise
        return None
    # Of the sizes and checksums that the chunks have now, against those of the earlier index.
    return facts if facts["digest"] == kept.facts["digest"] else None
