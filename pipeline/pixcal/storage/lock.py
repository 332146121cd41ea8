"""Lock of a run directory for one process; damaged data found meanwhile are remade.

Damage is noted in the artefact, which is not up to date from then on.
"""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pixcal.model.errors import DamagedError, InputError
from pixcal.storage.artefact import discard, settle_flush, tidy, unflushed
from pixcal.storage.cube_place import POINTER, cubes_of
from pixcal.storage.folder import DISK_FULL
from pixcal.storage.formats import STAGES
from pixcal.storage.manifest import DAMAGE, MANIFEST, UNFLUSHED, damaged_files, write_json


def _settle_killed(run: Path) -> None:
    """Finish steps interrupted by a kill: artefacts moved aside, or not cleaned up."""
    for old in run.glob(".partial/*-replaced"):
        final = run / old.name.removesuffix("-replaced")
        if final.exists():
            discard(old, run)
        else:
            old.rename(final)
    for manifest in run.glob(f"*/{MANIFEST}"):
        tidy(manifest.parent)


@contextmanager
def damage_noted(*runs: Path) -> Iterator[None]:
    """Note damage as `lock` does, for runs that are only read."""
    try:
        yield
    except DamagedError as error:
        for run in runs:
            with suppress(InputError, OSError), lock(run):
                _note_damage(run, error)
        raise


def _note_damage(run: Path, error: DamagedError) -> None:
    """Note damaged data, so that the next run of the stage repairs them."""
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


@contextmanager
def lock(run: Path) -> Iterator[None]:
    """Hold a run directory: a second process on it is refused, not mixed in.

    Damage found in it is noted, and an unfinished build removed. Raises InputError
    if another process holds it, or it cannot be written.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        handle = (run / ".lock").open("w")
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{run}: not a directory; choose another RUN") from error
    except RecursionError as error:  # folder in folder is made
        raise InputError(f"{run}: nested too deeply; choose another RUN") from error
    except OSError as error:
        if error.errno in DISK_FULL:
            raise
        raise InputError(
            f"{run}: cannot be written ({error.strerror}); choose another place"
        ) from error
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{run}: another pixcal is working there; wait for it") from error
        _settle_killed(run)
        settle_flush(run)
        try:
            yield
        except DamagedError as error:
            _note_damage(run, error)
            raise


@contextmanager
def flushed_last(run: Path) -> Iterator[None]:
    """Complete artefacts of a run before flushing; all are on disk when the block ends."""
    try:
        with unflushed():
            yield
    finally:
        if any(run.glob(f"*/{UNFLUSHED}")):
            # Another process that holds the run flushes them itself.
            with suppress(InputError), lock(run):
                pass
