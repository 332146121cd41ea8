"""The manifest of an artefact: its inputs, and whether it is unaltered.

It is sealed with its own digest, and holds a digest of every other file except chunks of arrays,
which have their own checksums. Damage found when reading is noted beside it.
"""

import hashlib
import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from pixcal import __version__
from pixcal.model.errors import DamagedError
from pixcal.storage.folder import INDEX, written_aside
from pixcal.storage.memory import MemoryPath
from pixcal.storage.place import Local

MANIFEST = "manifest.json"
JOURNAL = "journal.jsonl"
SCRATCH = "scratch"
DAMAGE = "damage.json"  # names of the files of an artefact that were found damaged when read
# in an artefact that is complete but not yet flushed to disk: the boot during which it was made
UNFLUSHED = "unflushed"


@cache
def boot() -> str:
    """Identifier of the present boot; of this process if the system gives none."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
    except OSError:
        return f"process {os.getpid()}"


@dataclass(frozen=True)
class Manifest:
    """Description of an artefact and its inputs."""

    stage: str
    format: int
    key: str
    config: dict[str, Any]
    inputs: dict[str, str]  # key of each artefact (or file set) that this one was made from
    pixcal: str = __version__
    summary: dict[str, Any] = field(default_factory=dict)
    # digest of each file of the artefact, except chunks of arrays
    files: dict[str, str] = field(default_factory=dict)


def digest(*parts: Any) -> str:
    """SHA-256 (hex, 32 characters) of plain data."""
    text = json.dumps(parts, sort_keys=True, separators=(",", ":"), default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def file_digest(path: Local) -> str:
    """SHA-256 (hex, 32 characters) of a file; DamagedError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()[:32]
    except OSError as error:
        raise DamagedError(path, f"cannot be read ({error.strerror})") from error


def _json(data: Any) -> str:
    return json.dumps(data, indent=2, allow_nan=False) + "\n"


def write_json(path: Local, data: Any) -> None:
    """Write JSON aside, flush it to the disk, and rename it into place."""
    if isinstance(path, MemoryPath):
        # On one line, since indentation takes ten times as long.
        path.keep(json.dumps(data, allow_nan=False).encode())
    else:
        write_whole(path, _json(data).encode())


def write_whole(path: Path, content: bytes) -> None:
    """Write a file aside, flush it to the disk, and rename it into place."""
    with written_aside(path, durable=True) as aside:
        aside.write_bytes(content)


def read_json(path: Local) -> Any:
    """Read JSON that pixcal wrote; DamagedError if the file is missing or does not parse."""
    return _read(path)[1]


def _read(path: Local) -> tuple[str, Any]:
    """Text of a JSON file, and its data."""
    try:
        text = path.read_text(encoding="utf-8")
        return text, json.loads(text)
    except OSError as error:
        raise DamagedError(path, f"cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise DamagedError(path, f"damaged ({error})") from error


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write the manifest of an artefact, sealed with its own digest."""
    # As it will be read: JSON turns tuples into lists, and all keys into strings.
    data = json.loads(_json(asdict(manifest)))
    write_json(folder / MANIFEST, data | {"seal": digest(data)})


def read_manifest(folder: Local) -> Manifest | None:
    """Manifest of an artefact, None where there is none; DamagedError if it was altered."""
    path = folder / MANIFEST
    if not path.exists():
        return None
    text, data = _read(path)
    try:
        sealed = data.pop("seal", None) is not None
        if sealed and text != _json(data | {"seal": digest(data)}):
            raise DamagedError(path, "altered since it was written")
        return Manifest(**data)
    except (AttributeError, TypeError) as error:
        raise DamagedError(path, "not a manifest that this version reads") from error


def list_files(folder: Path) -> dict[str, str]:
    """Digests of the files of an artefact, for its manifest."""
    return {name: file_digest(folder / name) for name in sorted(_listed(folder))}


def _listed(folder: Path) -> Iterator[str]:
    for at, folders, names in os.walk(folder):
        here = Path(at).relative_to(folder)
        if INDEX in names:
            folders.clear()  # of an array: its chunks
        if here == Path():
            folders[:] = [name for name in folders if name != SCRATCH]
            names = [name for name in names if name not in (MANIFEST, JOURNAL, DAMAGE, UNFLUSHED)]
        yield from ((here / name).as_posix() for name in names if not name.startswith("."))


def check_intact(folder: Path, manifest: Manifest) -> None:
    """Check the files of an artefact against its manifest, except chunks.

    Raises DamagedError naming the first one missing or altered, or found to be so earlier.
    """
    mark = folder / UNFLUSHED
    if mark.exists() and mark.read_bytes() != boot().encode():
        raise DamagedError(folder, "incomplete: the machine stopped before it was flushed to disk")
    for name in damaged_files(folder):
        raise DamagedError(folder / name, "damaged")
    for name, expected in manifest.files.items():
        if file_digest(folder / name) != expected:
            raise DamagedError(folder / name, "altered since it was written")


def damaged_files(folder: Path) -> list[str]:
    """Names of the files of an artefact that were found damaged when read."""
    if not (folder / DAMAGE).exists():
        return []
    try:
        return [str(name) for name in read_json(folder / DAMAGE)["files"]]
    except (DamagedError, LookupError, TypeError):
        return [DAMAGE]
