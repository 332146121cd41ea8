"""Places of an artefact's cubes: in its folder, or in a separate folder elsewhere.

Cubes elsewhere are in a folder for one artefact, ``<base>/<stage>-<key>-<random>``, with the layout
of the artefact. The artefact names it in ``cubes.json``, and owns it while in its original run
directory: a copy of a run reads the cubes, but never removes them.
"""

import json
import logging
import secrets
from collections.abc import Mapping
from os import fspath
from pathlib import Path
from typing import Any

from pixcal import __version__
from pixcal.model.config import StrPath
from pixcal.model.errors import DamagedError, InputError, RemoteError
from pixcal.storage.folder import open_folder
from pixcal.storage.place import Local, Place, parse_place

POINTER = "cubes.json"
NOTE = "pixcal.json"  # file beside the cubes that describes them

log = logging.getLogger(__name__)


def cubes_of(artefact: Local) -> Place:
    """The folder of an artefact's cubes; DamagedError if ``cubes.json`` is invalid."""
    pointer = _read(artefact)
    return artefact if pointer is None else parse_place(pointer["place"])


def base_of(artefact: Path) -> Place | None:
    """The folder for all cubes given to an artefact; None if it keeps its cubes itself."""
    pointer = _read(artefact)
    return None if pointer is None else parse_place(pointer["base"])


def chosen_base(named: StrPath | None, run: Path, like: Path) -> Place | None:
    """The folder for all cubes chosen by the user; None: cubes stay in the artefacts.

    ``named``: path or URL, or the run directory for None; None for the same as the artefact
    ``like``.
    """
    if named is None:
        return base_of(like)
    place = parse_place(fspath(named))
    return None if place == parse_place(str(run)) else place


def settled(artefact: Path, run: Path, base: Place | None) -> bool:
    """Whether an artefact under construction can continue with its present place of cubes."""
    pointer = _read(artefact)
    if pointer is None:
        return base is None
    return parse_place(pointer["base"]) == base and _owns(run, pointer)


def settle(artefact: Path, run: Path, base: Place | None) -> None:
    """Make the folder for the cubes of an artefact under construction, unless it has one."""
    if base is None or _read(artefact) is not None:
        return
    place = base / f"{artefact.name}-{secrets.token_hex(4)}"
    note = {"pixcal": __version__, "run": str(run.absolute()), "artefact": artefact.name}
    # Written first, so that errors of the place show before any work is done.
    _write_json(place, NOTE, note)
    owner = run.stat().st_ino
    _write_json(artefact, POINTER, {"base": str(base), "place": str(place), "owner": owner})


def remove_cubes(artefact: Path, run: Path) -> None:
    """Remove the cubes elsewhere that an artefact owns; warn if that fails."""
    from pixcal.storage.cube import remove_arrays  # here: the command line does without zarr

    try:
        pointer = _read(artefact)
        if pointer is None:
            return
        place = parse_place(pointer["place"])
        if not _owns(run, pointer):
            log.warning("%s: not removed, because a copy of %s may need it", place, run)
            return
        remove_arrays(place)
        open_folder(place).remove([NOTE])
    except (InputError, OSError) as error:
        log.warning("earlier cubes could not be removed: %s", error)


def _owns(run: Path, pointer: Mapping[str, Any]) -> bool:
    # The inode of a directory is unchanged by renaming, and different in a copy.
    return bool(pointer["owner"] == run.stat().st_ino)


def _read(artefact: Local) -> Mapping[str, Any] | None:
    file = artefact / POINTER
    try:
        pointer = json.loads(file.read_bytes())
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise _damaged(file, f" ({error})") from error
    if not isinstance(pointer, dict) or not {"base", "place", "owner"} <= pointer.keys():
        raise _damaged(file, "")
    return pointer


def _damaged(file: Local, reason: str) -> DamagedError:
    error = DamagedError(file, f"damaged{reason}")
    error.advice = "give --cubes again to rewrite the cubes (--cubes RUN keeps them in RUN)"
    return error


def _write_json(folder: Place, name: str, data: Any) -> None:
    try:
        content = (json.dumps(data, indent=2) + "\n").encode()
        open_folder(folder).write([(name, [content])], durable=True)
    except RemoteError as error:
        raise RemoteError(f"--cubes {error}") from error
    except RecursionError as error:  # folder in folder is made
        raise InputError(f"--cubes {folder}: nested too deeply; choose another place") from error
    except OSError as error:
        raise InputError(
            f"--cubes {folder}: cannot be written ({error.strerror}); choose another place"
        ) from error
