"""``headers.csv`` beside ``acquisition.yaml``: header keywords of files that have no header.

The first column, ``file``, holds names or globs relative to the folder; the others are named as the
keywords of FITS headers, and mean the same.
"""

import csv
import math
from collections.abc import Iterable
from fnmatch import fnmatchcase
from pathlib import Path

from pixcal.model.errors import InputError

NAME = "headers.csv"
KEYWORDS = ("EXPTIME", "MJD-OBS", "DATE-OBS", "CCD-TEMP")
_NUMBERS = ("EXPTIME", "MJD-OBS", "CCD-TEMP")

Header = tuple[tuple[str, str | float], ...]  # keywords and values


def read_headers(folder: Path, names: Iterable[str]) -> dict[str, Header]:
    """Headers of files by their names; empty where there is no ``headers.csv``.

    Parameters
    ----------
    folder : Path
        Of the acquisition.
    names : iterable of str
        All files of the acquisition, relative to it.

    Raises
    ------
    InputError
        Naming the line that has no such file, no value that can be used, or names a file again.
    """
    path = folder / NAME
    if not path.exists():
        return {}
    found: dict[str, Header] = {}
    names = list(names)
    try:
        with path.open(encoding="utf-8-sig", newline="") as handle:
            rows = csv.DictReader(handle, skipinitialspace=True)
            _check_columns(path, list(rows.fieldnames or ()))
            for row in rows:
                place = f"{path}: line {rows.line_num}"
                header = tuple(_cards(place, row))
                matched = [name for name in names if fnmatchcase(name, row["file"] or "")]
                if not matched:
                    raise InputError(f"{place}: {row['file']!r:.80} matches no frame; correct it")
                for name in matched:
                    if name in found:
                        raise InputError(f"{place}: {name} has a header already; name it once")
                    found[name] = header
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: cannot be read ({reason}); write it as UTF-8 text") from error
    return found


def _check_columns(path: Path, columns: list[str]) -> None:
    if columns[:1] != ["file"] or not set(columns[1:]) <= set(KEYWORDS):
        raise InputError(
            f"{path}: the columns are {', '.join(columns) or 'missing'}; write file, then any of "
            f"{', '.join(KEYWORDS)}"
        )


def _cards(place: str, row: dict[str, str | None]) -> Iterable[tuple[str, str | float]]:
    for key in KEYWORDS:
        text = (row.get(key) or "").strip()
        if not text:
            continue
        if key not in _NUMBERS:
            yield key, text
            continue
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value) or (key == "EXPTIME" and value < 0):
            raise InputError(f"{place}: {key} {text!r:.40} is not a number that it can have")
        yield key, value
