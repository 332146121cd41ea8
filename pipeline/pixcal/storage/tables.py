"""Tables of sources, in every format of astropy: CSV, ECSV, FITS, VOTable."""

from pathlib import Path
from typing import Any

import numpy as np
from astropy.table import Table
from numpy.typing import NDArray

from pixcal.model.errors import InputError


def read_table(path: Path) -> Table:
    """Read a table.

    Raises
    ------
    InputError
        If the file is not there or holds no table that astropy knows by its name or contents.
    """
    try:
        if path.suffix.lower() in (".csv", ".ecsv", ".txt", ".dat"):
            kind = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv"}.get(path.suffix.lower(), "ascii")
            return Table.read(path, format=kind)
        return Table.read(path)
    except Exception as error:  # the readers raise a dozen kinds, all of which mean one thing
        reason = " ".join(str(error).split())[:200]
        if not path.exists():
            reason = "no such file"
        raise InputError(
            f"{path}: cannot be read as a table ({reason}); give CSV, ECSV, FITS or VOTable"
        ) from error


def column(table: Table, name: str, path: Path, option: str) -> NDArray[np.float64]:
    """Numbers of a column; NaN where it is masked.

    Raises
    ------
    InputError
        If there is no such column, or it holds no numbers.
    """
    if name not in table.colnames:
        raise InputError(
            f"{option}: {path} has no column {name!r}; its columns are {', '.join(table.colnames)}"
        )
    try:
        values: Any = np.ma.filled(np.ma.asarray(table[name], dtype=float), np.nan)
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise InputError(f"{option}: column {name!r} of {path} holds no numbers") from error


def write_table(table: Table, path: Path, *, overwrite: bool) -> None:
    """Write a table in the format that the file's name ends in.

    Raises
    ------
    InputError
        If the file is there and not to be replaced, or its name says no format.
    """
    if path.exists() and not overwrite:
        raise InputError(f"{path}: is there already; choose another --out, or add --overwrite")
    kinds = {".csv": "ascii.csv", ".ecsv": "ascii.ecsv", ".fits": "fits", ".vot": "votable"}
    if path.suffix.lower() not in kinds:
        raise InputError(f"{path}: write a name that ends in {', '.join(kinds)}")
    table.write(path, format=kinds[path.suffix.lower()], overwrite=overwrite)
