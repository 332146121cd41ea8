"""Directories that ``pixcal simulate`` writes to: made aside, then put in place."""

import shutil
from pathlib import Path
from typing import Any

from pixcal.model.errors import InputError
from pixcal.storage.artefact import MANIFEST, Manifest, read_manifest, write_manifest
from pixcal.storage.formats import ArtefactKind


def resolved(folder: Path, option: str) -> Path:
    """Where a directory is, or will be made."""
    try:
        folder = folder.resolve()
        folder.parent.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError) as error:  # the latter for links in a circle
        raise InputError(f"{option} {folder}: cannot be made ({error}); choose another") from error
    return folder


def up_to_date(folder: Path, stage: ArtefactKind, key: str, option: str) -> Manifest | None:
    """Manifest of a directory that was made with this key and is whole, if it is.

    Raises
    ------
    InputError
        If something else is in the way.
    """
    if not folder.exists():
        return None
    if not folder.is_dir():
        raise InputError(f"{option} {folder}: is a file; choose another directory")
    there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir()}
    if not there:
        return None
    manifest = read_manifest(folder)
    if manifest is None or manifest.stage != stage.name:
        raise InputError(
            f"{option} {folder}: not empty, and not made by 'pixcal simulate'; choose another"
        )
    foreign = sorted(there - set(manifest.summary.get("files", {})) - {MANIFEST})
    if foreign:
        raise InputError(f"{folder / foreign[0]}: not made by 'pixcal simulate'; move it away")
    whole = manifest.key == key and _sizes(folder) == manifest.summary.get("files")
    return manifest if whole else None


def _sizes(folder: Path) -> dict[str, int]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p != folder / MANIFEST)
    return {p.relative_to(folder).as_posix(): p.stat().st_size for p in files}


def put_in_place(
    made: Path, final: Path, stage: ArtefactKind, key: str, config: dict[str, Any]
) -> Manifest:
    """Write the manifest and put a complete directory in place of what stood there."""
    summary = {"files": _sizes(made)}
    manifest = Manifest(stage.name, stage.format, key, config, {}, summary=summary)
    write_manifest(made, manifest)
    if final.exists():
        old = made.with_name("replaced")
        shutil.rmtree(old, ignore_errors=True)
        final.rename(old)
    made.rename(final)
    return manifest
