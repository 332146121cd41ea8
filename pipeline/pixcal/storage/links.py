"""The files of one folder in another as well, at no cost where the file system has hard links."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from pixcal.storage.folder import UrlFolder, open_folder, written_aside
from pixcal.storage.place import Place, UrlPath


def link_files(source: Path, target: Path) -> None:
    """Give every file below a folder a second name below another; copy where there are no links.

    What is in the target already stays, so that a call that was cut short can be repeated; hidden
    files (those half written) are left out. Linked files share their bytes: replace them, as
    `pixcal.storage.cube` does, and never write into them.
    """
    for folder, _, names in os.walk(source):
        there = target / Path(folder).relative_to(source)
        there.mkdir(parents=True, exist_ok=True)
        for name in names:
            if not name.startswith(".") and not (there / name).exists():
                _link(Path(folder, name), there / name)


def _link(file: Path, target: Path) -> None:
    try:
        target.hardlink_to(file)
    except OSError:
        # Not on this file system, not across two of them, or too many names already.
        with written_aside(target, durable=True) as aside:
            shutil.copyfile(file, aside)


def copy_files(source: Place, target: Place, names: Sequence[str]) -> None:
    """Copy files of a folder to another, either of which may be at a URL.

    Inside one store the store copies, and what is there already stays; else all come by here.
    Raises OSError if a file is not there.
    """
    if isinstance(source, UrlPath) and isinstance(target, UrlPath):
        inside = UrlFolder(target).copy(source, names)
    else:
        inside = False
    if not inside:
        contents = ((name, [(source / name).read_bytes()]) for name in names)
        open_folder(target).write(contents, durable=True)
