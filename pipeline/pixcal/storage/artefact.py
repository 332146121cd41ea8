"""Versioned artefacts: what a stage leaves on disk.

An artefact is a directory ``RUN/<stage>`` with a ``manifest.json``. It is built aside, in
``RUN/.partial/<stage>-<key>``, and renamed when complete, so that a directory that exists is whole.
The key is a digest of everything the result depends on: a build with the same key that was killed
is found again and resumed. Unfinished builds with other keys are removed when one completes.
"""

import fcntl
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pixcal import __version__
from pixcal.model.errors import DamagedError, InputError
from pixcal.storage.cube_place import cubes_of, remove_cubes, settle, settled
from pixcal.storage.place import Place

MANIFEST = "manifest.json"
_KEY_IN_NAME = 16


@dataclass(frozen=True)
class Manifest:
    """What an artefact is and what it was made from."""

    stage: str
    format: int
    key: str
    config: dict[str, Any]
    inputs: dict[str, str]
    """Key of each artefact (or file set) that this one was made from."""
    pixcal: str = __version__
    summary: dict[str, Any] = field(default_factory=dict)


def digest(*parts: Any) -> str:
    """SHA-256 (hex, 32 characters) of plain data."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def write_json(path: Path, data: Any) -> None:
    """Write JSON aside, flush it to the disk, and rename it into place."""
    aside = path.with_name(f".{path.name}.aside")
    with aside.open("w", encoding="utf-8") as file:
        json.dump(data, file, indent=2, allow_nan=False)
        file.write("\n")
        file.flush()
        os.fsync(file.fileno())
    aside.replace(path)


def read_json(path: Path) -> Any:
    """Read JSON that pixcal wrote.

    Raises
    ------
    DamagedError
        If the file is missing or does not parse.
    """
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise DamagedError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise DamagedError(f"{path}: damaged ({error}); remove its folder and run again") from error


def read_manifest(folder: Path) -> Manifest | None:
    """Manifest of an artefact, or None when there is no artefact."""
    if not (folder / MANIFEST).exists():
        return None
    data = read_json(folder / MANIFEST)
    try:
        return Manifest(**data)
    except TypeError as error:
        raise DamagedError(f"{folder / MANIFEST}: not a manifest that this pixcal reads") from error


def require(run: Path, stage: str, format: int) -> Manifest:
    """Manifest of a stage that must have been run.

    Raises
    ------
    InputError
        If the stage has not been run, or its format is another one.
    """
    if not run.is_dir():
        raise InputError(f"{run}: no such run directory; make one with 'pixcal ingest'")
    manifest = read_manifest(run / stage)
    # The sweep is a part of the command that reads it.
    command = f"pixcal {'fit' if stage == 'sweep' else stage} {run}"
    if manifest is None:
        raise InputError(f"{run / stage}: not there yet; run '{command}' first")
    if manifest.stage != stage or manifest.format != format:
        raise InputError(
            f"{run / stage}: format {manifest.stage}/{manifest.format}, this pixcal reads "
            f"{stage}/{format}; run '{command}' again"
        )
    return manifest


@dataclass
class Build:
    """An artefact in the making.

    Attributes
    ----------
    folder : Path
        Where to write; becomes ``RUN/<stage>`` when complete.
    cubes : Path or UrlPath
        Where to write cubes: ``folder``, unless they go elsewhere.
    key : str
        Digest of everything the result depends on.
    summary : dict
        Facts to keep in the manifest; fill before the build ends.
    """

    folder: Path
    cubes: Place
    key: str
    resumed: bool
    summary: dict[str, Any] = field(default_factory=dict)
    durable: bool = False

    def discard(self) -> None:
        """Remove all that was written: the next run begins again."""
        _discard(self.folder, self.folder.parents[1])

    def journal(self) -> set[str]:
        """Steps noted as done by an earlier, interrupted build.

        Unless the build is durable, only those of this run of the machine: after a power failure
        nobody knows what reached the disk.
        """
        path = self.folder / "journal.jsonl"
        if not path.exists():
            return set()
        done = set()
        for line in path.read_text(encoding="utf-8").splitlines():
            # The last line may have been cut by a kill: what does not parse was not done.
            try:
                step = json.loads(line)
                if self.durable or step["boot"] == _boot():
                    done.add(step["done"])
            except (ValueError, KeyError, TypeError):
                continue
        return done

    def note(self, step: str) -> None:
        """Note a step as done. Call it when all that the step wrote is in place."""
        with (self.folder / "journal.jsonl").open("a", encoding="utf-8") as file:
            file.write("\n" + json.dumps({"done": step, "boot": _boot()}) + "\n")
            if self.durable:
                file.flush()
                os.fsync(file.fileno())


@cache
def _boot() -> str:
    """Name of this run of the machine; of this process where the system gives none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return f"process {os.getpid()}"


def artefact_key(stage: str, format: int, config: dict[str, Any], inputs: dict[str, str]) -> str:
    """Digest of what a stage's result depends on."""
    return digest(stage, format, config, inputs)


def up_to_date(run: Path, stage: str, key: str) -> Manifest | None:
    """The manifest of ``RUN/<stage>`` when it was made from just these inputs, else None."""
    manifest = read_manifest(run / stage)
    return manifest if manifest is not None and manifest.key == key else None


@contextmanager
def build(
    run: Path,
    stage: str,
    format: int,
    config: dict[str, Any],
    inputs: dict[str, str],
    *,
    durable: bool = False,
    cubes: Place | None = None,
) -> Iterator[Build]:
    """Build an artefact aside and put it in place when the block ends without an exception.

    When the block raises (or the process is killed) the unfinished folder stays, and the next
    build with the same key resumes in it. An artefact of the same stage with another key is
    replaced only once the new one is complete; unfinished builds of the stage are then removed.

    Parameters
    ----------
    durable : bool
        What is noted as done has been flushed to the disk (arrays created ``durable``), and is
        trusted even after a power failure.
    cubes : Path or UrlPath, optional
        Folder below which to make one for the cubes, instead of ``RUN/<stage>``; no part of the
        key. An unfinished build whose cubes lie under another is not resumed.

    Raises
    ------
    InputError
        If ``cubes`` cannot be written.
    """
    key = artefact_key(stage, format, config, inputs)
    folder = run / ".partial" / f"{stage}-{key[:_KEY_IN_NAME]}"
    if folder.is_dir() and not settled(folder, run, cubes):
        _discard(folder, run)
    resumed = folder.is_dir()
    folder.mkdir(parents=True, exist_ok=True)
    settle(folder, run, cubes)
    made = Build(folder, cubes_of(folder), key, resumed, durable=durable)
    yield made
    # What is called complete must be on the disk, not on its way to it.
    os.sync()
    manifest = Manifest(stage, format, key, config, inputs, summary=made.summary)
    write_json(folder / MANIFEST, asdict(manifest))
    final = run / stage
    old = run / ".partial" / f"{stage}-replaced"
    if old.exists():
        _discard(old, run)
    if final.exists():
        final.rename(old)
    folder.rename(final)
    # Only now: killed before, the build is resumed, with every step noted as done.
    (final / "journal.jsonl").unlink(missing_ok=True)
    for left in [old, *folder.parent.glob(f"{stage}-{'[0-9a-f]' * _KEY_IN_NAME}")]:
        _discard(left, run)


def _discard(folder: Path, run: Path) -> None:
    """Remove an artefact that is of no use any more, and its cubes elsewhere."""
    remove_cubes(folder, run)
    shutil.rmtree(folder, ignore_errors=True)


def _put_back(run: Path) -> None:
    """Put back the artefacts that a kill left aside before the new one was in place."""
    for old in run.glob(".partial/*-replaced"):
        final = run / old.name.removesuffix("-replaced")
        if not final.exists():
            old.rename(final)


@contextmanager
def lock(run: Path) -> Iterator[None]:
    """Hold a run directory: a second process on it is refused, not mixed in.

    Raises
    ------
    InputError
        If another process holds it, or the directory cannot be written.
    """
    try:
        run.mkdir(parents=True, exist_ok=True)
        handle = (run / ".lock").open("w")
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{run}: not a directory; choose another RUN") from error
    except OSError as error:
        raise InputError(f"{run}: cannot be written ({error.strerror})") from error
    with handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise InputError(f"{run}: another pixcal is working there; wait for it") from error
        _put_back(run)
        yield
