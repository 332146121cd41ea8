"""The files of one folder in another as well, at no cost where the file system has hard links."""

import os
import shutil
from pathlib import Path


def link_files(source: Path, target: Path) -> None:
    """Give every file below a folder a second name below another; copy where there are no links.

    What is in the target already stays, so that a call that was cut short can be repeated; hidden
    files (those half written) are left out. Linked files share their bytes: replace them, as
    `pixcal.storage.cube` does, and never write into them.

    Parameters
    ----------
    source, target : Path
        Folders; the target is made.
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
        aside = target.with_name(f".{target.name}.aside")
        shutil.copyfile(file, aside)
        with aside.open("rb") as copy:
            os.fsync(copy.fileno())
        aside.replace(target)
