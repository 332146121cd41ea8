"""Output directories of a simulation, built at a temporary place and then moved."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pixcal.model.errors import InputError
from pixcal.storage.formats import ArtefactKind
from pixcal.storage.manifest import MANIFEST, Manifest, read_manifest, write_manifest


@dataclass(frozen=True)
class Target:
    """A directory to write, the option that names it, and the kind of its contents."""

    final: Path
    option: str
    stage: ArtefactKind

    @classmethod
    def of(cls, folder: Path, option: str, stage: ArtefactKind) -> "Target":
        """Target at a given directory, which may not exist yet."""
        try:
            folder = folder.resolve()
            folder.parent.mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError) as error:  # the latter for circular links
            raise InputError(
                f"{option} {folder}: cannot be created ({error}); choose another"
            ) from error
        return cls(folder, option, stage)

    @property
    def aside(self) -> Path:
        """Temporary place where the directory is built."""
        return self.final.with_name(f".{self.final.name}.partial")

    def up_to_date(self, key: str) -> Manifest | None:
        """Manifest of the present directory, if it has this key and is complete."""
        folder, place = self.final, f"{self.option} {self.final}"
        if not folder.exists():
            return None
        if not folder.is_dir():
            raise InputError(f"{place}: is a file; choose another directory")
        there = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if not p.is_dir()}
        if not there:
            return None
        manifest = read_manifest(folder)
        if manifest is None or manifest.stage != self.stage.name:
            raise InputError(
                f"{place}: not empty, and not made by 'pixcal simulate'; choose another"
            )
        foreign = sorted(there - set(manifest.summary.get("files", {})) - {MANIFEST})
        if foreign:
            raise InputError(f"{folder / foreign[0]}: not made by 'pixcal simulate'; move it away")
        whole = manifest.key == key and _sizes(folder) == manifest.summary.get("files")
        return manifest if whole else None

    @contextmanager
    def building(self) -> Iterator[Path]:
        """An empty temporary directory for the contents, removed at the end."""
        made = self.aside / "made"
        try:
            shutil.rmtree(made, ignore_errors=True)
            made.mkdir(parents=True)
            yield made
        finally:
            shutil.rmtree(self.aside, ignore_errors=True)

    def put_in_place(self, key: str, config: dict[str, Any]) -> Manifest:
        """Write the manifest and replace the present directory by the new one."""
        made, stage = self.aside / "made", self.stage
        summary = {"files": _sizes(made)}
        manifest = Manifest(stage.name, stage.format, key, config, {}, summary=summary)
        write_manifest(made, manifest)
        if self.final.exists():
            old = self.aside / "replaced"
            shutil.rmtree(old, ignore_errors=True)
            self.final.rename(old)
        made.rename(self.final)
        return manifest


def _sizes(folder: Path) -> dict[str, int]:
    files = (p for p in sorted(folder.rglob("*")) if p.is_file() and p != folder / MANIFEST)
    return {p.relative_to(folder).as_posix(): p.stat().st_size for p in files}
