"""Ingest: check and catalogue the frames of an acquisition, reading each frame once.

Headers and file lengths are checked before any data are read. Every frame is then read for its
checksums. Plain files are not copied, since `reduce` reads them in place. Samples of compressed
files, which cannot be read in bands of rows, are copied into cubes, as are all samples with
``copy``. An interrupted run resumes with the missing blocks of frames. Arrays whose files have not
changed since an earlier ingest are reused without reading.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pixcal.engine.run import Runtime
from pixcal.model.acquisition import Acquisition, load_acquisition
from pixcal.model.config import to_plain
from pixcal.model.errors import DamagedError, InputError, RemoteError
from pixcal.model.options import Ingest as Config
from pixcal.stages.ingest import frames_to_leave_out
from pixcal.stages.ingest.arrays import find_kept, take_over
from pixcal.stages.ingest.headers import check_headers
from pixcal.stages.ingest.reading import files_of, read_frames, writers_of
from pixcal.storage import frame_decoding
from pixcal.storage.artefact import Build, discard
from pixcal.storage.cube_place import base_of, chosen_base, cubes_of
from pixcal.storage.cube_reader import ArrayReader
from pixcal.storage.formats import STAGES
from pixcal.storage.frame_reader import describe
from pixcal.storage.frames import Frame, columns
from pixcal.storage.lock import lock
from pixcal.storage.manifest import Manifest, read_manifest, write_json, write_manifest
from pixcal.storage.sources import SourceFile, find_sources, fingerprint
from pixcal.storage.stage import make

STAGE = STAGES["ingest"]


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
            tables, warnings = check_headers(described, sources, known, runtime)
            copied = {
                array: facts[array]["copied"]
                if array in facts
                else config.copy or any(frame.file.container != "plain" for frame in frames)
                for array, frames in tables.items()
            }
            read_frames(made, {a: f for a, f in tables.items() if a not in known}, copied, runtime)
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
            array: (facts.get(array) or writers_of(made, array, frames, copied[array]).finish())
            | {"files": len(files_of(frames))}
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
        cut = frames_to_leave_out.cut_from(array, bands, frames[0].file.shape[1])
        repeats = frames_to_leave_out.repeats_of(bands)
        warnings += frames_to_leave_out.cut_warning(array, frames, cut, bands)
        warnings += frames_to_leave_out.repeat_warning(array, frames, repeats)
        listed[array] = columns(frames) | {
            "largest_adu": [float(v) if np.isfinite(v) else None for v in largest],
            "cut_from_row": cut,
            "repeat_of": repeats,
        }
        places[array] = None if copied[array] else describe(files_of(frames))
    write_json(made.folder / "frames.json", listed)
    write_json(made.folder / "files.json", places)
    made.summary["arrays"] = arrays
    return warnings
