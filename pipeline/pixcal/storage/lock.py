"""Lock of a run directory for one process; damage found meanwhile is noted."""

import fcntl
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from pixcal.model.errors import DamagedError, InputError
from pixcal.storage.artefact import discard, settle_flush, tidy, unflushed
from pixcal.storage.damage import note_damage
from pixcal.storage.folder import DISK_FULL
from pixcal.storage.manifest import MANIFEST, UNFLUSHED


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
                note_damage(run, error)
        raise


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
            note_damage(run, error)
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
