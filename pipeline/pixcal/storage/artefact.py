"""Versioned artefacts: results of a stage on disk (docs/explanation/artefacts.md).

An artefact, a directory ``RUN/<stage>`` with a ``manifest.json``, is built in
``RUN/.partial/<stage>-<key>`` and renamed when complete. The key is a digest of all that the result
depends on: options, inputs, format, and the version of pixcal. A killed build is resumed if key and
code are the same; other builds are removed when one completes.

An artefact may be complete before it is flushed to disk (`unflushed`). Until then a file in it
holds the boot ID of the machine, and it counts as damaged after a reboot. Damage is noted in the
artefact (`pixcal.storage.manifest`), and its stage makes it again.
"""

import json
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pixcal import __version__
from pixcal.model.code import code_digest
from pixcal.model.errors import DamagedError
from pixcal.storage.cube_place import cubes_of, remove_cubes, settle, settled
from pixcal.storage.folder import flush
from pixcal.storage.manifest import (
    JOURNAL,
    SCRATCH,
    UNFLUSHED,
    Manifest,
    boot,
    check_intact,
    digest,
    list_files,
    read_manifest,
    write_manifest,
    write_whole,
)
from pixcal.storage.memory import MemoryBuild
from pixcal.storage.place import Place
from pixcal.storage.writeback import flush_file

_KEY_IN_NAME = 16


@dataclass
class Build:
    """An artefact under construction."""

    folder: Path  # where to write; becomes `RUN/<stage>` when complete
    cubes: Place  # where to write cubes: `folder`, unless they go elsewhere
    key: str  # digest of everything the result depends on
    resumed: bool
    # facts to keep in the manifest; fill before the build ends
    summary: dict[str, Any] = field(default_factory=dict)

    @property
    def scratch(self) -> Path:
        """Folder for temporary files of the build."""
        return self.folder / SCRATCH

    def journal(self) -> set[str]:
        """Steps noted as done by an earlier, interrupted build."""
        # Only steps of the present boot: after a power failure, data may not have reached the disk.
        path = self.folder / JOURNAL
        if not path.exists():
            return set()
        done = set()
        for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
            # A kill may have cut the last line: a line that does not parse was not done.
            try:
                step = json.loads(line)
                if step["boot"] == boot():
                    done.add(step["done"])
            except (ValueError, KeyError, TypeError):
                continue
        return done

    def note(self, step: str) -> None:
        """Note a step as done. Call it when all output of the step is in place."""
        with (self.folder / JOURNAL).open("a", encoding="utf-8") as file:
            file.write("\n" + json.dumps({"done": step, "boot": boot()}) + "\n")


Workspace = Build | MemoryBuild  # where a stage writes


def artefact_key(stage: str, format: int, config: dict[str, Any], inputs: dict[str, str]) -> str:
    """Digest of everything on which a stage's result depends."""
    return digest(stage, format, __version__, config, inputs)


def up_to_date(run: Path, stage: str, key: str) -> Manifest | None:
    """The manifest of ``RUN/<stage>`` if it was made from exactly these inputs and is whole."""
    try:
        manifest = read_manifest(run / stage)
        if manifest is None or manifest.key != key:
            return None
        check_intact(run / stage, manifest)
    except DamagedError:
        return None
    return manifest


@contextmanager
def build(
    run: Path,
    stage: str,
    format: int,
    config: dict[str, Any],
    inputs: dict[str, str],
    *,
    cubes: Place | None = None,
) -> Iterator[Build]:
    """Build an artefact aside and move it into place when the block ends without an exception.

    If it raises, the next build with the same key resumes, or starts over if a chunk is not as it
    was written. An artefact with another key stays until the new one is complete. ``cubes``: folder
    below which to make one for the cubes, instead of ``RUN/<stage>``; no part of the key. Raises
    InputError if ``cubes`` cannot be written.
    """
    key = artefact_key(stage, format, config, inputs)
    folder = run / ".partial" / f"{stage}-{digest(key, code_digest())[:_KEY_IN_NAME]}"
    if folder.is_dir() and not (settled(folder, run, cubes) and _whole(folder)):
        discard(folder, run)
    resumed = folder.is_dir()
    folder.mkdir(parents=True, exist_ok=True)
    settle(folder, run, cubes)
    made = Build(folder, cubes_of(folder), key, resumed)
    yield made
    # A complete artefact must be flushed to disk.
    if _later.get():
        write_whole(folder / UNFLUSHED, boot().encode())
        flush_file(folder)
    else:
        _flush(folder)
    manifest = Manifest(
        stage, format, key, config, inputs, summary=made.summary, files=list_files(folder)
    )
    write_manifest(folder, manifest)
    final = run / stage
    old = run / ".partial" / f"{stage}-replaced"
    if old.exists():
        discard(old, run)
    if final.exists():
        final.rename(old)
    folder.rename(final)
    # Only now: if killed before, the build resumes with every step noted as done.
    tidy(final)
    for left in [old, *folder.parent.glob(f"{stage}-{'[0-9a-f]' * _KEY_IN_NAME}")]:
        discard(left, run)


# whether artefacts are completed before they are on the disk
_later: ContextVar[bool] = ContextVar("_later", default=False)


@contextmanager
def unflushed() -> Iterator[None]:
    """Complete artefacts before they are flushed to disk; `settle_flush` flushes each."""
    # The disk writes one artefact while the next is computed.
    token = _later.set(True)
    try:
        yield
    finally:
        _later.reset(token)


def _flush(folder: Path) -> None:
    flush(folder)
    cubes = cubes_of(folder)
    if isinstance(cubes, Path) and cubes != folder:
        flush(cubes)


def settle_flush(run: Path) -> None:
    """Flush the artefacts of a run to disk, unless inside `unflushed`."""
    for mark in run.glob(f"*/{UNFLUSHED}"):
        if not _later.get() and mark.read_bytes() == boot().encode():
            _flush(mark.parent)
            mark.unlink()


def _whole(folder: Path) -> bool:
    """Whether the local chunks of an interrupted build are unaltered."""
    from pixcal.storage.cube import chunks_whole  # here: the command line does without zarr

    places = {folder, cubes_of(folder)}
    return all(chunks_whole(place) for place in places if isinstance(place, Path))


def discard(folder: Path, run: Path) -> None:
    """Remove an obsolete artefact, and its cubes elsewhere."""
    remove_cubes(folder, run)
    shutil.rmtree(folder, ignore_errors=True)


def tidy(folder: Path) -> None:
    """Remove temporary files of the build from a complete artefact."""
    (folder / JOURNAL).unlink(missing_ok=True)
    shutil.rmtree(folder / SCRATCH, ignore_errors=True)
