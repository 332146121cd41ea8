"""Data found damaged are made again.

Damage is noted in the artefact, which is not up to date from then on.
"""

from contextlib import suppress
from pathlib import Path

from pixcal.model.errors import DamagedError
from pixcal.storage.artefact import discard
from pixcal.storage.cube_place import POINTER, cubes_of
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import DAMAGE, MANIFEST, damaged_files, write_json


def note_damage(run: Path, error: DamagedError) -> None:
    """Note damaged data, so that the next run of the stage makes them again."""
    if _name_within(run / "products", error.path) is not None:
        error.advice = f"write it again with '{STAGES['fit'].typed(run)}'"
        return
    for folder in [*run.glob(".partial/*/"), *(file.parent for file in run.glob(f"*/{MANIFEST}"))]:
        name = _name_within(folder, error.path)
        if name is None:
            continue
        if folder.parent != run:
            discard(folder, run)
            error.advice = "run the same command again"
            return
        if name != POINTER and folder.name in STAGES:
            error.advice = f"make it again with '{STAGES[folder.name].typed(run)}'"
        with suppress(OSError):
            write_json(folder / DAMAGE, {"files": sorted({*damaged_files(folder), name})})


def _name_within(folder: Path, path: str) -> str | None:
    """Name of a file relative to an artefact, or to its cubes elsewhere; None when not of it."""
    try:
        cubes = cubes_of(folder)
    except DamagedError:
        cubes = folder
    for place in (folder, folder.absolute(), cubes):
        if path.startswith(f"{place}/"):
            return path.removeprefix(f"{place}/")
    return None
